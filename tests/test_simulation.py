"""Simulated loops: seeds, references, preview."""

import numpy as np
import pytest

import mampc
from builders import identified_tank, tank_model, tank_problem, tank_reference

TANK = mampc.plants.QuadrupleTank()


@pytest.mark.parametrize("plant", [TANK, tank_model()], ids=["nonlinear", "linear"])
def test_a_run_is_reproduced_by_its_seed(plant):
    reference = tank_reference(20)
    runs = [
        mampc.simulate(plant, mampc.Regulator(mampc.MPC(tank_problem())), reference, noise=0.1, seed=seed)
        for seed in (3, 3, 4)
    ]
    np.testing.assert_array_equal(runs[0].u, runs[1].u)
    np.testing.assert_array_equal(runs[0].y_measured, runs[1].y_measured)
    assert np.abs(runs[0].y_measured - runs[2].y_measured).max() > 0.1


def test_equal_seeds_give_equal_noise_to_different_regulators():
    rules = mampc.MoveRules(max_moves=3, sparsity_horizon=3)
    noises = []
    for controller in (mampc.MPC(tank_problem()), mampc.MAMPC(tank_problem(), rules)):
        run = mampc.simulate(tank_model(), mampc.Regulator(controller), tank_reference(30), noise=[0.1, 0.3])
        noises.append(run.y_measured - run.y)
    np.testing.assert_allclose(noises[0], noises[1], atol=1e-12)
    assert noises[0].std(axis=0) == pytest.approx([0.1, 0.3], rel=0.5)


def test_references_may_be_constant_or_rows_of_which_the_last_is_repeated():
    plant, loop = tank_model(), mampc.Regulator(mampc.MPC(tank_problem()))
    reference = tank_reference(8)
    constant = mampc.simulate(plant, loop, reference[0], steps=4)
    np.testing.assert_array_equal(constant.r, np.tile(reference[0], (4, 1)))
    longer = mampc.simulate(plant, loop, reference, steps=11)
    np.testing.assert_array_equal(longer.r, np.vstack([reference, np.tile(reference[-1], (3, 1))]))
    shorter = mampc.simulate(plant, loop, reference, steps=6)
    np.testing.assert_array_equal(shorter.r, reference[:6])
    np.testing.assert_array_equal(shorter.t, 10.0 * np.arange(6))
    assert {len(shorter.u), len(shorter.y), len(shorter.decisions), len(shorter.solve_times)} == {6}
    assert shorter.statuses == {"optimal": 6}


def test_steps_hold_each_value_from_its_sample_on():
    staircase = mampc.steps(6, [1.0, 2.0], [(4, [0.0, 0.0]), (2, [5.0, 6.0])])
    np.testing.assert_array_equal(staircase, [[1, 2], [1, 2], [5, 6], [5, 6], [0, 0], [0, 0]])


@pytest.mark.parametrize("preview", [False, True])
def test_the_regulator_sees_the_reference_from_now_on_and_only_with_preview(monkeypatch, preview):
    seen, loop, reference = [], mampc.Regulator(mampc.MPC(tank_problem())), tank_reference(14)
    step = loop.step
    monkeypatch.setattr(loop, "step", lambda state, y, r: seen.append(r) or step(state, y, r))
    mampc.simulate(tank_model(), loop, reference, preview=preview)
    for k, r in enumerate(seen):
        ahead = [reference[min(k + i, 13)] for i in range(11)]
        np.testing.assert_array_equal(r, ahead if preview else reference[k])


def test_preview_lowers_the_tracking_error():
    loop, reference = mampc.Regulator(mampc.MPC(tank_problem())), tank_reference(80)
    blind, seeing = (
        mampc.simulate(tank_model(), loop, reference, preview=preview).metrics().tracking_error
        for preview in (False, True)
    )
    assert seeing < 0.8 * blind


@pytest.mark.parametrize("u", [None, [55.0, 45.0]], ids=["operating point", "elsewhere"])
@pytest.mark.parametrize("identified", [False, True])
def test_a_loop_that_starts_at_its_reference_stays_there(u, identified):
    problem = tank_problem(identified_tank() if identified else tank_model())
    reference = TANK.output(TANK.steady_state(u))
    loop = mampc.Regulator(mampc.MPC(problem))
    run = mampc.simulate(TANK, loop, reference, steps=30, u_initial=u)
    assert np.abs(run.u - run.u_initial).max() < 1e-8
    np.testing.assert_allclose(run.y, run.r, atol=1e-6)


# The first case study


def test_on_the_identified_tank_the_alternating_method_moves_far_less_and_tracks_nearly_as_well():
    problem = tank_problem(identified_tank())
    rules = mampc.MoveRules(max_moves=3, sparsity_horizon=3)
    mpc, sparse = (
        mampc.simulate(TANK, mampc.Regulator(controller), tank_reference(), noise=0.1, seed=0).metrics()
        for controller in (mampc.MPC(problem), mampc.MAMPC(problem, rules, method="alternating"))
    )
    assert (mpc.exact_density > 0.95).all()
    assert ((mpc.sparse_density > 0.3) & (mpc.sparse_density < 0.8)).all()
    assert (sparse.sparse_density < 0.75 * mpc.sparse_density).all()
    assert 1.05 < sparse.tracking_error / mpc.tracking_error < 1.30


def test_the_preview_reaches_beyond_the_last_sample_of_the_run():
    problem = tank_problem()
    reference = problem.model.y_op + mampc.steps(40, [0.0, 0.0], [(22, (3.0, 3.0))])
    runs = [
        mampc.simulate(problem.model, mampc.Regulator(mampc.MPC(problem)), reference, steps=T, preview=True)
        for T in (20, 40)
    ]
    np.testing.assert_allclose(runs[0].u, runs[1].u[:20], atol=1e-9)
    assert np.abs(runs[0].u[-1] - runs[0].u[0]).max() > 0.1
