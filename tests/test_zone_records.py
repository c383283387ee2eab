"""Zones told while a loop runs: recorded, replayed, filtered, counted from; alone, in batches and in studies."""

import json

import numpy as np
import pytest

import mampc
from builders import random_model
from mampc.compare.candidates import candidates
from mampc.compare.scenarios import Scenarios, Surroundings
from mampc.report.summary import summarise
from mampc.report.tables import comparison_tables
from mampc.study import parse_study, run_study, template

INF = np.inf
SMOOTH = mampc.ReferenceFilter(time_constant=3.0, rate=0.2)
PRICE = mampc.MoveRules(price=0.05)


def regulator(model, smooth=None, rules=PRICE, counts=None, **zone):
    zone = {"zone_below": [0.2, 0.0], "zone_above": [0.3, 0.0]} | zone
    limits = mampc.Limits(u_min=model.u_op - 5, u_max=model.u_op + 5)
    problem = mampc.TrackingProblem(model, prediction_horizon=8, control_horizon=3, limits=limits, **zone)
    controller = mampc.MPC(problem) if rules is None else mampc.MAMPC(problem, rules)
    return mampc.Regulator(controller, reference_filter=smooth, value_of_information=counts)


def moving_zone(model, T=30):
    """A range that moves, loses an end and finds it again; the second output has a set point."""
    low, high = np.tile(model.y_op, (2, T, 1))
    low[:, 0] -= 0.3
    high[:, 0] += 0.3
    low[8:] += 1.0
    high[8:] += 1.0
    high[15:22, 0] = INF
    return mampc.Zone(low, high)


@pytest.mark.parametrize("preview", [False, True])
@pytest.mark.parametrize("smooth", [None, SMOOTH], ids=["plain", "filtered"])
def test_a_zone_told_is_recorded_and_replays_follow(tmp_path, smooth, preview):
    model = random_model(3)
    run = mampc.simulate(model, regulator(model, smooth), moving_zone(model), noise=0.05, preview=preview)
    run.to_csv(tmp_path / "run.csv")
    recording = mampc.Recording.from_csv(tmp_path / "run.csv", model.names)
    np.testing.assert_array_equal(recording.zone.high, moving_zone(model).high)
    again = regulator(model, smooth)
    start = again.initial_state(model.u_op, model.y_op)
    assert mampc.replay(again, start, recording, preview=preview, tolerance=0.0) is None


def test_only_zones_that_were_told_have_columns(tmp_path):
    model = random_model(3)
    mampc.simulate(model, regulator(model), model.y_op, steps=3).to_csv(tmp_path / "run.csv")
    assert "zone" not in (tmp_path / "run.csv").read_text().splitlines()[0]


@pytest.mark.parametrize("rules", [None, PRICE], ids=["mpc", "price"])
@pytest.mark.parametrize("smooth", [None, SMOOTH], ids=["plain", "filtered"])
@pytest.mark.parametrize("preview", [False, True])
def test_many_loops_are_told_the_zone_as_one_is(rules, smooth, preview):
    model = random_model(3)
    ours = regulator(model, smooth, rules)
    batch = mampc.simulate_batch(
        model, ours, moving_zone(model), seeds=[0, 1], noise=0.05, preview=preview, progress=False
    )
    for seed in range(2):
        run = mampc.simulate(model, ours, moving_zone(model), seed=seed, noise=0.05, preview=preview)
        np.testing.assert_allclose(batch.u[seed], run.u, atol=1e-9)
        np.testing.assert_array_equal(batch[seed].zone.low, run.zone.low)
        assert batch.metrics().time_outside[seed, 0] == run.metrics().time_outside[0]


def test_a_zone_of_no_width_is_filtered_as_a_set_point_is():
    model = random_model(3)
    rows = mampc.steps(25, model.y_op, [(5, model.y_op + 1.0)])
    widths = {"zone_below": [0.2, 0.0], "zone_above": 0.0}
    point = mampc.simulate(
        model, regulator(model, SMOOTH, counts=False, zone_below=0.0, zone_above=0.0), rows
    )
    zone = mampc.simulate(model, regulator(model, SMOOTH, **widths), mampc.Zone(rows, rows))
    np.testing.assert_allclose(zone.u, point.u, atol=1e-7)


