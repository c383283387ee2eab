"""Tuning by one knob: what it promises, and on which models."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import mampc
from builders import tank_model
from mampc.compare import candidates, promise, scenarios, tuning
from mampc.compare.candidates import is_dear
from mampc.compare.rounds import Rounds
from mampc.compare.scenarios import scenario_length
from mampc.compare.tuned_study import study_of_model, with_tuning
from mampc.program.usual import dead_samples, settling, usual_problem
from mampc.study import load_study, parse_study
from mampc.study.regulators import regulator_of
from mampc.study.writing import study_text
from seeds import deep
from small_tuning import few_and_short, lag


@pytest.fixture(scope="module", autouse=True)
def _few_and_short():
    with few_and_short():
        yield


def tuned(model, **settings):
    settings = {"limits": mampc.Limits(u_min=-10.0, u_max=10.0), "jobs": 1, "progress": False} | settings
    return mampc.tune(model, **settings)


@cache
def tuned_tank(noise):
    return tuned(tank_model(), limits=mampc.Limits(u_min=0.0, u_max=100.0), noise=noise)


@pytest.fixture(scope="module")
def tank():
    limits = mampc.Limits(u_min=0.0, u_max=100.0)
    return tuned(tank_model(), limits=limits, noise=0.1, reference_changes=2.0)


def test_the_promise_is_kept_as_a_mean_on_plants_that_were_not_seen(tank):
    model = tank_model()
    assert tank.reached
    expected = tank.expected
    assert expected.error_ratio.value + expected.error_ratio.standard_error <= 1.25
    assert expected.moves_per_hour.value < 0.2 * expected.plain_moves_per_hour.value
    seeds = range(1000, 1012)
    plants = [mampc.Mismatch(gain=0.15, lag=0.15, dead_time=0.15).drawn(model, seed) for seed in seeds]
    levels = model.y_op + np.random.default_rng(7).uniform(-1, 1, (12, 4, 2)) * [2.0, 2.0]
    reference = np.repeat(levels, 20, axis=1)
    loops = {"seeds": seeds, "noise": tank.noise, "progress": False}
    errors = [
        mampc.simulate_batch(plants, regulator, reference, **loops).metrics().tracking_error
        for regulator in (tank.regulator, tank.baseline)
    ]
    ratio = errors[0].mean() / errors[1].mean()
    spread = (errors[0] - ratio * errors[1]).std(ddof=1) / np.sqrt(12) / errors[1].mean()
    assert ratio - 2 * spread <= 1.25


def test_what_is_found_can_be_used_at_other_prices(tank):
    assert tank.regulator.controller.rules == tank.rules
    assert tank.rules.price > 0
    assert tank.problem.control_horizon == 3
    calm = tank.at_price(10 * tank.rules.price)
    assert calm.controller.rules.price == 10 * tank.rules.price
    assert [point.error_ratio.value for point in tank.front] == sorted(
        point.error_ratio.value for point in tank.front
    )
    assert "means over 8 scenarios" in str(tank.expected)
    ratios = [ratio.value for ratio in tank.expected.by_load]
    assert len(ratios) == len(tank.loads)
    assert tank.expected.error_ratio.value == pytest.approx(np.mean(np.maximum(ratios, 1.0)))
    assert f"random steps {ratios[0]:.2f}, random walk {ratios[1]:.2f}" in str(tank.expected)
    assert "standard error" in str(tank.expected)


def test_a_seed_decides_everything_and_progress_counts_closed_loops_up_to_all_of_them():
    seen = []
    a, c = (tuned(lag(), seed=seed) for seed in (3, 4))
    b = tuned(lag(), seed=3, on_task=lambda *counts: seen.append(counts))
    done = [count for count, _ in seen]
    assert done == sorted(done)
    assert seen[-1][0] == seen[-1][1]
    assert len(seen) > 6
    assert a.rules == b.rules
    assert a.rows == b.rows
    assert a.expected == b.expected
    assert a.rows != c.rows


@pytest.mark.parametrize("noise", [None, *deep(0.05)])
def test_units_decide_nothing(noise):
    model = tank_model()
    of_u, of_y = np.array([4.0, 0.125]), np.array([2.0, 64.0])  # powers of two: the same digits
    scaled = replace(
        model, B=model.B / of_u, C=model.C * of_y[:, None], D=model.D * of_y[:, None] / of_u,
        u_op=model.u_op * of_u, y_op=model.y_op * of_y,
    )  # fmt: skip
    low, high = np.zeros(2), np.full(2, 100.0)
    a = tuned_tank(noise)
    b = tuned(
        scaled, limits=mampc.Limits(u_min=low * of_u, u_max=high * of_u), output_weight=1 / of_y**2,
        noise=None if noise is None else noise * of_y,
    )  # fmt: skip
    assert b.rules.price == pytest.approx(a.rules.price, rel=1e-6)
    assert b.expected.moves_per_hour.value == pytest.approx(a.expected.moves_per_hour.value, rel=1e-6)
    assert b.expected.error_ratio.value == pytest.approx(a.expected.error_ratio.value, rel=1e-6)
    np.testing.assert_allclose(b.noise, a.noise * of_y, rtol=1e-9)
    np.testing.assert_allclose(
        np.diag(b.problem.move_weight), np.diag(a.problem.move_weight) / of_u**2, rtol=1e-9
    )


@pytest.mark.parametrize(
    "model",
    [
        lag(gain=[[0.01]], time_constant=np.inf, dead_time=20.0),
        lag(dead_time=80.0),
        mampc.StateSpace.from_first_order(  # a lag that answers the wrong way first
            gain=[[3.0, -1.0], [0.5, 2.0], [1.0, 1.0]], time_constant=[[60, 10], [40, 50], [30, 30]], dt=10.0
        ),
    ],
    ids=["integrating", "delayed", "more outputs than inputs"],
)
def test_every_kind_of_model_is_tuned(model):
    found = tuned(model)
    assert found.expected.error_ratio.value <= 1.25
    assert found.expected.moves_per_hour.value < found.expected.plain_moves_per_hour.value


def test_the_horizon_covers_what_step_responses_take_to_settle():
    assert settling(lag()) == pytest.approx(50 / 10 * np.log(20), abs=1)
    assert settling(lag(dead_time=80.0)) == settling(lag()) + 8
    assert settling(lag(time_constant=np.inf)) <= 2
    position = mampc.StateSpace([[1.0, 1.0], [0.0, 1.0]], [[0.5], [1.0]], [[1.0, 0.0]], None, 1.0)
    assert dead_samples(position) == 0  # the response grows as the square of time
    problem = usual_problem(lag(dead_time=80.0), mampc.Limits(), 1.0)
    assert problem.prediction_horizon == settling(lag()) + 8
    far = usual_problem(lag(dead_time=600.0), mampc.Limits(u_min=-1.0, u_max=1.0), 1.0)
    assert far.prediction_horizon == settling(lag()) + 60
    assert scenario_length(far) == 480
    assert usual_problem(lag(time_constant=1e5), mampc.Limits(), 1.0).prediction_horizon == 60


@pytest.mark.parametrize(("inputs", "samples"), [(1, 3), (3, 3), (4, 2), (6, 2)])
def test_plans_have_moves_at_two_samples_at_least(inputs, samples):
    model = lag(gain=np.eye(inputs), time_constant=np.full((inputs, inputs), 50.0))
    problem = usual_problem(model, mampc.Limits(u_min=-1.0, u_max=1.0), 1.0)
    found = candidates.candidates(problem, np.full(inputs, 0.01))
    assert {one.problem.control_horizon for one in found} == {samples}


def test_moves_per_hour_can_be_asked_for():
    found = tuned(lag(), max_moves_per_hour=40.0)
    assert found.reached
    moves = found.expected.moves_per_hour
    assert moves.value + moves.standard_error <= 40


def test_what_cannot_be_reached_is_told_and_the_calmest_is_given(monkeypatch):
    monkeypatch.setattr(tuning, "SEARCH_SPAN", (1e-3, 1e-2))
    monkeypatch.setattr(tuning, "STEPS", (1, 2))
    found = tuned(lag(), max_moves_per_hour=1e-3)
    assert not found.reached
    assert found.expected.moves_per_hour.value < found.expected.plain_moves_per_hour.value
    assert found.at_price(1.0).controller.rules.price == 1.0


def test_where_nothing_keeps_the_allowance_plain_mpc_stays(monkeypatch):
    monkeypatch.setattr(promise.Goal, "keeps", lambda *_: False)
    monkeypatch.setattr(tuning, "STEPS", (1,))
    found = tuned(lag())
    assert not found.reached
    assert found.rules.price == 0
    assert found.problem is found.baseline.controller.problem
    assert found.expected.error_ratio.value == 1
    assert found.front == ()
    decision = found.regulator.step(found.regulator.initial_state(), [0.0], [1.0])
    assert np.isfinite(decision.u).all()


@pytest.mark.parametrize(
    ("rules", "settings"),
    [
        ({"min_size": 0.5}, {}),
        ({"dwell": 3}, {}),
        ({"levels": 2.5}, {}),
        ({"levels": mampc.OnOff(min_on=20.0)}, {"max_moves_per_hour": 60.0}),
    ],
    ids=["least size", "dwell", "step", "on or off"],
)
def test_rules_hold_at_the_price_found_and_errors_are_beside_the_same_rules(rules, settings, monkeypatch):
    rules = mampc.MoveRules(**rules)
    if is_dear(usual_problem(lag(), mampc.Limits(), 1.0), rules):
        monkeypatch.setattr(tuning, "DEAR_ROUNDS", Rounds(2, 1, 2, 1, 2))
        monkeypatch.setattr(candidates, "TAILS", (0.25,))
        monkeypatch.setattr(scenarios, "LENGTHS", (20, 20))
    found = tuned(lag(), rules=rules, **settings)
    assert replace(found.rules, price=0.0) == rules
    assert found.baseline.controller.rules == rules
    assert "the rules alone" in str(found.expected)
    run = mampc.simulate(lag(), found.regulator, mampc.steps(40, [0.0], [(3, [3.0])]), noise=found.noise)
    changes = np.abs(np.diff(run.u[:, 0]))
    if np.any(rules.min_size):
        assert (changes[changes > 1e-9] >= 0.5 - 1e-9).all()
    if rules.levels == 2.5:
        np.testing.assert_allclose(run.u % 2.5, 0.0, atol=1e-9)
    study = parse_study(study_text(with_tuning(study_of_model(lag(), found, "ruled"), found)))
    assert replace(study.controllers[0].rules.made(), price=0.0) == rules
    assert [table.method for table in study.controllers] in (["exact", "exact"], ["exact"])


def test_rules_without_any_are_plain_mpc():
    assert tuned(lag(), rules=mampc.MoveRules(price=3.0)).expected == tuned(lag()).expected


def test_limits_that_exclude_the_operating_point_are_told():
    assert cautions_of(lag(), noise=0.1) == ()
    (found,) = cautions_of(lag(u_op=[5.0]), low=6.0, high=16.0, noise=0.1)
    assert "the limits of u1, 6 to 16, exclude the model's operating point, 5" in found


def test_what_nobody_told_is_said():
    (found,) = cautions_of(lag(), noise=None)
    assert f"guessed {0.002 * 2.0 * 20.0 * (1 - np.exp(-4.2)):.3g} of y1" in found
    names = mampc.Names(inputs=("u",), outputs=("y",), disturbances=("feed",))
    model = mampc.StateSpace.from_first_order(gain=[[2.0, 1.0]], time_constant=50.0, dt=10.0, names=names)
    (found,) = cautions_of(model, noise=0.1)
    assert "(feed) rest in all scenarios" in found
    assert cautions_of(model, noise=0.1, loads=[mampc.loads.RandomWalk(at="measured", size=0.1)]) == ()


def cautions_of(model, *, low=-10.0, high=10.0, noise=None, loads=None):
    problem = usual_problem(model, mampc.Limits(u_min=low, u_max=high), 1.0)
    return scenarios.cautions(problem, scenarios.Surroundings.of(problem, noise, None, loads))


def test_the_price_chosen_is_on_the_front_and_in_the_rows(tank):
    assert tank.rules.price in [point.price for point in tank.front]
    own = [row for row in tank.rows if row["value"] == tank.rules.price]
    assert {row["controller"] for row in own} == {tank.setting}


def test_loads_and_reference_changes_may_be_told_where_inputs_have_no_limits():
    found = tuned(
        lag(),
        limits=mampc.Limits(),
        noise=0.1,
        reference_changes=1.0,
        loads=[mampc.loads.RandomWalk(size=0.02)],
    )
    assert found.reached
    assert [[load.size for load in kind] for kind in found.loads] == [[0.02]]


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"max_error_increase": 0.1, "max_moves_per_hour": 3.0}, "one of max_error_increase"),
        ({"max_error_increase": 0.0}, "max_error_increase: expected a finite number above 0"),
        ({"max_moves_per_hour": -1}, "max_moves_per_hour"),
        ({"limits": None}, "limits: expected mampc.Limits"),
        ({"limits": mampc.Limits(u_min=0.0)}, "u_min and u_max"),
        ({"noise": [0.1, 0.1, 0.1]}, "noise"),
        ({"noise": 0.0}, "noise: expected numbers above 0"),
        ({"reference_changes": -1.0}, "reference_changes"),
        ({"loads": [3]}, "loads"),
        ({"loads": 3}, "loads"),
        ({"seed": -1}, "seed"),
        ({"baseline": "mpc"}, "baseline"),
        ({"rules": 3}, "rules"),
        ({"rules": mampc.MoveRules(min_size=50.0)}, "min_size"),
        ({"jobs": 0}, "--jobs: expected -1"),
    ],
)
def test_what_does_not_fit_is_told(settings, words):
    with pytest.raises(mampc.MampcError, match=words):
        tuned(lag(), **settings)


def test_no_model_and_continuous_models_are_refused():
    with pytest.raises(mampc.MampcError, match="model: expected"):
        tuned("model.json")
    with pytest.raises(mampc.MampcError, match="discrete"):
        tuned(mampc.StateSpace([[-1.0]], [[1.0]], [[1.0]], [[0.0]], 0.0))


@pytest.mark.parametrize("name", ["quadruple-tank", "sofc"])
def test_a_study_that_is_written_is_read_back_the_same(name):
    study = load_study(name)
    odd = study.model_copy(update={"name": 'a "name" \\ with\nsigns \x7f é'})
    for one in (study, odd):
        again = parse_study(study_text(one, "a\nb"))
        assert again.model_copy(update={"place": one.place}) == one


@pytest.mark.parametrize("guessed", [True, False])
def test_the_regulator_of_the_study_that_is_written_decides_as_the_one_found(tank, guessed):
    model, found = tank_model(), tuned_tank(None) if guessed else tank
    assert found.reached
    assert found.noise_guessed == guessed
    study = with_tuning(study_of_model(model, found, "tank"), found)
    written = regulator_of(parse_study(study_text(study)), model, study.controllers[0])
    reference = mampc.steps(40, model.y_op, [(5, model.y_op + 1.0), (25, model.y_op)])
    runs = [
        mampc.simulate(model, regulator, reference, noise=0.1, seed=1, progress=False)
        for regulator in (found.regulator, written)
    ]
    np.testing.assert_allclose(runs[1].u, runs[0].u, atol=1e-9)
    assert (np.diff(runs[0].u, axis=0) != 0).any()


def test_a_slider_goes_from_calm_to_brisk(tank):
    regulator = tank.bank(5)
    bank, price = regulator.controller, tank.rules.price
    assert list(bank.variants) == ["tuned", "calm 1", "calm 2", "brisk 1", "brisk 2"]
    assert bank.usual == "tuned"
    prices = [one.rules.price / price for one in bank.variants.values()]
    np.testing.assert_allclose(prices, [1.0, 2.0, 4.0, 0.5, 0.25])
    reference = mampc.steps(60, tank.problem.model.y_op, [(5, tank.problem.model.y_op + 3.0)])
    loops = {"seeds": range(8), "noise": tank.noise, "progress": False}
    moves = []
    for name in ("calm 2", "tuned", "brisk 2"):
        batch = mampc.simulate_batch(tank.problem.model, regulator, reference, variant=name, **loops)
        moves.append(batch.metrics().moves.sum())
    assert moves == sorted(moves)
    assert moves[0] < moves[2]
    alone = mampc.simulate(tank.problem.model, tank.regulator, reference, noise=tank.noise)
    same = mampc.simulate(tank.problem.model, regulator, reference, noise=tank.noise)
    np.testing.assert_array_equal(same.u, alone.u)


def test_a_slider_has_a_middle(tank):
    for positions in (1, 4):
        with pytest.raises(mampc.MampcError, match="positions: expected"):
            tank.bank(positions)
