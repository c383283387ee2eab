"""Gains corrected while the loop runs: when they change, and how the loop goes on from where it was.

Each set of factors in force has its regulator, which learns nothing. Corrected models have the same A and B, so that
its state is one of the next set's too but for the estimate, which is taken over.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from mampc.base.checks import Array
from mampc.base.errors import MampcError
from mampc.base.words import Remark
from mampc.controllers.controller import Controller
from mampc.controllers.decision import Decision
from mampc.loop.change_over import made_anew, taken_over
from mampc.loop.corrected_gains import FEWEST, SURELY, another_model, another_time, require_apart, with_gains
from mampc.loop.doubt import remembers
from mampc.loop.estimator import Estimator
from mampc.loop.gain_learner import GainLearner, Learnt
from mampc.loop.state import RegulatorState

if TYPE_CHECKING:
    from mampc.loop.regulator import Regulator

KEPT = 8  # sets of factors whose regulators are kept


class Gains(NamedTuple):
    """What a regulator has learnt of the gains of its model.

    Attributes:
        factors: by which those in force are multiplied, shape (l, m).
        learnt: by which they would be as learnt so far, shape (l, m).
        deviation: standard deviations of the latter, shape (l, m).
        evidence: by how much the latter raise the log-likelihood of the measurements since the former are in force.
    """

    factors: Array
    learnt: Array
    deviation: Array
    evidence: float


def made_to_learn(controller: Controller, estimator: Estimator) -> tuple[Controller, Estimator]:
    """Both, with states of the model that belong to one input each, so that every gain has numbers of its own.

    Raises:
        MampcError: noise that nobody told, redundant inputs, or modes that do not fade.
    """
    model, noise = estimator.model, estimator.noise_told
    if noise is None:
        raise MampcError(
            "learn_gains: expected an estimator that was told the noise, received one that guesses; give "
            "LoadBank(model, noise=...) or KalmanFilter.offset_free(model, measurement_noise=...)"
        )
    require_apart(model, noise)
    if remembers(model):
        raise MampcError(
            "learn_gains: expected a model whose modes all fade, received one with a mode that integrates or grows; "
            "mampc.learn_gains corrects it from records"
        )
    split = with_gains(model, np.ones((model.n_outputs, model.n_inputs)))
    return controller.with_model(split), made_anew(estimator, split)


class OnlineGains:
    """Learns the gains of one regulator's model, and has the regulators for those that it learns; pure.

    Args:
        plain: the regulator of the model as it is, `made_to_learn`, which learns nothing.
        made: such a regulator of a controller and estimator.
    """

    def __init__(self, plain: Regulator, made: Callable[[Controller, Estimator], Regulator]) -> None:
        self._plain, self._made = plain, made
        model, noise = plain.estimator.model, plain.estimator.noise_told
        assert noise is not None
        self._learner = GainLearner(model, noise)
        self._names = model.names.outputs
        self._regulators: dict[bytes, Regulator] = {}

    def initial(self, inputs: Array) -> Learnt:
        """Before the first sample, with all inputs so far, shape (m + d,)."""
        return self._learner.initial(inputs)

    def gains(self, learnt: Learnt) -> Gains:
        """What is learnt."""
        return Gains(learnt.factors, *self._learner.found(learnt), float(learnt.evidence[0]))

    def regulator(self, factors: Array) -> Regulator:
        """The regulator that has the gains multiplied, shape (l, m); raises `MampcError` where there is none."""
        if (factors == 1).all():
            return self._plain
        key = factors.tobytes()
        regulator = self._regulators.get(key)
        if regulator is None:
            model = with_gains(self._learner.model, factors)
            controller = self._plain.controller.with_model(model)
            regulator = self._made(controller, made_anew(self._plain.estimator, model))
            if len(self._regulators) >= KEPT:
                self._regulators.clear()
            self._regulators[key] = regulator
        return regulator

    def step(
        self, state: RegulatorState, y: Array, reference: Any, *, u_applied: Any, manual: Any, **now: Any
    ) -> Decision:
        """As `Regulator.step`, with the gains in force, which may be others from the next sample on."""
        learnt = state.learnt
        assert learnt is not None
        regulator = self.regulator(learnt.factors)
        applied = regulator.inputs_since(state, u_applied, manual)
        decision = regulator.step(
            state._replace(learnt=None), y, reference, u_applied=u_applied, manual=manual, **now
        )
        after: RegulatorState = decision.state
        v_last, v = state.measured_disturbance, after.measured_disturbance
        believed = np.array([name not in decision.ignored_outputs for name in self._names])
        learnt = self._learner.update(
            learnt, np.concatenate((applied, v_last)), np.concatenate((applied, v)), y, believed
        )
        if learnt.taught >= FEWEST and learnt.evidence[0] > SURELY:
            factors, _ = self._learner.found(learnt)
            try:
                model, delay = self._learner.model, self._learner.delay(learnt)
                if another_model(model, factors) or another_time(model, *delay):
                    raise MampcError("gains stay")
                other, taken = self.regulator(factors), self._learner.taken(learnt, factors)
                estimate = taken_over(after.estimate, regulator.estimator, other.estimator, applied, v)
            except (MampcError, np.linalg.LinAlgError):
                learnt = learnt._replace(taught=0)  # to be tried again with what is learnt by then
            else:
                loads = np.tile(other.estimator.loads_of(estimate), (len(y), 1))
                sensors = after.sensors._replace(loads=loads)
                after, learnt = after._replace(estimate=estimate, sensors=sensors), taken
                decision = decision._replace(remarks=(*decision.remarks, Remark.GAINS_CORRECTED))
        return decision._replace(state=after._replace(learnt=learnt))
