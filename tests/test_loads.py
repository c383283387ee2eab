"""Loads and valves: what disturbs a loop, and what stands between decided and real inputs."""

import numpy as np
import pytest

import mampc
from builders import random_model, tank_problem, tank_reference
from mampc import loads

TANK = mampc.plants.QuadrupleTank()
EVERY = [
    loads.Steps(sizes=[1.0, (0.5, -2.0)], times=[10.0, 25.0]),
    loads.RandomSteps(size=1.0, every=30.0),
    loads.RandomWalk(size=(1.0, 0.2)),
    loads.Coloured(size=1.0, time_constant=50.0),
    loads.Sinusoid(size=1.0, period=100.0),
    loads.Sinusoid(size=1.0, period=100.0, phase=None),
    loads.Residuals(values=np.random.default_rng(0).standard_normal((30, 2))),
]


@pytest.mark.parametrize("load", EVERY, ids=lambda load: type(load).__name__)
def test_a_load_is_drawn_by_its_seed_alone_and_a_longer_one_begins_alike(load):
    first = load.draw(60, 5.0, 3, 2)
    assert first.shape == (60, 2)
    np.testing.assert_array_equal(load.draw(60, 5.0, 3, 2), first)
    drawn = not isinstance(load, loads.Steps) and getattr(load, "phase", None) != 0.0
    assert np.array_equal(load.draw(60, 5.0, 4, 2), first) != drawn


@pytest.mark.parametrize("load", EVERY, ids=lambda load: type(load).__name__)
def test_a_load_starts_at_zero_unless_its_phase_is_drawn(load):
    if getattr(load, "phase", 0.0) is not None:
        np.testing.assert_array_equal(load.draw(5, 5.0, 3, 2)[0], 0.0)


def test_given_steps_come_at_their_times_and_stay():
    load = loads.Steps(sizes=[1.0, (0.5, -2.0)], times=[10.0, 25.0]).draw(8, 5.0, signals=2)
    np.testing.assert_array_equal(load, [[0, 0]] * 2 + [[1, 1]] * 3 + [[1.5, -1.0]] * 3)


def test_random_steps_come_as_often_and_reach_as_far_as_told():
    load = loads.RandomSteps(size=2.0, every=50.0).draw(40_000, 5.0, 0)
    assert np.mean(np.diff(load[:, 0]) != 0) == pytest.approx(1 - np.exp(-0.1), rel=0.05)
    assert load.std() == pytest.approx(2.0, rel=0.05)


def test_a_random_walk_changes_by_its_size():
    changes = np.diff(loads.RandomWalk(size=[0.5, 3.0]).draw(20_000, 1.0, 0, 2), axis=0)
    np.testing.assert_allclose(changes.std(axis=0), [0.5, 3.0], rtol=0.03)
    assert abs(np.corrcoef(changes.T)[0, 1]) < 0.03


def test_coloured_noise_has_its_size_and_forgets_with_its_time_constant():
    load = loads.Coloured(size=2.0, time_constant=50.0).draw(100_000, 5.0, 0)[1000:, 0]
    assert load.std() == pytest.approx(2.0, rel=0.05)
    assert np.corrcoef(load[:-10], load[10:])[0, 1] == pytest.approx(np.exp(-1), abs=0.05)


def test_a_sinusoid_repeats_with_its_period():
    load = loads.Sinusoid(size=3.0, period=100.0).draw(41, 5.0)[:, 0]
    np.testing.assert_allclose(load[:21], load[20:], atol=1e-12)
    assert load.max() == pytest.approx(3.0)


