"""Zones in closed loop: what moves for them, and what is refused."""

import pickle

import numpy as np
import pytest

import mampc
from builders import predicted, tank_model, tank_problem
from mampc.study import parse_study, run_study, template

INF = np.inf


def test_inside_its_zone_an_output_costs_nothing_and_moves_nothing():
    problem = tank_problem(zone_below=1.0, zone_above=1.0, tail_horizon=10.0)
    model = problem.model
    for controller in (mampc.MPC(problem), mampc.MAMPC(problem, mampc.MoveRules(price=0.01))):
        state = controller.initial_state()
        for seed in range(5):
            x = 0.5 * np.random.default_rng(seed).standard_normal(model.n_states)
            x *= 0.9 / np.abs(model.C @ x).max()
            decision = controller.step(state, x, model.y_op)
            if (np.abs(predicted(model, x, model.u_op[None], 300) - model.y_op) < 1).all():
                assert decision.objective == 0.0
                assert not decision.moves.any()


def test_noise_within_a_zone_moves_nothing():
    problem = tank_problem(zone_below=0.5, zone_above=0.5)
    regulator = mampc.Regulator(mampc.MPC(problem))
    run = mampc.simulate(tank_model(), regulator, problem.model.y_op, steps=100, noise=0.1, seed=1)
    assert run.metrics(threshold=1e-9).moves.sum() == 0


def test_noise_at_the_edge_of_a_zone_moves_nothing_that_has_a_price():
    problem = tank_problem(zone_below=0.5, zone_above=0.5)
    regulator = mampc.Regulator(mampc.MAMPC(problem, mampc.MoveRules(price=1.0)))
    plain = mampc.Regulator(mampc.MPC(problem))
    load = [0.5, 0.5]  # takes both outputs to their edge
    moves = []
    for one in (regulator, plain):
        run = mampc.simulate(
            tank_model(), one, problem.model.y_op, steps=60, noise=0.05, seed=1, output_disturbance=load
        )
        moves.append(run.metrics(threshold=1e-9, skip=10).moves.sum())
    assert moves[0] == 0
    assert moves[1] > 5


def test_one_sided_zones_push_one_way_only():
    problem = tank_problem(zone_below=0.0, zone_above=INF)
    mpc, model = mampc.MPC(problem), problem.model
    above = mpc.step(mpc.initial_state(), np.zeros(model.n_states), model.y_op - 2.0)
    below = mpc.step(mpc.initial_state(), np.zeros(model.n_states), model.y_op + 2.0)
    assert not above.moves.any()
    assert (below.u > model.u_op).any()


def test_batches_replays_and_copies_make_the_same_moves():
    problem = tank_problem(zone_below=0.3, zone_above=[0.3, 0.0])
    model = problem.model
    reference = mampc.steps(16, model.y_op, [(5, model.y_op + 2.0)])
    for controller in (mampc.MPC(problem), mampc.MAMPC(problem, mampc.MoveRules(price=1.0))):
        regulator = mampc.Regulator(controller)
        for preview in (False, True):
            options = {"steps": 16, "noise": 0.1, "preview": preview}
            batch = mampc.simulate_batch(model, regulator, reference, seeds=range(2), **options)
            for seed in range(2):
                run = mampc.simulate(model, regulator, reference, seed=seed, **options)
                np.testing.assert_allclose(batch.u[seed], run.u, atol=1e-9)
        state = regulator.initial_state()
        again = mampc.Regulator(pickle.loads(pickle.dumps(controller)))
        run = mampc.simulate(model, regulator, reference, steps=16, noise=0.1)
        assert mampc.replay(again, state, mampc.Recording.of(run), tolerance=0.0) is None


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"zone_below": -1.0}, "zone_below: expected at least 0"),
        ({"zone_above": [1.0, 2.0, 3.0]}, "zone_above: expected None, a scalar or 2 values"),
        ({"zone_above": "wide"}, "zone_above: expected real numbers"),
        (
            {"zone_above": 1.0, "output_weight": [[1.0, 0.5], [0.5, 1.0]]},
            "output_weight: expected no products",
        ),
    ],
)
def test_bad_zones_are_refused_with_what_was_expected(changes, said):
    with pytest.raises(mampc.MampcError, match=said):
        tank_problem(**changes)


def test_bad_ranges_are_refused_with_what_was_expected():
    with pytest.raises(mampc.MampcError, match="expected low <= high"):
        mampc.Zone([1.0, 2.0], [0.0, 3.0])
    with pytest.raises(mampc.MampcError, match="of the same shape"):
        mampc.Zone([1.0], [0.0, 3.0])
    with pytest.raises(mampc.MampcError, match="low: expected numbers"):
        mampc.Zone("low", "high")
    mpc = mampc.MPC(tank_problem(zone_below=[1.0, 0.0]))
    x = np.zeros(mpc.problem.model.n_states)
    for zone, said in (
        (mampc.Zone([1.0, 2.0, 3.0], [1.0, 2.0, 3.0]), "expected a Zone of shape"),
        (mampc.Zone([1.0, 2.0], [2.0, 3.0]), "ranges only of outputs that have a zone"),
    ):
        with pytest.raises(mampc.MampcError, match=said):
            mpc.step(mpc.initial_state(), x, zone)
    with pytest.raises(mampc.MampcError, match="ranges only of outputs that have a zone"):
        plain = mampc.MPC(tank_problem())
        plain.step(plain.initial_state(), x, mampc.Zone([1.0, 2.0], [2.0, 3.0]))


def test_what_needs_set_points_says_so():
    problem = tank_problem(zone_below=1.0)
    assert np.isinf(mampc.largest_offset(problem, mampc.MoveRules(price=0.1))).all()
    with pytest.raises(mampc.MampcError, match="expected one with set points"):
        mampc.rivals.QuietZone(mampc.MPC(problem), band=1.0)
    with pytest.raises(mampc.MampcError, match="expected set points"):
        mampc.rivals.Penalised(problem, penalty=mampc.rivals.L1(weight=1.0))


def test_a_study_with_zones_needs_fewer_moves():
    text = template().replace("steps = 145", "steps = 40").replace("prbs_order = 8", "prbs_order = 6")
    text = text.replace("at = 50", "at = 12").replace("at = 100", "at = 26")
    assert "# zone_below" in text
    moves = []
    for study in (text, text.replace("# zone_below", "zone_below").replace("# zone_above", "zone_above")):
        study = parse_study(study)
        outcome = run_study(study.model_copy(update={"controllers": study.controllers[:1]}))
        moves.append(outcome.runs["noisy"]["MPC"].metrics(threshold=0.1).moves.sum())
    assert moves[1] < moves[0]
