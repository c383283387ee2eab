"""An estimator with several hypotheses about the load, mixed by how likely the measurements make them.

Each hypothesis has its Kalman filter with a fixed gain. Their weights mu follow Bayes' rule, with a small chance T that
the load begins to behave in another way from one sample to the next; at each sample the filters start from the
mixture of all that may have led to them:

    c_b = sum_a mu_a T_ab      z_b <- sum_a mu_a T_ab z_a / c_b      mu_b ~ c_b N(e_b; 0, S_b)

with the innovation e_b of filter b and its covariance S_b. These hold up to one factor, which the innovations of late
tell: loads are told in units of the noise, so noise that was told wrongly changes no gain.

A plant may do what inputs ask for later, or more or less of it, than its model says. By what the inputs' moves of the
last samples did to the outputs, dead times aside, h, their innovations may be off: these vary by 1 / t_b = 1 + h'
diag(S_b^-1) h / l times as much, and what is corrected falls by as much (but where modes integrate or grow, and errors
would not fade). Meanwhile plans count on the bank with the weight t = sum_b mu_b t_b, and for the rest on the plain
filter that a regulator would have without a bank: that one follows slowly, and in one way whatever happens, so that a
wrong model costs little more with a bank than without. Where the model resonates, integrates or grows, plans count on
the bank by what of it came true besides (`hindsight`). The factor of the noise counts up to one here: errors of the
model, which make it larger, are no reason for less caution. Where the noise was guessed it counts as the least it can
be, since moves may be far above the noise and within its guess.

Source: Blom and Bar-Shalom, IEEE Trans. Automatic Control 33 (1988), the interacting multiple model filter, here with
stationary gains, and with jumps that give way to what held before them.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from mampc.base.checks import Array, BoolArray, as_flag, as_vector, is_usable
from mampc.base.errors import MampcError
from mampc.base.words import LoadKind
from mampc.loop.doubt import moves_of_late, remembers
from mampc.loop.estimator import Estimate, Estimator, Updated
from mampc.loop.everyday import everyday
from mampc.loop.guessed_noise import guessed_noise
from mampc.loop.hindsight import Hindsight, resonates
from mampc.loop.hypotheses import HYPOTHESES, Hypothesis, Loads, Member
from mampc.loop.kalman_filter import KalmanFilter
from mampc.loop.mixing import NOISE_RANGE, BankEstimate, Filters, Mixing, bank_estimate, filters_of
from mampc.program.problem import TrackingProblem
from mampc.systems.noise import white_noise
from mampc.systems.state_space import StateSpace, as_discrete

NOISE_TOLD, NOISE_GUESSED = 10.0, 2.0  # samples' worth of what is told or guessed of the noise

_ONE = np.ones(1)


class LoadBank(Estimator):
    """An estimator that finds out how unmeasured loads behave; see the module.

    `Estimate.x` holds the states of `planning_model`: loads may fade, and plans count on it.

    Args:
        model: a discrete model.
        noise: standard deviation of the measurement noise of each output, scalar or (l,), in output units. Twice
            too large, loads are found later, and twice too small, noise is taken for loads, until some hundred samples
            have shown how large it is. Default: what the record of an identified model showed (`model.noise`); see
            `for_problem` for a guess.
        guessed: whether this noise is a guess, which a few samples outweigh.
        hypotheses: about the load, at least one; see `HYPOTHESES`.

    Raises:
        MampcError: a continuous model, no noise, or a mode that grows and is not seen in the outputs.
    """

    noise: Array

    def __init__(
        self,
        model: StateSpace,
        *,
        noise: Any = None,
        guessed: bool = False,
        hypotheses: tuple[Hypothesis, ...] = HYPOTHESES,
    ) -> None:
        as_discrete("model", model)
        if not hypotheses or not all(isinstance(h, Hypothesis) for h in hypotheses):
            raise MampcError("hypotheses: expected at least one Hypothesis")
        noise = white_noise(model.noise) if noise is None else noise
        if noise is None:
            raise MampcError(
                "noise: expected the standard deviation of each output's measurement noise, received none; "
                "give it, or let LoadBank.for_problem guess"
            )
        sizes = as_vector("noise", noise, model.n_outputs, 0.0, exclusive=True)
        self.guessed = as_flag("guessed", guessed)
        self._told, self.noise_told = (NOISE_GUESSED, None) if self.guessed else (NOISE_TOLD, sizes)
        self.model, self.noise, self.hypotheses = model, sizes, tuple(hypotheses)
        self.loads = Loads.of(model, sizes)
        try:
            self.members = [Member(hypothesis, self.loads) for hypothesis in self.hypotheses]
            self.plain = KalmanFilter.offset_free(model, measurement_noise=sizes, unseen=True)
        except MampcError as error:
            raise MampcError(f"LoadBank: {error}") from None
        self._kept = tuple(sorted({h.kept for h in self.hypotheses if h.kept > 0}))
        self._planning_model = self.loads.with_fading(self._kept) if self._kept else model
        jumps = np.array([h.load is LoadKind.JUMPS for h in self.hypotheses])
        self._mixing = Mixing(jumps, NOISE_RANGE[0] if guessed else 1.0)
        self._A = np.stack([member.A for member in self.members])
        self._C = np.stack([member.C for member in self.members])
        self._plans = np.stack([self.to_plan(b) for b in range(len(self.members))])
        l, m = model.n_outputs, model.n_inputs
        self._parts = slice(0, -m - l), slice(-m - l, -l), slice(-l, None)  # x, d_u and d_y in these
        self._mixture = np.vstack([plan.T for plan in self._plans])
        # From (x, d_y, d_u) of the plain filter to (x, fading loads, d_u, d_y).
        same, fading = np.eye(model.n_states + l + m), self._planning_model.n_states - model.n_states
        x, d_y, d_u = np.split(same, np.cumsum([model.n_states, l]), axis=1)
        self._plain_part = np.hstack([x, np.zeros((len(same), fading)), d_u, d_y])
        self._of_each = np.kron(np.eye(len(self._A)), np.ones(l))  # sums up what belongs to each hypothesis
        self._filters: dict[bytes, Filters] = {}
        self._all = np.ones(model.n_outputs, dtype=bool)
        self._everything = self.filters(self._all)
        self._of_late, self._moved = moves_of_late(model), slice(l)
        self._damps = not remembers(
            model
        )  # where a mode integrates or grows errors stay, and are corrected in full
        self._swings, self._hindsight = resonates(model), None
        if self._swings or not self._damps:  # elsewhere what was foretold wrongly fades, and costs little
            self._hindsight = Hindsight(self._planning_model, self.plain, sizes)
        self._of_loads = slice(model.n_states, model.n_states + self.loads.count)
        # The members' models differ in how s goes on: all may have the same A once their mixed z are multiplied by
        # `_begins` before, and by `_goes_on` after.
        kept = np.array([h.kept for h in self.hypotheses])[:, None]
        lasting = np.ones((len(kept), model.n_states + self.loads.count))
        self._begins = np.hstack([lasting, np.repeat(kept > 0, self.loads.count, axis=1)])
        self._goes_on = np.hstack([lasting, np.repeat(kept, self.loads.count, axis=1)])
        self._everyday = everyday(self.loads, self.members[0], self._of_late, self.plain)

    @classmethod
    def for_problem(cls, problem: TrackingProblem, *, noise: Any = None) -> LoadBank:
        """A bank for the model of a problem, whose limits give a guess of the noise where nobody tells it.

        Raises:
            MampcError: as for `LoadBank`; and as `guessed_noise` where the noise has to be guessed.
        """
        if noise is None and white_noise(problem.model.noise) is None:
            return cls(problem.model, noise=guessed_noise(problem), guessed=True)
        return cls(problem.model, noise=noise)

    def __repr__(self) -> str:
        words = " ".join(h.load.value for h in self.hypotheses)
        return f"LoadBank({self.model!r}, {self.loads.count} loads, hypotheses {words})"

    @property
    def planning_model(self) -> StateSpace:
        """The model that plans predict with: that of the plant, with loads that fade as further states."""
        return self._planning_model

    def to_plan(self, b: int) -> Array:
        """From z of hypothesis b to the (x, d_u, d_y) of plans, shape (states of `planning_model` + m + l, n + 2k)."""
        loads, kept = self.loads, self.hypotheses[b].kept
        k, n, nz = loads.count, self.model.n_states, self.members[b].A.shape[0]
        z = np.eye(nz)
        x, w, s = z[:n], z[n : n + k], z[n + k :]
        lasting = w if kept == 0 else w + s / (1 - kept)
        fading = [-s / (1 - kept) if a == kept else 0 * s for a in self._kept]
        return np.vstack([x, *fading, loads.at_inputs @ lasting, loads.at_outputs @ lasting])

    def shifts(self, samples: int) -> Array:
        """See `Estimator.shifts`."""
        shifts = []
        for plan, member in zip(self._plans, self.members, strict=True):
            root = np.linalg.cholesky(member.innovation_covariance(self._all))
            shifts.append(plan @ member.gain(self._all) @ root)
        return np.tile(np.stack(shifts)[:, None], (1, samples, 1, 1))

    def weights_of(self, estimate: Estimate) -> Array:
        """How likely each hypothesis is, times the variance of the noise beside what was told.

        For models that resonate also times the square of how much plans count on the bank, since what data will tell
        goes with it.
        """
        bank = bank_estimate(estimate)
        if self._hindsight is None or not self._swings:
            return bank.weights * bank.scale[..., :1]
        moved = np.square(bank.late[..., self._moved]) @ self._everything.precisions.T
        doubt = moved / np.minimum(bank.scale[..., :1], 1.0)
        counts = (bank.weights / (1 + doubt)).sum(axis=-1) * self._hindsight.share(bank.hindsight, bank.scale)
        weights: Array = bank.weights * bank.scale[..., :1] * np.square(counts)[..., None]
        return weights

    def load(self, estimate: Estimate) -> LoadKind:
        """The hypothesis that is the most likely one, in words."""
        return self.hypotheses[int(bank_estimate(estimate).weights.argmax())].load

    def loads_of(self, estimate: Estimate) -> Array:
        """Loads of the mixture (k,), in sizes that show in the outputs like their noise, and of the plain filter."""
        bank, members = bank_estimate(estimate), bank_estimate(estimate).members[..., self._of_loads]
        one = bank.weights.ndim == 1
        loads: Array = bank.weights.dot(members) if one else np.einsum("sb,sbz->sz", bank.weights, members)
        return np.concatenate((loads, bank.plain[..., self.model.n_states :]), axis=-1)

    def with_loads(self, estimate: Estimate, stuck: BoolArray, loads: Array) -> Estimate:
        """The estimate with the loads of before the outputs `stuck` (l,) were; see `Estimator`."""
        bank, n, k = bank_estimate(estimate), self.model.n_states, self.loads.count
        members = bank.members.copy()
        members[:, n : n + k] = loads[int(stuck.argmax()), :k]
        members[:, n + k :] = 0.0
        return self.with_parts(bank, members, self.plain.with_loads(self.plain_of(bank), stuck, loads[:, k:]))

    def with_parts(self, bank: BankEstimate, members: Array, plain: Estimate) -> BankEstimate:
        """The estimate with other z of each hypothesis, shape (B, n + 2k), and another one of the plain filter."""
        counts = self._counts(bank.weights, bank.late, bank.scale)
        return self._estimate(
            members, bank.weights, bank.usual, bank.scale, bank.late, plain.flat, counts, bank.hindsight
        )

    def initial(self, u: Array, y: Any = None, v: Array | None = None) -> BankEstimate:
        """In a steady state under inputs u (m,) and measured disturbances v (d,), default those of the operating
        point; with measurements y (l,) the loads explain them, as small as they can.
        """
        model, k = self.model, self.loads.count
        all_inputs = np.concatenate([u, model.v_op if v is None else v])
        x, w = self.loads.at_rest(all_inputs, None if y is None else as_vector("y", y, model.n_outputs))
        usual = self._mixing.lasts / self._mixing.lasts.sum()
        members = np.tile(np.concatenate([x, w, np.zeros(k)]), (len(usual), 1))
        late = np.concatenate([np.zeros(len(self._of_late) - len(u)), u])
        scale = np.array([1.0, self._told])
        plain = self.plain.initial(u, y, v).flat
        chances = usual @ self._mixing.chances
        hindsight = np.zeros(0) if self._hindsight is None else self._hindsight.initial
        return self._estimate(members, chances, usual, scale, late, plain, 1.0, hindsight)

    def update(self, last: Estimate, u: Array, y: Array, v_last: Array, v: Array) -> Updated | None:
        """Predict and correct every hypothesis, with every output believed; None if some number is not usable."""
        bank, l, n_z = bank_estimate(last), len(y), len(self._everyday.of_mixed)
        known = np.concatenate((bank.members.ravel(), u, v_last, v, y, _ONE, bank.late, bank.plain))
        if not is_usable(known):
            return None
        c, mixed = self._mixing.before(bank.weights, bank.usual, bank.members)
        mixed *= self._begins
        told, each = self._everyday.of_known.dot(known[mixed.size :]), mixed.dot(self._everyday.of_mixed)
        each += told[: n_z + 2 * l]
        _, late, plain, missed = (told[part] for part in self._everyday.parts)
        seen = c.dot(each[:, n_z:])  # innovation and movement of the mixture
        estimate = self._weighed(
            each[:, :n_z] * self._goes_on, each[:, n_z : n_z + l].ravel(),
            late, plain, c, bank, self._everything, self._later(bank.hindsight, missed),
        )  # fmt: skip
        return Updated(estimate, seen[:l], seen[l:])

    def updates(self, last: Estimate, u: Array, y: Array, v_last: Array, v: Array) -> Updated:
        """`update` for many loops, whose arrays have these first; what is not usable comes out as it may."""
        bank, l, n_z, filters = (
            bank_estimate(last),
            y.shape[1],
            len(self._everyday.of_mixed),
            self._everything,
        )
        known = np.concatenate((u, v_last, v, y, np.ones((len(y), 1)), bank.late, bank.plain), axis=1)
        with np.errstate(over="ignore", invalid="ignore"):
            c, mixed = self._mixing.before(bank.weights, bank.usual, bank.members)
            told = known @ self._everyday.of_known.T
            each, late, plain, missed = (told[:, part] for part in self._everyday.parts)
            hindsight = self._later(bank.hindsight, missed)
            each = (mixed * self._begins) @ self._everyday.of_mixed + each[:, None]
            seen = np.einsum("sb,sbi->si", c, each[:, :, n_z:])
            innovations = each[:, :, n_z : n_z + l].reshape(len(y), -1)
            surprise = np.square(innovations @ filters.whiten.T) @ self._of_each.T
            moved = np.square(late[:, self._moved]) @ filters.precisions.T
            trust, weights, usual, scale = self._mixing.many(
                c, surprise, moved, filters, bank.usual, bank.scale
            )
            correction = (innovations @ filters.gains.T).reshape(mixed.shape)
            if self._damps:
                correction *= trust[..., None]
            members = each[:, :, :n_z] * self._goes_on + correction
            counts = (weights * trust).sum(axis=1, keepdims=True)
            estimate = self._estimate(members, weights, usual, scale, late, plain, counts, hindsight)
        return Updated(estimate, seen[:, :l], seen[:, l:])

    def predict(self, last: Estimate, u: Array, v: Array | None = None) -> BankEstimate:
        """One sample on, with the inputs u (m,) and disturbances v (d,) since."""
        bank, model = bank_estimate(last), self.model
        c, mixed = self._mixing.before(bank.weights, bank.usual, bank.members)
        members = np.matmul(self._A, mixed[:, :, None])[:, :, 0]
        members[:, : model.n_states] += model.B @ self._change(u, v)
        late = self._of_late.dot(np.concatenate((bank.late, u)))
        plain = self.plain.predict(self.plain_of(bank), u, v).flat
        counts, hindsight = self._counts(c, late, bank.scale), bank.hindsight
        if self._hindsight is not None:
            hindsight = self._hindsight.predicted(hindsight)
        return self._estimate(members, c, bank.usual, bank.scale, late, plain, counts, hindsight)

    def innovation(self, predicted: Estimate, u: Array, y: Array, v: Array | None = None) -> Array:
        """Measured less predicted outputs of the mixture, shape (l,); see `KalmanFilter.innovation`."""
        bank, model = bank_estimate(predicted), self.model
        expected = model.y_op + bank.weights @ self.seen(bank.members) + model.D @ self._change(u, v)
        return np.asarray(y - expected)

    def corrected(
        self, predicted: Estimate, innovation: Array, believed: BoolArray | None = None
    ) -> BankEstimate:
        """Correct with the innovation (l,) of the mixture, of which only the outputs `believed` count."""
        bank, believed = bank_estimate(predicted), self._all if believed is None else believed
        seen, filters = self.seen(bank.members), self.filters(believed)
        innovation = np.where(believed, innovation, 0.0)
        each = innovation + bank.weights @ seen - seen
        plain, model = self.plain_of(bank), self.model
        seen_beside = bank.weights @ seen + self.plain.innovation(plain, model.u_op, model.y_op)
        off = np.where(believed, innovation + seen_beside, 0.0)
        corrected = self.plain.corrected(plain, off, believed).flat
        hindsight = bank.hindsight
        if self._hindsight is not None:
            hindsight = self._hindsight.corrected(hindsight, off / self.noise, believed)
        return self._weighed(
            bank.members, each.ravel(), bank.late, corrected, bank.weights, bank, filters, hindsight
        )

    def filters(self, believed: BoolArray) -> Filters:
        """The gains where only some outputs, bool (l,), are believed."""
        key = believed.tobytes()
        filters = self._filters.get(key)
        if filters is None:
            filters = self._filters[key] = filters_of(self.members, self.noise, believed)
        return filters

    def _weighed(
        self, members: Array, innovations: Array, late: Array, plain: Array, c: Array, bank: BankEstimate,
        filters: Filters, hindsight: Array,
    ) -> BankEstimate:  # fmt: skip
        """The estimate after Bayes' rule.

        Args:
            members: predicted, shape (B, n + 2k).
            innovations: of one hypothesis after the other, shape (B l,).
            late, plain: of the estimate, predicted, and the latter corrected.
            c: how likely each hypothesis was before, shape (B,).
            hindsight: of the estimate, with what came.
        """
        surprise = self._of_each.dot(np.square(filters.whiten.dot(innovations)))
        moved = filters.precisions.dot(np.square(late[self._moved]))
        trust, weights, usual, scale = self._mixing.one(c, surprise, moved, filters, bank.usual, bank.scale)
        correction = filters.gains.dot(innovations).reshape(members.shape)
        if self._damps:
            correction *= trust[:, None]
        correction += members
        return self._estimate(correction, weights, usual, scale, late, plain, weights.dot(trust), hindsight)

    def _counts(self, weights: Array, late: Array, scale: Array) -> float:
        """t of the bank, with every output believed."""
        moved = self._everything.precisions.dot(np.square(late[self._moved]))
        return float(weights.dot(self._mixing.trust(moved, scale)))

    def _estimate(
        self, members: Array, weights: Array, usual: Array, scale: Array, late: Array, plain: Array, counts: Any,
        hindsight: Array,
    ) -> BankEstimate:  # fmt: skip
        """The estimate whose plans count on the bank with the weight t, `counts`, times its share in hindsight, and
        else on the plain filter.
        """
        each = (weights[..., None] * members).reshape((*weights.shape[:-1], -1))
        plan = plain.dot(self._plain_part)
        beside = each.dot(self._mixture) - plan
        if self._hindsight is not None:
            hindsight = self._hindsight.foretelling(hindsight, beside)
            counts = counts * self._hindsight.share(hindsight, scale)[..., None]
        plan += counts * beside
        x, at_inputs, at_outputs = self._parts
        return BankEstimate(
            plan[..., x], plan[..., at_outputs], plan[..., at_inputs],
            members, weights, usual, scale, late, plain, hindsight,
        )  # fmt: skip

    def _later(self, hindsight: Array, missed: Array) -> Array:
        """The hindsight a sample later, at which the plain filter missed so much of the outputs (..., l)."""
        if self._hindsight is None:
            return hindsight
        return self._hindsight.corrected(self._hindsight.predicted(hindsight), missed)

    def plain_of(self, bank: BankEstimate) -> Estimate:
        """What the plain filter estimates."""
        n, l = self.model.n_states, self.model.n_outputs
        return Estimate(bank.plain[:n], bank.plain[n : n + l], bank.plain[n + l :])

    def seen(self, members: Array) -> Array:
        """The outputs of every hypothesis beside those of the inputs, shape (B, l)."""
        return np.asarray(np.matmul(self._C, members[:, :, None])[:, :, 0])

    def _change(self, u: Array, v: Array | None) -> Array:
        """All inputs of the model as differences from the operating point, shape (m + d,)."""
        model = self.model
        return np.asarray(np.concatenate([u, model.v_op if v is None else v]) - model.all_inputs_op)
