"""What is proven holds at any conditioning: against brute force in 60 digits."""

import warnings

import mpmath
import numpy as np
import pytest

import mampc
from conditioned import Referee, case_of
from mampc import Status
from mampc.base.words import Remark
from mampc.methods.exact import ranking
from mampc.program.condensing import CondensedQP
from referees import charge
from seeds import seeds


def decided(case, method="exact", **settings):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", mampc.MampcWarning)
        controller = mampc.MAMPC(case.problem, case.rules, method=method, **settings)
    return controller.step(controller.initial_state(case.past), case.x, case.reference)


@pytest.mark.parametrize("seed", seeds(2000, quick=40))
def test_proven_optima_are_those_of_brute_force_in_60_digits(seed):
    case = case_of(seed)
    decision, referee = decided(case), Referee(case)
    optimum = referee.optimum()
    if decision.status is Status.HELD_INFEASIBLE:
        assert optimum == mpmath.inf
        return
    assert decision.lower_bound <= optimum * (1 + mpmath.mpf(1e-9))
    assert (decision.gap == 0) == (decision.status is Status.OPTIMAL)
    if decision.status is Status.OPTIMAL:
        assert abs(decision.objective - optimum) <= mpmath.mpf(1e-7) * optimum
        own = referee.cost(decision.plan) + mpmath.mpf(charge(case.rules, decision.moves))
        assert abs(own - optimum) <= mpmath.mpf(1e-7) * optimum


def double_integrator(n_p):
    model = mampc.StateSpace([[1, 1], [0, 1]], [[0.5], [1]], [[1, 0]], None, 1.0)
    return mampc.TrackingProblem(model, prediction_horizon=n_p, control_horizon=5)


@pytest.mark.parametrize(
    ("n_p", "objective"), [(50, 1.621156), (60, 1.622130), (100, 1.624228), (200, 1.625941)]
)
def test_a_long_horizon_on_a_double_integrator_costs_little_more(n_p, objective, monkeypatch):
    problem, rules = double_integrator(n_p), mampc.MoveRules(max_moves=3)
    for largest in (ranking.LARGEST_TABLE, 0):
        monkeypatch.setattr(ranking, "LARGEST_TABLE", largest)
        controller = mampc.MAMPC(problem, rules)
        decision = controller.step(controller.initial_state(), np.zeros(2), [1.0])
        assert decision.status is Status.OPTIMAL
        assert decision.objective == pytest.approx(objective, abs=1e-6)


def unstable(n_p, nc=3):
    model = mampc.StateSpace([[1.8, 0], [0, 0.6]], [[1.0], [0.5]], [[1.0, 1.0]], None, 1.0)
    return mampc.TrackingProblem(model, prediction_horizon=n_p, control_horizon=nc)


def test_a_prediction_that_enlarges_rounding_says_so_when_made_and_in_every_decision():
    with pytest.warns(mampc.MampcWarning, match="condition"):
        controller = mampc.MAMPC(unstable(40), mampc.MoveRules(max_moves=2))
    decision = controller.step(controller.initial_state(), [1.0, 1.0], [1.0])
    assert Remark.ROUNDING in decision.remarks
    assert decision.status is Status.FEASIBLE
    assert decision.gap > 0


@pytest.mark.parametrize("n_p", [20, 50, 200])
def test_an_ordinary_problem_has_no_warning_and_no_remark(n_p):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        controller = mampc.MAMPC(double_integrator(n_p), mampc.MoveRules(max_moves=2))
    decision = controller.step(controller.initial_state(), [0.1, 0.0], [1.0])
    assert not decision.remarks


def test_moves_that_nothing_determines_are_refused():
    with pytest.raises(mampc.MampcError, match="condition"):
        CondensedQP(unstable(200))
