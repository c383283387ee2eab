"""In closed loop the rules hold for the moves really applied, whatever plant, reference and noise."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import mampc
from builders import random_model
from referees import counted, keeps_dwell
from seeds import deep, examples

with_either_estimator = pytest.mark.usefixtures("either_estimator")
mostly_load_bank = pytest.mark.parametrize(
    "either_estimator", ["load bank", *deep("kalman filter")], indirect=True
)

STEPS = examples(30, quick=24)
POLISHED = {name: {"polish": True, "warm_up": 0} if name == "alternating" else {} for name in mampc.METHODS}
SIZES = st.one_of(st.just(0.0), st.floats(0.05, 1.0))


@st.composite
def rules_and_shapes(draw):
    """Move rules in any combination, inputs and control horizon."""
    m, n_c = draw(st.integers(1, 3)), draw(st.integers(1, 4))
    rules = mampc.MoveRules(
        max_moves=draw(st.one_of(st.none(), st.integers(0, 4))),
        sparsity_horizon=draw(st.integers(1, 7)),
        price=draw(st.one_of(st.just(0.0), st.floats(1e-3, 10.0))),
        counting=draw(st.sampled_from(["elementwise", "simultaneous"])),
        min_size=draw(SIZES),
        dwell=draw(st.integers(1, 6)),
        max_moves_per_step=draw(st.one_of(st.none(), st.integers(1, 3))),
        blocks=draw(st.sampled_from([None, (1,), (1, n_c - 1) if n_c > 1 else (1,)])),
    )
    return rules, m, n_c


@st.composite
def loops(draw):
    """A regulator's problem and rules, a plant that may differ from the model, and what disturbs it."""
    rules, m, n_c = draw(rules_and_shapes())
    seed = draw(st.integers(0, 2**32 - 1))
    rng, l = np.random.default_rng(seed), draw(st.integers(1, 2))
    model = random_model(seed, n=3, m=m, l=l, radius=draw(st.floats(0.3, 0.98)))
    at_limit = rng.choice([0.0, 1.0], m)  # the loop may start at a limit
    limits = mampc.Limits(
        **draw(st.sampled_from([{}, {"u_min": model.u_op - 1.5 * at_limit, "u_max": model.u_op + 1.5}])),
        **draw(st.sampled_from([{}, {"du_max": rng.uniform(1.0, 1.4, m)}])),
        **draw(st.sampled_from([{}, {"y_min": model.y_op - 0.5, "y_max": model.y_op + 0.5}])),
    )
    problem = mampc.TrackingProblem(
        model, prediction_horizon=n_c + draw(st.integers(0, 5)), control_horizon=n_c,
        move_weight=draw(st.floats(0.01, 1.0)), limits=limits, output_limit_weight=100.0,
    )  # fmt: skip
    mismatch = draw(st.sampled_from([0.0, 0.3]))
    plant = mampc.StateSpace(
        model.A, model.B * (1 + mismatch * rng.standard_normal(model.B.shape)), model.C, None, 1.0,
        model.u_op, model.y_op + mismatch * rng.standard_normal(l),
    )  # fmt: skip
    reference = model.y_op + np.repeat(rng.standard_normal((6, l)), STEPS // 6 + 1, axis=0)
    noise = draw(st.sampled_from([0.0, 1e-10, 1e-3, 0.3])) * rng.standard_normal((STEPS, l))
    return problem, rules, plant, reference, noise


def applied(problem, rules, plant, reference, noise, method):
    """Inputs really applied, with those before the loop, shape (STEPS + 1, m)."""
    controller = mampc.MAMPC(problem, rules, method=method, **POLISHED[method])
    regulator = mampc.Regulator(controller)
    state, x, inputs = regulator.initial_state(), np.zeros(plant.n_states), [problem.model.u_op]
    for r, e in zip(reference, noise, strict=False):
        decision = regulator.step(state, plant.y_op + plant.C @ x + e, r)
        state = decision.state
        inputs.append(decision.u)
        x = plant.A @ x + plant.B @ (decision.u - plant.u_op)
    return np.array(inputs)


def assert_keeps_rules(rules, limits, inputs):
    changes = np.diff(inputs, axis=0)
    # Strictly, and without what could be rounding.
    for moves in (changes != 0, np.abs(changes) > 1e-9):
        if rules.max_moves is not None:
            assert fullest_window(rules, moves) <= rules.max_moves
        assert keeps_dwell(moves, rules.dwell)
        if rules.max_moves_per_step is not None:
            assert (moves.sum(axis=1) <= rules.max_moves_per_step).all()
    assert (np.abs(changes[changes != 0]) >= rules.min_size - 1e-9).all()
    assert (inputs >= limits.u_min).all()
    assert (inputs <= limits.u_max).all()
    assert (np.abs(changes) <= limits.du_max + 1e-9).all()


def fullest_window(rules, moves):
    """The most moves that any window of ns samples holds."""
    starts = range(len(moves) - rules.sparsity_horizon + 1)
    return max(counted(moves[at : at + rules.sparsity_horizon], rules.counting) for at in starts)


@with_either_estimator
@given(loop=loops())
@settings(max_examples=examples(100, quick=15), deadline=None)
def test_applied_moves_of_the_exact_method_keep_the_rules(loop):
    assert_keeps_rules(loop[1], loop[0].limits, applied(*loop, "exact"))


@with_either_estimator
@mostly_load_bank
@pytest.mark.parametrize("method", [name for name in POLISHED if name != "exact"])
@given(loop=loops())
@settings(max_examples=examples(20, quick=3), deadline=None)
def test_applied_moves_of_the_other_methods_keep_the_rules(method, loop):
    assert_keeps_rules(loop[1], loop[0].limits, applied(*loop, method))


@pytest.mark.parametrize("method", POLISHED)
def test_the_budget_is_spent_and_dwell_times_end(method):
    """Rules are not kept by standing still."""
    rng, model = np.random.default_rng(1), random_model(1)
    problem = mampc.TrackingProblem(model, prediction_horizon=6, control_horizon=3)
    reference, noise = model.y_op + rng.standard_normal((STEPS, 2)), 0.3 * rng.standard_normal((STEPS, 2))
    rules = mampc.MoveRules(max_moves=3, sparsity_horizon=5)
    moves = np.diff(applied(problem, rules, model, reference, noise, method), axis=0) != 0
    assert fullest_window(rules, moves) == 3
    rules = mampc.MoveRules(dwell=4)
    moves = np.diff(applied(problem, rules, model, reference, noise, method), axis=0) != 0
    assert any((np.diff(np.flatnonzero(of_input)) == 4).any() for of_input in moves.T)


@with_either_estimator
@mostly_load_bank
@pytest.mark.parametrize("method", POLISHED)
@pytest.mark.parametrize("counting", ["elementwise", "simultaneous"])
def test_after_manual_operation_no_move_is_made_until_the_window_has_room(method, counting):
    rng, model = np.random.default_rng(2), random_model(2)
    problem = mampc.TrackingProblem(model, prediction_horizon=6, control_horizon=3)
    rules = mampc.MoveRules(max_moves=2, sparsity_horizon=6, counting=counting, dwell=2)
    regulator = mampc.Regulator(mampc.MAMPC(problem, rules, method=method, **POLISHED[method]))
    state, inputs = regulator.initial_state(), [model.u_op]
    for sample in range(STEPS):
        y = model.y_op + rng.standard_normal(2)
        decision = regulator.step(state, y, model.y_op + 1.0, u_applied=inputs[-1])
        state = decision.state
        by_hand = sample < 5
        inputs.append(model.u_op + rng.standard_normal(2) if by_hand else decision.u)
        moves = np.diff(inputs, axis=0) != 0
        if not by_hand and moves[-1].any():
            assert counted(moves[-6:], counting) <= 2
            assert keeps_dwell(moves[-2:][:, moves[-1]], 2)
    assert moves[5:].any()
    assert not moves[5:9].any()
