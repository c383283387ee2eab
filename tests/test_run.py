"""What is measured of a run, and how it is written."""

import csv
from dataclasses import replace

import numpy as np
import pytest

import mampc
from builders import tank_problem, tank_reference

TANK = mampc.plants.QuadrupleTank()


def hand_made_run():
    """Five samples, two inputs and one output; y deviates from r by 0, 1, -2, 0, 1."""
    u = np.array([[1.0, 0.0], [1.0, 0.05], [3.0, 0.05], [2.5, 0.0], [2.5, 0.0]])
    y = np.array([[0.0], [1.0], [-2.0], [0.0], [1.0]])
    return mampc.Run(
        t=2.0 * np.arange(5), u=u, y=y, y_measured=y + 0.5, r=np.zeros((5, 1)), u_initial=np.zeros(2),
        decisions=(), dt=2.0, names=mampc.Names(("valve", "pump"), ("level",)), v=np.empty((5, 0)), faults={},
    )  # fmt: skip


@pytest.mark.parametrize(
    ("weight", "expected"),
    [(None, 41.0), (2.0, 82.0), ([1.0, 0.01], 16.25), ([[1.0, 0.1], [0.1, 0.01]], 20.25)],
)
def test_errors_are_weighed_as_told(weight, expected):
    run = replace(hand_made_run(), y=np.tile([4.0, 5.0], (5, 1)), r=np.zeros((5, 2)))
    metrics = run.metrics(output_weight=weight)
    assert metrics.weighted_error == pytest.approx(expected)
    assert metrics.tracking_error == pytest.approx(41.0)


@pytest.mark.parametrize("unit", [1.0, 2.0**-80, 2.0**40])
def test_gaps_are_shares_of_costs_in_whatever_unit(unit):
    controller = mampc.MPC(tank_problem())
    made = controller.step(controller.initial_state(), np.zeros(4), tank_reference(1)[0])
    costs = [(4.0, 3.0), (2.0, 2.0), (np.nan, -np.inf), (8.0, -np.inf), (1e-30, 0.0)]
    decisions = tuple(made._replace(objective=unit * cost, lower_bound=unit * bound) for cost, bound in costs)
    np.testing.assert_allclose(
        replace(hand_made_run(), decisions=decisions).gaps, [0.25, 0.0, np.nan, np.inf, 1.25e-19]
    )


def test_metrics_equal_those_worked_out_by_hand():
    metrics = hand_made_run().metrics(threshold=0.1)  # changes: (1, 0), (0, .05), (2, 0), (-.5, -.05), (0, 0)
    np.testing.assert_allclose(metrics.sparse_density, [3 / 5, 0.0])
    np.testing.assert_allclose(metrics.exact_density, [3 / 5, 2 / 5])
    np.testing.assert_array_equal(metrics.moves, [3, 2])
    assert metrics.tracking_error == pytest.approx(6 / 5)
    np.testing.assert_allclose(metrics.travel, [3.5, 0.1])
    np.testing.assert_array_equal(metrics.reversals, [1, 1])
    np.testing.assert_allclose(metrics.mean_hold_time, [10 / 4, 10 / 3])
    assert (metrics.steps, metrics.skipped, metrics.threshold) == (5, 0, 0.1)


def test_metrics_without_the_first_samples_equal_those_worked_out_by_hand():
    metrics = hand_made_run().metrics(threshold=0.0, skip=2)
    np.testing.assert_allclose(metrics.sparse_density, [2 / 3, 1 / 3])
    np.testing.assert_allclose(metrics.exact_density, [2 / 3, 1 / 3])
    assert metrics.tracking_error == pytest.approx(5 / 3)
    np.testing.assert_allclose(metrics.travel, [2.5, 0.05])
    np.testing.assert_array_equal(metrics.reversals, [1, 0])
    assert (metrics.steps, metrics.skipped) == (3, 2)


@pytest.mark.parametrize("options", [{"skip": 5}, {"skip": -1}, {"threshold": -0.1}, {"threshold": np.nan}])
def test_metrics_refuse_settings_out_of_range(options):
    with pytest.raises(mampc.MampcError, match=r"expected.*received"):
        hand_made_run().metrics(**options)


def test_a_run_is_written_with_all_its_columns_in_full_precision(tmp_path):
    run = mampc.simulate(TANK, mampc.Regulator(mampc.MPC(tank_problem())), tank_reference(8), noise=0.1)
    run.to_csv(tmp_path / "run.csv")
    with (tmp_path / "run.csv").open(newline="", encoding="utf-8") as file:
        header, *rows = csv.reader(file)
    assert header == [
        "time", "u1", "u2", "y1", "y2", "y1_measured", "y2_measured", "y1_reference", "y2_reference",
        "status", "objective", "lower_bound", "iterations", "solve_time_us", "remarks", "ignored", "load", "variant",
    ]  # fmt: skip
    numbers = np.array([row[:9] for row in rows], dtype=float)
    np.testing.assert_array_equal(numbers, np.column_stack([run.t, run.u, run.y, run.y_measured, run.r]))
    assert [row[9] for row in rows] == ["optimal"] * 8
    assert [float(row[10]) for row in rows] == [decision.objective for decision in run.decisions]
    assert list(tmp_path.iterdir()) == [tmp_path / "run.csv"]


def test_the_gaps_of_a_run_are_shares_of_its_objectives():
    problem = tank_problem()
    rules = mampc.MoveRules(max_moves=3)
    gaps = {}
    for certify in (False, True):
        controller = mampc.MAMPC(problem, rules, method="greedy", certify=certify)
        gaps[certify] = mampc.simulate(
            problem.model, mampc.Regulator(controller), problem.model.y_op + 1.0, steps=20, progress=False
        ).gaps
    assert np.isinf(gaps[False]).all()
    assert ((gaps[True] >= 0) & (gaps[True] < 1)).all()
    assert (gaps[True] == 0).any()
