"""Gains learnt sample by sample: what is known of them, and whether they predict better than those in force.

Two filters see the same measurements, one that learns the gains and one with those in force; each measurement is
predicted before anything is learnt from it. What the first one's log-likelihood is above the second one's is the
evidence for other gains.

Source: Dawid, J. Royal Statistical Society A 147 (1984), the prequential approach.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mampc.base.checks import Array, BoolArray
from mampc.base.identity import equal_only_to_itself
from mampc.loop.gain_filter import REMEMBERED, Belief, GainFilter
from mampc.loop.hypotheses import Loads
from mampc.systems.state_space import StateSpace


@equal_only_to_itself
class Learnt(NamedTuple):
    """What is learnt of the gains of a model; plain numbers.

    Attributes:
        factors: of the gains in force, shape (l, m).
        taught: samples that taught something since these were taken.
        samples: since the filters began.
        evidence: for other gains than those in force, a log-likelihood, shape (1,).
        begun: all inputs when the filters began, shape (m + d,).
        responses: of the model's states to each input alone since then, shape (n, m + d).
        did: what each input did to each output by the model at the last sample, shape (l, m).
        weights, z, P: the `Belief` that learns the gains.
        usual_weights, usual_z, usual_P: the one with those in force.
    """

    factors: Array
    taught: int
    samples: int
    evidence: Array
    begun: Array
    responses: Array
    did: Array
    weights: Array
    z: Array
    P: Array
    usual_weights: Array
    usual_z: Array
    usual_P: Array

    @property
    def belief(self) -> Belief:
        """What is known with gains learnt."""
        return Belief(self.weights, self.z, self.P)

    @property
    def held(self) -> Belief:
        """What is known with the gains in force."""
        return Belief(self.usual_weights, self.usual_z, self.usual_P)


class GainLearner:
    """Learns the gains of a model from one sample after the other; pure.

    Args:
        model: a discrete model.
        noise: standard deviation of the measurement noise, shape (l,), in output units.
    """

    def __init__(self, model: StateSpace, noise: Array) -> None:
        self.model, self.noise = model, noise
        self._shape = model.n_outputs, model.n_inputs
        loads = Loads.of(model, noise)
        self._learns, self._usual = GainFilter(loads), GainFilter(loads, learns=False)

    def initial(self, inputs: Array, before: Learnt | None = None) -> Learnt:
        """Before the first sample, with all inputs so far, shape (m + d,); what was learnt `before` is kept."""
        model, usual = self.model, self._usual.initial()
        factors: Array = np.ones(self._shape)
        evidence: Array = np.zeros(1)
        taught = 0
        belief = self._learns.initial()
        if before is not None:
            factors, taught, evidence = before.factors, before.taught, before.evidence
            belief = self._learns.initial(*self._learns.theta(before.belief))
        responses, did = np.zeros((model.n_states, len(inputs))), np.zeros(self._shape)
        return Learnt(factors, taught, 0, evidence, inputs, responses, did, *belief, *usual)

    def update(
        self, learnt: Learnt, before: Array, now: Array, y: Array, believed: BoolArray | None = None
    ) -> Learnt:
        """After a measurement.

        Args:
            learnt: after the last one.
            before: all inputs as applied since the last measurement, shape (m + d,).
            now: all inputs that act on this one at once, shape (m + d,).
            y: measured outputs, shape (l,).
            believed: which of them count, default all.
        """
        try:
            after = self._updated(learnt, before - learnt.begun, now - learnt.begun, y, believed)
            if all(np.isfinite(part).all() for part in after):
                return after
        except np.linalg.LinAlgError:
            pass
        # Numbers too far apart for any filter: begin anew.
        return self.initial(now)._replace(factors=learnt.factors)

    def _updated(
        self, learnt: Learnt, before: Array, now: Array, y: Array, believed: BoolArray | None
    ) -> Learnt:
        model, m = self.model, self._shape[1]
        responses, belief, usual = learnt.responses, learnt.belief, learnt.held
        if learnt.samples:
            responses = model.A @ responses + model.B * before
            belief, usual = self._learns.predicted(belief), self._usual.predicted(usual)
        each = model.C @ responses + model.D * now
        surplus, own = y - model.y_op - each.sum(axis=1), each[:, :m]
        off = ((learnt.factors - 1) * own).sum(axis=1)
        since = own - learnt.did
        belief, likelihood = self._learns.corrected(belief, surplus, own, since, believed)
        usual, otherwise = self._usual.corrected(usual, surplus - off, own, since, believed)
        evidence = learnt.evidence * np.exp(-1 / REMEMBERED)
        # Before it knows the states, a filter's surprise says little.
        known = learnt.samples > self._usual.n_states
        if known:
            evidence = evidence + (likelihood - otherwise)
        taught = learnt.taught + int(known and (believed is None or bool(believed.any())))
        samples = learnt.samples + 1
        return Learnt(
            learnt.factors, taught, samples, evidence, learnt.begun, responses, own, *belief, *usual
        )

    def found(self, learnt: Learnt) -> tuple[Array, Array]:
        """Factors of the gains as learnt, and their standard deviations, shapes (l, m)."""
        theta, deviation = self._shaped(*self._learns.theta(learnt.belief))
        return 1 + theta, deviation

    def delay(self, learnt: Learnt) -> tuple[Array, Array]:
        """Samples by which outputs answer inputs later than in the model, and standard deviations, shapes (l, m)."""
        return self._shaped(*self._learns.delta(learnt.belief))

    def _shaped(self, mean: Array, covariance: Array) -> tuple[Array, Array]:
        deviation = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        return mean.reshape(self._shape), deviation.reshape(self._shape)

    def taken(self, learnt: Learnt, factors: Array) -> Learnt:
        """With other gains in force."""
        usual = self._learns.given(learnt.belief, factors.ravel() - 1)
        return learnt._replace(
            factors=factors, taught=0, evidence=np.zeros(1),
            usual_weights=usual.weights, usual_z=usual.z, usual_P=usual.P,
        )  # fmt: skip