def test_both_ends_of_a_zone_are_led_to_where_they_are_asked():
    fitted = mampc.ReferenceFilter(rate=0.1).fitted(1, 1.0)
    update = {"samples": 9, "restart": False}
    y = np.array([5.0])
    zone, ends = fitted.update(np.array([5.0]), mampc.Zone([6.0], [8.0]), y=y, **update)
    np.testing.assert_allclose(ends[:, 0], [5.1, 8.0])  # the output is below: this end starts from there
    np.testing.assert_allclose(zone.low[:, 0], 5.1 + 0.1 * np.arange(9))
    _, ends = fitted.update(ends, mampc.Zone([6.0], [INF]), y=y, **update)
    _, ends = fitted.update(ends, mampc.Zone([-INF], [3.0]), y=y, **update)
    assert ends[0, 0] < -1e9
    assert ends[1, 0] == pytest.approx(
        5.1
    )  # led down from where the lower end was, so that they do not cross
    course, tracked = fitted.update(ends, np.array([7.0]), y=y, **update)  # set points again: from the output
    np.testing.assert_allclose(course[:2, 0], [5.1, 5.2])
    assert tracked.shape == (1,)


def test_ends_never_cross():
    rng = np.random.default_rng(0)
    for smooth in (SMOOTH, mampc.ReferenceFilter(time_constant=4.0), mampc.ReferenceFilter(rate=0.3)):
        fitted, last = smooth.fitted(2, 1.0), np.zeros(2)
        for _ in range(60):
            low = rng.choice([-INF, *rng.normal(size=2)], 2)
            high = np.maximum(rng.choice([INF, *rng.normal(size=2)], 2), low)
            zone, last = fitted.update(
                last, mampc.Zone(low, high), 6, rng.normal(size=2), restart=rng.random() < 0.1
            )
            assert (zone.low <= zone.high).all()


def test_a_filtered_zone_is_kept_as_text_and_needs_smaller_moves():
    model = random_model(3)
    moved = {}
    for smooth in (None, SMOOTH):
        ours = regulator(model, smooth, None)
        run = mampc.simulate(model, ours, moving_zone(model))
        moved[smooth] = np.abs(np.diff(run.u, axis=0)).max()
    assert moved[SMOOTH] < 0.8 * moved[None]
    decision = ours.step(
        ours.initial_state(), model.y_op, mampc.Zone(model.y_op, model.y_op + np.array([1.0, 0.0]))
    )
    text = decision.state.to_json()
    assert ours.state_from_json(text).to_json() == text


def test_errors_count_from_the_zone():
    model = random_model(3)
    run = mampc.simulate(model, regulator(model), model.y_op + np.array([0.5, 0.0]), steps=40, noise=0.05)
    metrics = run.metrics()
    low, high = run.r - np.array([0.2, 0.0]), run.r + np.array([0.3, 0.0])
    off = np.maximum(low - run.y, 0) + np.maximum(run.y - high, 0)
    assert metrics.tracking_error == pytest.approx((off**2).sum(axis=1).mean())
    assert metrics.time_outside[0] == (off[:, 0] > 0).mean()
    assert metrics.mean_distance_outside[0] == pytest.approx(off[off[:, 0] > 0, 0].mean())
    assert np.isnan(metrics.time_outside[1])
    point = mampc.simulate(
        model, regulator(model, zone_below=0.0, zone_above=0.0), model.y_op + 0.5, steps=40
    )
    assert point.zone is None
    assert point.metrics().tracking_error == pytest.approx(((point.y - point.r) ** 2).sum(axis=1).mean())


