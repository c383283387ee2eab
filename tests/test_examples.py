"""The studies in `examples/` run, and show what they say."""

from pathlib import Path

import numpy as np
import pytest

import mampc
from mampc.study import load_study, parse_study, run_study

EXAMPLES = Path(__file__).parents[1] / "examples"


@pytest.fixture(scope="module")
def found():
    """The runs of an example by its name, each example run once."""
    known = {}

    def runs(name, steps=None):
        if name not in known:
            study = load_study(EXAMPLES / f"{name}.toml")
            known[name] = run_study(study if steps is None else study.model_copy(update={"steps": steps}))
        return known[name].runs

    return runs


def largest_move(run):
    return np.abs(np.diff(run.u, axis=0, prepend=run.u_initial[None])).max(axis=0)


def test_filtered_references_need_smaller_moves(found):
    runs = found("reference-filter")["noise-free"]
    assert (largest_move(runs["MPC with a ramp"]) < largest_move(runs["MPC"]) / 3).all()
    assert (largest_move(runs["price with a lag"]) < largest_move(runs["price"]) / 2).all()


def test_the_small_valve_returns_to_its_resting_value(found):
    runs = found("resting-values")["with a load"]
    for run in runs.values():
        for changed in (120, 180):  # just before the next change
            assert run.u[changed - 1, 1] == pytest.approx(50.0, abs=3.0)
            assert run.y[changed - 10 : changed].mean() == pytest.approx(run.r[changed - 1, 0], abs=0.7)
    assert runs["MPC"].u[12, 1] > 55.0  # it helps while it is needed
    moves = {name: run.metrics(threshold=0.1).moves.sum() for name, run in runs.items()}
    assert moves["price"] < 0.1 * moves["MPC"]


def test_levels_that_may_float_need_fewer_moves():
    text = (EXAMPLES / "zone.toml").read_text()
    points = text.replace("zone_below = 0.5\nzone_above = 0.5\n", "")
    assert points != text
    moves = []
    for study in (text, points):
        runs = run_study(parse_study(study)).runs["with loads"]
        moves.append([runs[name].metrics(threshold=0.1).moves.sum() for name in ("MPC", "price")])
    (mpc, price), (mpc_at_points, price_at_points) = moves
    assert mpc < 0.6 * mpc_at_points
    assert price < 0.8 * price_at_points


def test_an_on_off_heater_keeps_its_times_and_starts(found):
    runs = found("on-off", steps=100)["noisy"]  # before its reference changes
    u = runs["six starts an hour"].u[:, 0]
    switched = np.flatnonzero(np.diff(u) != 0) + 1
    is_on = u[switched] == 1.0
    assert (np.diff(switched)[is_on[:-1]] >= 3).all()
    assert (np.diff(switched)[~is_on[:-1]] >= 2).all()
    starts = switched[is_on]
    assert all(((starts > t - 60) & (starts <= t)).sum() <= 6 for t in starts)
    for name in ("on/off", "on/off with times", "six starts an hour"):
        assert set(runs[name].u.ravel().tolist()) == {0.0, 1.0}
        assert runs[name].y[60:100].mean() == pytest.approx(22.0, abs=0.5)
    assert set(runs["quarters"].u.ravel().tolist()) <= {0.0, 0.25, 0.5, 0.75, 1.0}


def test_the_more_important_level_stays_within_its_limit():
    text = (EXAMPLES / "ranks.toml").read_text()
    unranked = text.replace("output_rank = [2, 1]", "")
    assert unranked != text
    for study, kept in ((text, True), (unranked, False)):
        path = load_study(EXAMPLES / "ranks.toml").place
        runs = run_study(parse_study(study).model_copy(update={"place": path})).runs["noise-free"]
        for run in runs.values():
            assert run.y[-1, 0] < 22.0 or not kept
            assert (run.y[-1, 1] <= 41.0 + 1e-6) == kept


def test_a_slider_is_brisk_where_it_was_asked_to_be_and_calm_elsewhere(found, tmp_path):
    runs = found("operators-slider")["a day"]
    slider, brisk = slice(65, 120), runs["brisk"]
    assert [d.variant for d in runs["slider"].decisions[slider]] == ["brisk"] * 55

    def moves(run, part):
        return np.count_nonzero(np.diff(run.u, axis=0, prepend=run.u_initial[None])[part])

    def error(run, part):
        return ((run.y - run.r)[part] ** 2).sum(axis=1).mean()

    np.testing.assert_array_equal(runs["slider"].u[:65], runs["calm"].u[:65])
    calm, ours = runs["calm"], runs["slider"]
    assert error(ours, slider) < 0.9 * error(calm, slider)
    assert moves(calm, slice(None)) < moves(ours, slice(None)) < moves(brisk, slice(None))
    path = tmp_path / "a-day_slider.csv"
    ours.to_csv(path)
    assert set(mampc.Recording.from_csv(path, ours.names).variant) == {"calm", "brisk"}


def test_compensated_valves_need_fewer_moves_at_a_smaller_error(found):
    for runs in found("sticking-valves").values():
        moves = {name: run.metrics(threshold=0.0).moves.sum() for name, run in runs.items()}
        errors = {name: run.metrics(skip=15).tracking_error for name, run in runs.items()}
        assert moves["compensated price"] < 0.85 * moves["price"]
        assert errors["compensated price"] < 0.9 * errors["price"]
