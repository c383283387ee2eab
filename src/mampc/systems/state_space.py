"""Linear time-invariant models in state-space form, about an operating point.

    x+ = A x + B (u - u_op)          (or dx/dt = ... in continuous time, dt = 0)
    y  = y_op + C x + D (u - u_op)

u and y are in engineering units; x is the deviation from the state at the operating point. Measured
disturbances v, such as a load, are further inputs that no controller manipulates: their columns stand behind
those of u in B and D.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mampc.base.checks import (
    Array,
    ComplexArray,
    as_array,
    as_instance,
    as_matrix,
    as_number,
    as_vector,
    as_whole,
)
from mampc.base.errors import MampcError, listed
from mampc.base.names import Names, require_count
from mampc.systems.evidence import Evidence
from mampc.systems.modes import balanced
from mampc.systems.noise import Noise
from mampc.systems.response import responses

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False)
class StateSpace:
    """A linear model with its sample time, operating point and names.

    Args:
        A, B, C, D: shapes (n, n), (n, m + d), (l, n), (l, m + d); D = None means zeros.
        dt: sample time in seconds, 0 for continuous time.
        u_op, y_op: operating point in engineering units, shapes (m,), (l,); default zeros.
        names: signal names; default u1.., y1.., x1.., and no measured disturbances (d = 0).
        v_op: measured disturbances at the operating point, shape (d,); default zeros.
        noise: what a record said of the disturbances, or None.
        evidence: what else it said: ranges of the signals, how uncertain the step response is; or None.

    Raises:
        MampcError: shapes that do not fit together, non-finite numbers, a negative dt.
    """

    A: Array
    B: Array
    C: Array
    D: Array
    dt: float
    u_op: Array = None  # type: ignore[assignment]  # always set after construction, as are the others
    y_op: Array = None  # type: ignore[assignment]
    names: Names = None  # type: ignore[assignment]
    v_op: Array = None  # type: ignore[assignment]
    noise: Noise | None = None
    evidence: Evidence | None = None

    def __post_init__(self) -> None:
        A = as_matrix("A", self.A)
        n = A.shape[0]
        A = as_matrix("A", A, n, n)
        B = as_matrix("B", self.B, n)
        C = as_matrix("C", self.C, None, n)
        columns, l = B.shape[1], C.shape[0]
        names = Names.numbered(columns, l, n) if self.names is None else self.names
        d = len(as_instance("names", names, Names).disturbances)
        m = columns - d
        if m <= 0 or l == 0:
            raise MampcError(f"StateSpace: expected at least one input and output, received {m} and {l}")
        D = np.zeros((l, columns)) if self.D is None else as_matrix("D", self.D, l, columns)
        if not names.states:
            names = replace(names, states=Names.numbered(m, l, n).states)
        require_count("names.inputs", names.inputs, m)
        require_count("names.outputs", names.outputs, l)
        require_count("names.states", names.states, n)
        checked = {
            "A": A, "B": B, "C": C, "D": D, "names": names,
            "dt": as_number("dt", self.dt, 0.0),
            "u_op": as_vector("u_op", 0.0 if self.u_op is None else self.u_op, m),
            "y_op": as_vector("y_op", 0.0 if self.y_op is None else self.y_op, l),
            "v_op": as_vector("v_op", 0.0 if self.v_op is None else self.v_op, d),
        }  # fmt: skip
        if self.noise is not None and as_instance("noise", self.noise, Noise).output.shape != (l,):
            raise MampcError(f"noise: expected {l} outputs, received {self.noise.output.size}")
        said = self.evidence
        if said is not None and not as_instance("evidence", said, Evidence).matches(l, columns):
            raise MampcError(f"evidence: expected {columns} inputs and {l} outputs, received other numbers")
        for name, value in checked.items():
            if isinstance(value, np.ndarray):
                value.flags.writeable = False
            object.__setattr__(self, name, value)

    def __repr__(self) -> str:
        names = self.names
        signals = names.inputs, names.outputs, names.disturbances
        kinds = zip(("inputs", "outputs", "measured disturbances"), signals, strict=True)
        parts = [f"{self.n_states} states", *(f"{kind} {_short(own)}" for kind, own in kinds if own)]
        parts.append(f"dt = {self.dt:g} s" if self.is_discrete else "continuous")
        return f"StateSpace({', '.join(parts)})"

    def __str__(self) -> str:
        """The model, and gain, time constant and dead time of its first channels."""
        if not self.is_discrete:
            return repr(self)
        from mampc.systems.properties import channels_in_words

        return "\n".join([repr(self), *channels_in_words(self)])

    @property
    def n_states(self) -> int:
        """n."""
        return len(self.A)

    @property
    def n_inputs(self) -> int:
        """m, the manipulated inputs."""
        return len(self.names.inputs)

    @property
    def n_disturbances(self) -> int:
        """d, the measured disturbances."""
        return len(self.names.disturbances)

    @property
    def all_inputs_op(self) -> Array:
        """Inputs and measured disturbances at the operating point, shape (m + d,)."""
        return np.concatenate([self.u_op, self.v_op])

    @property
    def n_outputs(self) -> int:
        """l."""
        return len(self.C)

    @property
    def is_discrete(self) -> bool:
        """Whether it has a sample time; else it is in continuous time."""
        return self.dt > 0

    def poles(self) -> ComplexArray:
        """Eigenvalues of A, shape (n,)."""
        return np.linalg.eigvals(self.A).astype(complex)

    def is_stable(self) -> bool:
        """All poles strictly inside the unit circle (in continuous time: the left half plane)."""
        poles = self.poles()
        return bool(np.all(np.abs(poles) < 1) if self.is_discrete else np.all(poles.real < 0))

    def dc_gain(self) -> Array:
        """Steady change of the outputs per unit change of each input, shape (l, m).

        Raises:
            MampcError: the model integrates, so that no finite gain exists.
        """
        if not self.n_states:
            return self.D
        singular, sizes = balanced(self.A, self.is_discrete)
        if np.linalg.cond(singular) > 1e13:
            raise MampcError(
                "dc_gain: expected a model without integrators, received a pole at zero frequency"
            )
        gain: Array = (self.C * sizes) @ np.linalg.solve(singular, self.B / sizes[:, None]) + self.D
        return gain

    def step_response(self, n: int) -> Array:
        """Outputs after a unit step of each input at sample 0, in deviations: S_0 .. S_{n-1}.

            S_i = D + sum_{k < i} C A^k B

        Args:
            n: at least 1, samples.

        Returns:
            Shape (n, l, m + d), in output units per unit of input; the columns of measured disturbances stand
            behind those of the inputs. Infinite or not-a-number where an unstable model leaves the numbers.

        Raises:
            MampcError: a continuous model, or n below 1.
        """
        as_discrete("step_response", self)
        increments = np.empty((as_whole("n", n, 1), *self.D.shape))
        increments[0], state = self.D, self.B
        with np.errstate(over="ignore", invalid="ignore"):
            for k in range(1, n):
                increments[k] = self.C @ state
                state = self.A @ state
            response: Array = np.cumsum(increments, axis=0)
        return response

    def zeros(self) -> ComplexArray:
        """Transmission zeros of a square model: generalised eigenvalues of its system matrix.

        Source: Emami-Naeini and Van Dooren, Automatica 18 (1982), by way of the QZ algorithm.

        Raises:
            MampcError: unequal numbers of inputs and outputs.
        """
        n, m, l = self.n_states, self.n_inputs, self.n_outputs
        if m != l:
            raise MampcError(f"zeros: expected as many inputs as outputs, received {m} and {l}")
        from scipy.linalg import eig

        system = np.block([[self.A, self.B[:, :m]], [self.C, self.D[:, :m]]])
        pencil = np.diag(np.repeat([1.0, 0.0], [n, m]))
        alpha, beta = eig(system, pencil, right=False, homogeneous_eigvals=True)
        finite = np.abs(beta) > 1e-10 * np.maximum(np.abs(alpha), 1e-300)
        zeros: ComplexArray = alpha[finite] / beta[finite]
        return zeros

    def discretise(self, dt: float) -> StateSpace:
        """The exact sampled model for inputs held constant over dt seconds (zero-order hold).

        Source: Van Loan, IEEE Trans. Automatic Control 23 (1978): one matrix exponential.

        Raises:
            MampcError: the model is discrete already, or dt is not positive.
        """
        if self.is_discrete:
            raise MampcError(f"discretise: expected a continuous model (dt = 0), received dt = {self.dt:g} s")
        from scipy.linalg import expm

        n, m = self.B.shape
        block = np.zeros((n + m, n + m))
        block[:n, :n], block[:n, n:] = self.A, self.B
        held = expm(block * as_number("dt", dt, 0.0, exclusive=True))
        return replace(self, A=held[:n, :n], B=held[:n, n:], dt=dt)

    def steady_state(self, u: Any) -> Array:
        """Deviation state x, shape (n,), at rest under constant inputs u, shape (m,) or (m + d,).

        For an integrating model the smallest solution, in units that make the model's numbers alike; at the operating
        point always zeros. Measured disturbances left out are those of the operating point.
        """
        inputs = as_array("u", u)
        if inputs.shape == self.u_op.shape:
            inputs = np.concatenate([inputs, self.v_op])
        change = as_vector("u", inputs, self.B.shape[1]) - self.all_inputs_op
        if not self.n_states or not change.any():
            return np.zeros(self.n_states)
        singular, sizes = balanced(self.A, self.is_discrete)
        x: Array = sizes * np.linalg.lstsq(singular, self.B @ change / sizes)[0]
        return x

    def response(self, u: Any, x0: Any = None) -> Array:
        """Outputs, shape (N, l), to the inputs u, shape (N, m + d), from the state x0 (default: at rest).

        Raises:
            MampcError: a continuous model, or inputs of another width.
        """
        as_discrete("response", self)
        u = as_matrix("u", u, None, self.B.shape[1])
        x = np.zeros(self.n_states) if x0 is None else as_vector("x0", x0, self.n_states)
        blocks = responses(self.A, self.B, self.C, self.D, u, self.all_inputs_op, x)
        y: Array = np.concatenate([np.empty((0, self.n_outputs)), *blocks]) + self.y_op
        return y

    def plot(self, *, deviation: Any = None) -> Figure:
        """Step responses of all outputs to all inputs, until they have settled; needs mampc[plot].

        Args:
            deviation: standard deviations of the step response, such as of `Identified.uncertainty`, shape
                (samples, l, m + d), for a band of two to either side; default those of its `evidence`.

        Raises:
            MampcError: a continuous model, more than 100 panels, or a deviation of another shape.
        """
        from mampc.systems.step_figure import step_figure

        return step_figure(self, deviation)

    @classmethod
    def from_first_order(
        cls,
        *,
        gain: Any,
        time_constant: Any,
        dead_time: Any = 0.0,
        dt: float,
        u_op: Any = None,
        y_op: Any = None,
        names: Names | None = None,
        v_op: Any = None,
    ) -> StateSpace:
        """The sampled model of first-order lags with dead times, one for each output and input.

        Exact for inputs held between samples, dead times of parts of samples included. A dead time of q samples
        takes q states for all channels of an input together.

        Args:
            gain: K, shape (l, m), output units per input unit (and per second where the channel integrates); columns
                of measured disturbances behind those of the inputs.
            time_constant: seconds, (l, m) or one for all; 0 for none, infinite for a channel that integrates.
            dead_time: seconds, (l, m) or one for all. Channels of no gain need neither.
            dt: sample time in seconds.
            u_op, y_op, names, v_op: as for `StateSpace`.

        Raises:
            MampcError: shapes that do not fit together, negative or not-a-number values, dead times of more than
                500 samples together.
        """
        from mampc.systems.first_order import first_order

        A, B, C, D = first_order(gain, time_constant, dead_time, dt)
        return cls(A, B, C, D, dt, u_op, y_op, names, v_op)  # type: ignore[arg-type]

    @classmethod
    def from_step_response(
        cls,
        coefficients: Any,
        *,
        dt: float,
        accuracy: float = 0.01,
        u_op: Any = None,
        y_op: Any = None,
        names: Names | None = None,
        v_op: Any = None,
    ) -> StateSpace:
        """A model of as few states as describe step responses to a given accuracy, such as those of a DMC model.

        Responses that still move at the end go on: along a line (an integrator) where the time constant of their
        last sixth is longer than the record, else towards where that exponential leads. All others stay at their
        last coefficient.

        Args:
            coefficients: S, shape (N, l, m): output i, k samples after a unit step of input j, is S[k, i, j];
                S[0] is D, zero for most plants.
            dt: sample time in seconds.
            accuracy: largest error of any coefficient, as a share of the largest of its output and input.
            u_op, y_op, names, v_op: as for `StateSpace`.

        Raises:
            MampcError: what is no step response, or none that 500 states describe to this accuracy.
        """
        from mampc.systems.step_model import step_model

        A, B, C, D = step_model(coefficients, accuracy)
        dt = as_number("dt", dt, 0.0, exclusive=True)
        return cls(A, B, C, D, dt, u_op, y_op, names, v_op)  # type: ignore[arg-type]

    @classmethod
    def from_any(cls, system: Any, dt: float | None = None) -> StateSpace:
        """Build from a python-control or scipy.signal system, or a tuple (A, B, C, D[, dt]).

        The libraries mark continuous time differently: dt = 0 in python-control, dt = None in
        scipy.signal, no fifth entry (or None or 0) in a tuple. python-control's dt = True is discrete
        time of unstated length and its dt = None leaves the kind of time open.

        Args:
            system: transfer functions of python-control may have many inputs and outputs.
            dt: wanted sample time in seconds. A continuous system is sampled (zero-order hold), an
                unstated sample time is taken to be this one, a stated one must agree.

        Raises:
            MampcError: an unknown kind of object, an unstated sample time and no dt, or a dt that differs.
        """
        from mampc.systems.conversion import model_of

        return model_of(system, dt)

    def save(self, path: str | Path) -> None:
        """Write the model as JSON, whole or not at all; `load` gives the same numbers back.

        Raises:
            MampcError: a model larger than `load` takes, or a file that cannot be written.
        """
        from mampc.systems.model_file import write

        write(self, path)

    @classmethod
    def load(cls, path: str | Path) -> StateSpace:
        """Read a model written by `save`; raises `MampcError` for anything else."""
        from mampc.systems.model_file import read

        return read(path)


def as_discrete(name: str, value: Any) -> StateSpace:
    """A model in discrete time; raises `MampcError` for anything else, the message beginning with the name."""
    model = as_instance(name, value, StateSpace)
    if not model.is_discrete:
        raise MampcError(f"{name}: expected a discrete model, received dt = 0; discretise it first")
    return model


def _short(names: tuple[str, ...]) -> str:
    """The names, those after the fourth only counted."""
    return listed([name if len(name) <= 20 else f"{name[:19]}…" for name in names], 4, " ")
