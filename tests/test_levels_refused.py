"""Levels and on/off inputs that do not fit are refused with what was expected."""

import numpy as np
import pytest

import mampc
from test_levels import loop_of


@pytest.mark.parametrize(
    ("levels", "expected"),
    [
        (0.0, "above 0"),
        ((0, 40, 100), "a step above 0"),
        ([[0, 40]], "one entry for each of 2 inputs"),
        ([[50.0], None], "some within the limits"),
        ([[np.nan], None], "finite"),
        ("on", "expected a step"),
        ([], "expected a step"),
        (100.0, "multiples"),
        ([mampc.OnOff(on=7.0), None], "within the limits"),
        ([mampc.OnOff(on=1.0, off=1.0), None], "within the limits"),
        ([mampc.OnOff(min_on=1e9), None], "below 10000 samples"),
        (True, "finite number"),
    ],
    ids=str,
)
def test_levels_that_do_not_fit_are_refused(levels, expected):
    with pytest.raises(mampc.MampcError, match=expected):
        loop_of("exact", levels, u_min=[-3.0, 1.0] if levels == 100.0 else -3.0)


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({"on_limit_violation": "ignore_budget"}, "keep_budget"),
        ({"method": "alternating"}, "polish=True"),
        ({"method": "alternating", "polish": True, "warm_up": 3}, "no warm_up"),
    ],
    ids=str,
)
def test_what_would_leave_the_levels_is_refused(settings, expected):
    problem = loop_of("exact", 0.5).controller.problem
    with pytest.raises(mampc.MampcError, match=expected):
        mampc.MAMPC(problem, mampc.MoveRules(levels=0.5, price=1.0), **settings)


def test_a_rule_around_inputs_on_levels_is_refused():
    with pytest.raises(mampc.MampcError, match="received one with levels"):
        mampc.rivals.DeadBand(loop_of("exact", 0.5).controller, size=1.0)


@pytest.mark.parametrize("settings", [{"min_on": -1.0}, {"starts_per_hour": 0}, {"on": np.nan}], ids=str)
def test_bad_settings_of_an_on_off_input_are_refused(settings):
    with pytest.raises(mampc.MampcError, match=next(iter(settings))):
        mampc.OnOff(**settings)


def test_a_least_size_beside_levels_is_for_inputs_on_levels_alone():
    """The program of inputs that take any value, for each course on levels, knows no least size."""
    model = mampc.StateSpace.from_first_order(gain=[[1.0, 0.5]], time_constant=[[5.0, 3.0]], dt=1.0)
    limits = mampc.Limits(u_min=0.0, u_max=4.0)
    problem = mampc.TrackingProblem(model, prediction_horizon=4, control_horizon=2, limits=limits)
    levels = [None, [0.0, 2.0, 4.0]]
    with pytest.raises(mampc.MampcError, match="take any value beside others on levels"):
        mampc.MAMPC(problem, mampc.MoveRules(min_size=0.4, levels=levels))
    mampc.MAMPC(problem, mampc.MoveRules(min_size=[0.0, 3.0], levels=levels))