def test_residuals_are_what_the_model_left_unexplained():
    model = random_model(1)
    u = mampc.prbs(order=6, inputs=2, mean=model.u_op)
    drift = 0.1 * np.random.default_rng(0).standard_normal((len(u), 2)).cumsum(axis=0)
    record = mampc.IOData(u, model.response(u, model.steady_state(u[0])) + drift, 1.0)
    load = loads.Residuals.of(model, record)
    np.testing.assert_allclose(load.values, drift, atol=1e-9)
    assert load.at == "output"
    drawn = load.draw(500, 1.0, 0, 2)
    assert np.abs(np.diff(drawn, axis=0)).max() <= np.abs(np.diff(drift, axis=0)).max() + 1e-12
    with pytest.raises(mampc.MampcError, match="Residuals: expected 2 signals, received 1"):
        load.draw(5, 1.0, 0, 1)


def test_equal_seeds_give_equal_loads_whatever_the_regulator_and_the_noise():
    """Loads at the outputs are what is left of them when an ideal plant does not move."""
    model = random_model(1)
    courses = []
    for weight, noise in ((1e9, 0.0), (1e9, 0.2), (0.1, 0.0)):
        loop = mampc.Regulator(mampc.MPC(tank_problem(model, move_weight=weight)))
        run = mampc.simulate(
            model,
            loop,
            model.y_op,
            steps=50,
            seed=3,
            noise=noise,
            loads=[loads.RandomWalk(size=0.3, at="output")],
        )
        courses.append(run.y - model.response(run.u))
    np.testing.assert_allclose(courses[1], courses[0], atol=1e-9)
    np.testing.assert_allclose(courses[2], courses[0], atol=1e-9)
    assert np.ptp(courses[0]) > 1.0


def test_loads_of_one_run_are_drawn_apart():
    model = random_model(1)
    loop = mampc.Regulator(mampc.MPC(tank_problem(model, move_weight=1e9)))
    walk = loads.RandomWalk(size=0.3, at="output")
    one, two = (mampc.simulate(model, loop, model.y_op, steps=30, loads=[walk] * count) for count in (1, 2))
    assert not np.allclose(two.y - model.y_op, 2 * (one.y - model.y_op))


def test_a_load_of_ones_own_is_any_object_with_a_place_and_a_draw():
    class Ramp:
        at = "output"

        def draw(self, n_steps, dt, seed, signals=1):
            return 0.01 * np.tile(np.arange(n_steps)[:, None], signals)

    model = random_model(1)
    loop = mampc.Regulator(mampc.MPC(tank_problem(model)))
    run = mampc.simulate(model, loop, model.y_op, steps=30, loads=[Ramp()])
    np.testing.assert_allclose(run.y - model.response(run.u), Ramp().draw(30, 1.0, 0, 2), atol=1e-9)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: loads.RandomWalk(size=-1.0), "size: expected"),
        (lambda: loads.RandomWalk(size=[[1.0]]), "size: expected"),
        (lambda: loads.RandomWalk(size="much"), "size: expected"),
        (lambda: loads.RandomWalk(size=1.0, at="valve"), "at: expected one of input, output, measured"),
        (lambda: loads.Coloured(size=1.0, time_constant=0.0), "time_constant: expected"),
        (lambda: loads.Sinusoid(size=1.0, period=-1.0), "period: expected"),
        (lambda: loads.RandomSteps(size=1.0, every=np.nan), "every: expected"),
        (lambda: loads.Steps(sizes=[1.0], times=[1.0, 2.0]), "sizes: expected one per time"),
        (lambda: loads.Residuals(values=[[1.0]]), "values: expected at least two"),
        (lambda: loads.RandomWalk(size=[1.0, 2.0]).draw(5, 1.0, 0, 3), "size: expected"),
        (lambda: mampc.Valves(band=-1.0), "band: expected"),
        (lambda: mampc.Valves(band=1.0, jump=2.0), "jump: expected at most"),
        (lambda: mampc.Valves(band=[1.0, 2.0]).initial(np.zeros(3)), "band: expected"),
    ],
)  # fmt: skip
def test_settings_that_make_no_sense_are_refused(make, message):
    with pytest.raises(mampc.MampcError, match=message):
        make()


# Valves


def course(valves, decided):
    stems, positions = valves.initial(decided[0]), []
    for u in decided:
        stems = stems.moved(np.asarray(u, dtype=float))
        positions.append(stems.position)
    return np.array(positions)


