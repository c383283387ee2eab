"""Whatever the arguments, a public function raises MampcError or nothing: no other error for data of any kind."""

import warnings

import numpy as np
import pytest

import mampc
from mampc import rivals

VALUES = [
    None, "x", 1e308, 1e-308, np.nan, np.inf, -1, 0, [], [[]], [1, "a"], {}, object(), np.array(["a"]), 1 + 2j, True,
    [1e300, 1e-300], np.zeros((0, 2)), 10**400,
]  # fmt: skip
MODEL = mampc.StateSpace([[0.9]], [[0.1]], [[1.0]], None, 1.0)
PROBLEM = mampc.TrackingProblem(MODEL, prediction_horizon=5, control_horizon=2)
MPC = mampc.MPC(PROBLEM)
REGULATOR = mampc.Regulator(MPC)
RNG = np.random.default_rng(0)
DATA = mampc.IOData(RNG.standard_normal((200, 1)), RNG.standard_normal((200, 1)), 1.0)
HORIZONS = {"prediction_horizon": 5, "control_horizon": 2}
RULES = {
    "DeadBand": "size", "Rounded": "step", "Periodic": "every", "EventTriggered": "threshold", "QuietZone": "band",
    "SelfTriggered": "longest",
}  # fmt: skip


def calls(v):
    """Each public function with v in each of its places."""
    yield "StateSpace", lambda: mampc.StateSpace(v, [[1]], [[1]], None, 1.0)
    yield "StateSpace dt", lambda: mampc.StateSpace([[0.5]], [[1]], [[1]], None, v)
    for k in (*HORIZONS, "output_weight", "move_weight", "limits", "tail_horizon", "output_limit_weight"):
        yield f"TrackingProblem {k}", lambda k=k: mampc.TrackingProblem(MODEL, **(HORIZONS | {k: v}))
    for k in (
        "max_moves", "sparsity_horizon", "price", "counting", "min_size", "dwell", "max_moves_per_step", "blocks",
        "levels",
    ):  # fmt: skip
        yield f"MoveRules {k}", lambda k=k: mampc.MAMPC(PROBLEM, mampc.MoveRules(**{k: v}))
    for k in ("u_min", "u_max", "du_max", "y_min", "y_max"):
        yield (
            f"Limits {k}",
            lambda k=k: mampc.TrackingProblem(MODEL, **HORIZONS, limits=mampc.Limits(**{k: v})),
        )
    yield "MPC", lambda: mampc.MPC(v)
    yield "MAMPC", lambda: mampc.MAMPC(PROBLEM, v)
    yield "MAMPC method", lambda: mampc.MAMPC(PROBLEM, mampc.MoveRules(price=1.0), method=v)
    yield "Regulator", lambda: mampc.Regulator(v)
    yield "Regulator estimator", lambda: mampc.Regulator(MPC, v)
    yield "Regulator filter", lambda: mampc.Regulator(MPC, reference_filter=v)
    for k in ("time_constant", "rate"):
        yield f"ReferenceFilter {k}", lambda k=k: mampc.ReferenceFilter(**{k: v})
    for k in ("off", "on", "min_on", "min_off", "starts_per_hour"):
        yield f"OnOff {k}", lambda k=k: mampc.MAMPC(PROBLEM, mampc.MoveRules(levels=mampc.OnOff(**{k: v})))
    yield "n4sid", lambda: mampc.n4sid(v)
    yield "n4sid order", lambda: mampc.n4sid(DATA, order=v)
    yield "n4sid records", lambda: mampc.n4sid([DATA, v])
    yield "IOData", lambda: mampc.IOData(v, v, 1.0)
    yield "IOData dt", lambda: mampc.IOData([[1.0]], [[1.0]], v)
    yield "validate", lambda: mampc.validate(MODEL, v)
    yield "validate model", lambda: mampc.validate(v, DATA)
    yield "excite", lambda: mampc.excite(MODEL, v, dt=1.0)
    yield "excite plant", lambda: mampc.excite(v, [[1.0]], dt=1.0)
    for k in ("noise", "evidence", "names"):
        yield f"StateSpace {k}", lambda k=k: mampc.StateSpace([[0.5]], [[1]], [[1]], None, 1.0, **{k: v})
    yield "Noise", lambda: mampc.Noise(v, v)
    for k in ("inputs", "outputs", "states", "disturbances"):
        yield f"Names {k}", lambda k=k: mampc.Names(**({"inputs": ("u",), "outputs": ("y",)} | {k: v}))
    for k in (
        "gain",
        "settling_time",
        "noise",
        "dead_time",
        "integrating",
        "dt",
        "around",
        "max_amplitude",
        "accuracy",
    ):
        yield (
            f"plan_test {k}",
            lambda k=k: mampc.plan_test(**({"gain": 2.0, "settling_time": 60.0, "noise": 0.1} | {k: v})),
        )
    yield "linearise", lambda: mampc.linearise(v)
    yield "linearise u", lambda: mampc.linearise(mampc.plants.Level(), v)
    yield "steps", lambda: mampc.steps(3, 0.0, v)
    yield "prbs", lambda: mampc.prbs(order=v, amplitude=1.0)
    yield "prbs amplitude", lambda: mampc.prbs(order=4, amplitude=v)
    yield "simulate plant", lambda: mampc.simulate(v, REGULATOR, [1.0], steps=3)
    yield "simulate regulator", lambda: mampc.simulate(MODEL, v, [1.0], steps=3)
    yield "simulate a controller", lambda: mampc.simulate(MODEL, MPC, [1.0], steps=3)
    yield "simulate reference", lambda: mampc.simulate(MODEL, REGULATOR, v, steps=3)
    for k in ("steps", "noise", "seed", "input_disturbance", "loads", "valves", "u_initial", "preview"):
        yield f"simulate {k}", lambda k=k: mampc.simulate(MODEL, REGULATOR, [1.0], **({"steps": 3} | {k: v}))
    yield "simulate_batch", lambda: mampc.simulate_batch(MODEL, REGULATOR, [1.0], steps=3, seeds=v)
    yield "step x", lambda: MPC.step(MPC.initial_state(), v, [1.0])
    yield "step reference", lambda: MPC.step(MPC.initial_state(), [0.0], v)
    yield "step state", lambda: MPC.step(v, [0.0], [1.0])
    yield "regulator y", lambda: REGULATOR.step(REGULATOR.initial_state(), v, [1.0])
    yield "regulator applied", lambda: REGULATOR.step(REGULATOR.initial_state(), [1.0], [1.0], u_applied=v)
    yield "regulator state", lambda: REGULATOR.step(v, [1.0], [1.0])
    yield "initial state", lambda: MPC.initial_state(v)
    yield "regulator initial state", lambda: REGULATOR.initial_state(v)
    yield "KalmanFilter", lambda: mampc.KalmanFilter.offset_free(v)
    yield "KalmanFilter drift", lambda: mampc.KalmanFilter.offset_free(MODEL, drift=v)
    yield "KalmanFilter noise", lambda: mampc.KalmanFilter.offset_free(MODEL, measurement_noise=v)
    yield "from_first_order", lambda: mampc.StateSpace.from_first_order(gain=v, time_constant=1.0, dt=1.0)
    yield "from_first_order lag", lambda: mampc.StateSpace.from_first_order(gain=1.0, time_constant=v, dt=1.0)
    yield "from_step_response", lambda: mampc.StateSpace.from_step_response(v, dt=1.0)
    yield "largest_offset", lambda: mampc.largest_offset(PROBLEM, v)
    yield "largest_offset problem", lambda: mampc.largest_offset(v, mampc.MoveRules(price=1.0))
    for name, setting in RULES.items():
        yield name, lambda name=name, setting=setting: getattr(rivals, name)(MPC, **{setting: v})
    for name in ("L1", "GroupL2", "CLOT", "ElasticNet", "SCAD", "MCP", "LogSum"):
        for k in ("weight", "size"):
            yield (
                f"{name} {k}",
                lambda name=name, k=k: rivals.Penalised(PROBLEM, penalty=getattr(rivals, name)(**{k: v})),
            )
    yield "minimum_attention", lambda: rivals.minimum_attention(MODEL, v, steps=3)
    yield "minimum_attention model", lambda: rivals.minimum_attention(v, [1.0], steps=3)
    yield "minimum_attention steps", lambda: rivals.minimum_attention(MODEL, [1.0], steps=v)


@pytest.mark.parametrize("value", VALUES, ids=lambda v: repr(v)[:20])
def test_no_other_error_leaves_a_public_function(value):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        wrong = []
        for name, call in calls(value):
            try:
                call()
            except mampc.MampcError:
                pass
            except Exception as error:
                wrong.append(f"{name}: {type(error).__name__}: {error}")
    assert not wrong


def test_a_plant_that_lacks_something_is_told_what():
    class Half:
        names = mampc.Names(("u",), ("y",))

    for plant in (Half(), mampc.plants.QuadrupleTank):
        with pytest.raises(mampc.MampcError, match=r"without (derivative, output, steady_state|an object)"):
            mampc.simulate(plant, REGULATOR, [1.0], steps=3)
    with pytest.raises(mampc.MampcError, match="expected a tuple of words, received 'level'"):
        mampc.Names(("u",), "level")
    with pytest.raises(mampc.MampcError, match="expected a nonlinear plant"):
        mampc.linearise(MODEL)
