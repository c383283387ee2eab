"""What tuning promises: kinds of load that count alike, and the price that keeps it."""

import numpy as np
import pytest

import mampc
from mampc.compare import promise, tuning
from mampc.compare.fronts import Point
from mampc.compare.scenarios import scenario_length
from mampc.program.condensing import CondensedQP
from mampc.program.usual import usual_problem


def in_turn(*errors):
    """A setting with these errors under kinds of load in turn, in eight scenarios each, and plain MPC with 1."""
    errors = np.tile(errors, 8)
    return Point("", 1.0, errors + 3.0, errors), Point(
        "", 0.0, np.full(len(errors), 9.0), np.ones(len(errors))
    )


def test_kinds_of_load_count_alike_and_a_better_one_makes_up_for_no_other():
    point, base = in_turn(0.0, 3.0)
    assert promise.ratio_over_kinds(point, base, 2).value == pytest.approx(2.0)
    assert promise.ratio_over_kinds(point, base).value == pytest.approx(1.5)
    large = Point("", 1.0, point.moves, point.error * np.tile([1.0, 100.0], 8))
    under = Point("", 0.0, base.moves, np.tile([1.0, 100.0], 8))
    assert promise.ratio_over_kinds(large, under, 2).value == pytest.approx(2.0)


def test_a_kind_of_load_with_more_error_than_allowed_is_named():
    goal, kinds = promise.Goal(0.25, None, hours=1.0), [(mampc.loads.RandomWalk(size=1.0),), ()]
    text = str(promise.Expected.of(*in_turn(1.4, 0.9), goal, kinds))
    assert "More than the 1.25 allowed under random walk: where your plant has no other loads" in text
    assert "no load 0.90" in text
    assert "More than" not in str(promise.Expected.of(*in_turn(1.2, 1.1), goal, kinds))


@pytest.mark.parametrize("falls", [False, True])
def test_the_price_aimed_at_is_the_highest_that_keeps_the_allowance_or_one_beyond_a_swing(falls):
    """Cheap moves may drive a plant off its model to and fro, so that errors fall with the price."""
    base = in_turn(1.0)[1]
    errors = [3.0, 2.0, 1.1] if falls else [1.0, 1.1, 2.0]
    points = [Point("", 10.0**k, np.full(8, 8.0 / 2**k), np.full(8, error)) for k, error in enumerate(errors)]
    worth, price = promise.Goal(0.25, None).at_aim(points, base)
    assert price == pytest.approx(100.0) if falls else 10.0 < price < 100.0
    assert worth <= np.log(4.0)


def test_the_price_is_the_one_nearest_to_what_is_allowed():
    def run(price):
        return Point("", price, np.ones(8), np.full(8, price))

    base, goal = in_turn(1.0)[1], promise.Goal(0.25, None)
    for begun in (0.5, 1.1, 1.2, 3.0):
        price, _, kept = tuning._nearest(goal, begun, run, base)
        assert kept
        assert price <= 1.25
        assert price > 1.0 or begun == 0.5  # a few steps up at most


@pytest.mark.parametrize("late", [0, 12])
def test_plain_mpc_of_an_unstable_model_looks_no_further_than_its_errors_grow_tenfold(late):
    A, B = np.eye(2 + late, k=1), np.eye(2 + late)[:, -1:]
    A[:2, :3] = np.array([[1.04, 0.1, 0.0], [0.0, 0.7, 1.0]])[:, : 2 + min(late, 1)]
    model = mampc.StateSpace(A, B, np.eye(2 + late)[:1], None, 2.0)
    problem = usual_problem(model, mampc.Limits(u_min=-1.0, u_max=1.0), 1.0)
    assert problem.prediction_horizon == 59  # 1.04**59 > 10
    assert scenario_length(problem) <= 295
    assert np.abs(CondensedQP(problem).closed_loop_poles()).max() < 0.99


def test_the_usual_horizon_of_a_level_sees_as_much_behind_any_dead_time():
    def of(dead_time):
        model = mampc.StateSpace.from_first_order(gain=1.0, time_constant=np.inf, dead_time=dead_time, dt=1.0)
        return usual_problem(model, mampc.Limits(u_min=-1.0, u_max=1.0), 1.0)

    at_once = of(0.0)
    for dead_time in (5.0, 12.0, 60.0):
        problem = of(dead_time)
        assert problem.prediction_horizon == at_once.prediction_horizon + dead_time
        np.testing.assert_allclose(problem.move_weight, at_once.move_weight, rtol=1e-9)