def test_time_outside_is_of_the_samples_that_have_a_zone():
    model = random_model(3)
    zone = moving_zone(model)
    low, high = zone.low.copy(), zone.high.copy()
    low[20:] = high[20:] = model.y_op
    run = mampc.simulate(model, regulator(model), mampc.Zone(low, high), noise=0.05)
    off = (run.y < low) | (run.y > high)
    assert run.metrics().time_outside[0] == pytest.approx(off[:20, 0].mean())
    assert run.metrics(skip=10).time_outside[0] == pytest.approx(off[10:20, 0].mean())
    assert np.isnan(run.metrics(skip=20).time_outside[0])


def test_scenarios_of_tuning_count_from_the_zone():
    model = random_model(3)
    plain = regulator(model, rules=None)
    around = Surroundings.of(plain.controller.problem, 0.05, None, ())
    scenarios = Scenarios.drawn(plain, around, 2, (0, 1))
    _, error = scenarios.run(plain)
    batch = mampc.simulate_batch(
        scenarios.plants, plain, scenarios.reference, seeds=scenarios.seeds, noise=scenarios.noise,
        u_initial=scenarios.u_initial, progress=False,
    )  # fmt: skip
    np.testing.assert_allclose(error, batch.metrics().tracking_error)
    found = candidates(plain.controller.problem, np.full(2, 0.05))  # each without and with a pull
    assert {one.problem.zone_pull for one in found} == {0.0, 0.1}


def test_a_bank_counts_from_the_zone_of_the_variant_that_decides():
    model = random_model(3)
    bank = mampc.ControllerBank(
        {str(width): regulator(model, zone_below=width).controller for width in (0.1, 0.4)}
    )
    names = ["0.1"] * 4 + ["0.4"] * 4
    run = mampc.simulate(model, mampc.Regulator(bank), model.y_op, steps=8, variant=names)
    np.testing.assert_allclose((run.r - run.zone.low)[:, 0], [0.1] * 4 + [0.4] * 4)


@pytest.mark.parametrize(
    ("zone", "said"),
    [
        (mampc.Zone([0.0], [1.0]), "Zone of shape"),
        (mampc.Zone([0.0, 0.0], [1.0, 1.0]), "ranges only of outputs that have a zone"),
        (mampc.Zone(np.empty((0, 2)), np.empty((0, 2))), "Zone of shape"),
    ],
)
def test_zones_that_do_not_fit_are_refused_before_the_loop_begins(zone, said):
    model = random_model(3)
    with pytest.raises(mampc.MampcError, match=said):
        mampc.simulate(model, regulator(model), zone, steps=5)


SHORT = (
    template().replace("steps = 145", "steps = 30").replace("skip = 15", "skip = 5").replace("at = 50", "at = 8")
    .replace("at = 100", "at = 20").replace("# zone_below", "zone_below").replace("# zone_above", "zone_above")
    .replace("prbs_order = 8", "prbs_order = 6")
)  # fmt: skip


def test_a_study_changes_its_zones_and_says_what_errors_count_from(tmp_path):
    told = "zones = [{ at = 15, below = 0.1, above = [inf, 0.4] }]\n\n[[scenarios]]"
    study = parse_study(SHORT.replace("[[scenarios]]", told, 1))
    study = study.model_copy(update={"controllers": study.controllers[:1]})
    result = run_study(study)
    run = result.runs["noisy"]["MPC"]
    assert (run.zone.high[15:, 0] == INF).all()
    assert np.isfinite(run.zone.high[:15]).all()
    summary = json.loads(json.dumps(summarise(result)))
    assert 0 <= summary["scenarios"][0]["controllers"][0]["time_outside_per_output"][0] <= 1
    headers = [str(column.header) for column in comparison_tables(study, summary)[0].columns]
    assert {"distance²\noutside", "time\noutside", "mean distance\noutside"} <= set(headers)
    assert "tracking\nerror" not in headers


def test_a_study_says_which_widths_it_expects():
    with pytest.raises(mampc.StudyError, match="widths of 2 outputs"):
        told = "zones = [{ at = 15, below = [0.1, 0.1, 0.1], above = 0.1 }]\n\n[[scenarios]]"
        run_study(parse_study(SHORT.replace("[[scenarios]]", told, 1)))
