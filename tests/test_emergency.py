"""Rules give way where an output would leave its limits."""

import numpy as np
import pytest

import mampc
from builders import identified_tank, tank_problem
from mampc import Remark


def urgent_case(**options):
    """A spent budget, and a plant that leaves its limits unless something moves."""
    model = identified_tank()
    limits = mampc.Limits(u_min=0.0, u_max=100.0, y_max=model.y_op + 1.0)
    problem = tank_problem(model, limits=limits)
    rules = mampc.MoveRules(max_moves=2, sparsity_horizon=5)
    controller = mampc.MAMPC(problem, rules, **options)
    u = model.u_op
    past = np.array([u, u, u + np.array([3.0, 0.0]), u + 3.0])
    x = model.steady_state(u + 8.0)
    return controller, controller.initial_state(past), x, model.y_op


@pytest.mark.parametrize("method", ["exact", "greedy"])
def test_rules_are_suspended_where_an_output_would_leave_its_limits_by_more_than_the_margin(method):
    kept = urgent_case(method=method)
    ignored = urgent_case(method=method, on_limit_violation="ignore_budget", violation_margin=0.5)
    patient = urgent_case(method=method, on_limit_violation="ignore_budget", violation_margin=50.0)
    by_rule = kept[0].step(*kept[1:])
    assert not by_rule.moves.any()
    assert by_rule.violations.max() > 1.0
    urgent = ignored[0].step(*ignored[1:])
    assert Remark.RULES_SUSPENDED in urgent.remarks
    assert urgent.violations.max() < by_rule.violations.max()
    assert urgent.moves[0].any()
    assert urgent.gap == np.inf
    assert Remark.RULES_SUSPENDED not in patient[0].step(*patient[1:]).remarks


def test_rules_are_not_suspended_where_that_would_not_help():
    controller, state, x, r = urgent_case(on_limit_violation="ignore_budget")
    stuck = controller.step(state, x, r, manual=[True, True])
    assert Remark.RULES_SUSPENDED not in stuck.remarks


@pytest.mark.parametrize(
    "options", [{"on_limit_violation": "panic"}, {"violation_margin": -1.0}, {"violation_margin": [1.0] * 3}]
)
def test_emergency_settings_out_of_range_are_refused(options):
    with pytest.raises(mampc.MampcError, match=r"expected.*received"):
        urgent_case(**options)