def test_an_ideal_valve_is_where_it_is_told():
    decided = np.random.default_rng(0).standard_normal((50, 2))
    np.testing.assert_array_equal(course(mampc.Valves(), decided), decided)


def test_play_alone_is_a_band_that_the_valve_is_dragged_by():
    decided = np.array([0.0, 0.4, 1.0, 2.0, 1.5, 1.1, 0.9, 0.0])[:, None]
    played = course(mampc.Valves(band=1.0), decided)[:, 0]
    np.testing.assert_allclose(played, [0.0, 0.0, 0.5, 1.5, 1.5, 1.5, 1.4, 0.5])


def test_a_sticking_valve_jumps_and_without_dead_band_reaches_what_was_decided():
    decided = np.array([0.0, 0.5, 0.9, 1.2, 1.5, 2.5])[:, None]
    np.testing.assert_allclose(
        course(mampc.Valves(band=1.0, jump=1.0), decided)[:, 0], [0, 0, 0, 1.2, 1.2, 2.5]
    )


def test_valves_do_not_depend_on_units_and_serve_batches():
    decided = np.random.default_rng(0).standard_normal((50, 4, 2)).cumsum(axis=0)
    together = course(mampc.Valves(band=(1.0, 2.0), jump=(0.2, 2.0)), decided)
    for s in range(4):
        alone = course(mampc.Valves(band=(1.0, 2.0), jump=(0.2, 2.0)), decided[:, s])
        np.testing.assert_array_equal(together[:, s], alone)
    scaled = course(mampc.Valves(band=(1024.0, 2048.0), jump=(204.8, 2048.0)), 1024 * decided)
    np.testing.assert_allclose(scaled, 1024 * together, rtol=1e-12)


def test_a_loop_with_sticking_valves_cycles_and_says_where_they_were():
    loop = mampc.Regulator(mampc.MPC(tank_problem()))
    run = mampc.simulate(TANK, loop, tank_reference(100), valves=mampc.Valves(band=4.0, jump=2.0))
    assert not np.allclose(run.position, run.u)
    assert (np.abs(run.position - run.u) <= 4.0 + 1e-9).all()
    assert (run.metrics().starts < run.metrics().moves).all()
    ideal = mampc.simulate(TANK, loop, tank_reference(100))
    np.testing.assert_array_equal(ideal.position, ideal.u)


# Wear


def wear_of(u, **options):
    u = np.asarray(u, dtype=float)[:, None]
    run = mampc.Run(
        t=60.0 * np.arange(len(u)), u=u, y=u, y_measured=u, r=u, u_initial=np.zeros(1), decisions=(), dt=60.0,
        names=mampc.Names(("valve",), ("flow",)), v=np.empty((len(u), 0)), faults={},
    )  # fmt: skip
    return run.metrics(**options)


def test_starts_and_hold_times_equal_those_worked_out_by_hand():
    metrics = wear_of([0.0, 0.6, 1.2, 1.2, 1.2, 0.9, 0.9, 0.9, 0.9, 0.1], dead_band=1.0)
    np.testing.assert_array_equal(metrics.starts, [2])  # 1.2, and back from it to 0.1
    np.testing.assert_allclose(metrics.starts_per_hour, [2 * 6.0])
    np.testing.assert_array_equal(metrics.moves, [4])
    np.testing.assert_allclose(metrics.longest_hold_time, [4 * 60.0])
    np.testing.assert_allclose(metrics.median_hold_time, [60.0])  # 1, 1, 3, 4 and 1 samples


def test_without_dead_band_every_move_is_a_start():
    u = np.random.default_rng(0).standard_normal(50).round(1)
    metrics = wear_of(u)
    np.testing.assert_array_equal(metrics.starts, metrics.moves)
    with pytest.raises(mampc.MampcError, match="dead_band: expected"):
        wear_of(u, dead_band=-1.0)
