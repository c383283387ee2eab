"""Every feature that plants ask for, in every place: works, or is refused when it is made, as docs/methods.md says."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest

import mampc
from mampc.study import parse_study, run_study

DOCS = Path(__file__).parents[1] / "docs" / "methods.md"
STEPS = 8
ROWS = {
    "zones": {"zone_below": 0.2, "zone_above": 0.3},
    "a `Zone` told": {"zone_below": 0.2, "zone_above": 0.3, "zone_pull": 0.1},
    "ranks": {"output_rank": [1, 2], "limits": mampc.Limits(u_min=0.0, u_max=4.0, y_min=[2.4, 0.0], y_max=[9.0, 1.7])},
    "levels": {},
    "on/off": {},
    "targets and costs": {"u_target": [2.0, 1.0], "u_target_weight": 0.01, "u_cost": [0.01, 0.0]},
    "reference filter": {},
    "bank": {},
    "valves": {},
    "limits, manual": {},
    "learnt gains": {},
}  # fmt: skip
RULES = {
    "levels": {"levels": [[0.0, 1.0, 2.0, 2.5, 4.0], 0.5]},
    "on/off": {"levels": [mampc.OnOff(min_on=2.0, min_off=2.0, starts_per_hour=900), None]},
    "valves": {"min_size": 0.1},
}
HEURISTICS = sorted(set(mampc.METHODS) - {"exact"})


@cache
def table():
    """What docs/methods.md says: feature -> place -> yes, refused or none."""
    lines = DOCS.read_text().split("<!-- features table -->")[1].split("<!-- end of features table -->")[0]
    rows = [[cell.strip() for cell in line.strip("| ").split("|")] for line in lines.strip().splitlines()]
    return {row[0]: dict(zip(rows[0][1:], row[1:], strict=True)) for row in rows[2:]}


@cache
def model():
    return mampc.StateSpace.from_first_order(
        gain=[[1.0, 0.4], [0.3, 0.8]], time_constant=[[6.0, 4.0], [5.0, 8.0]], dt=1.0
    )


def problem(feature):
    settings = {"limits": mampc.Limits(u_min=0.0, u_max=4.0)} | ROWS[feature]
    return mampc.TrackingProblem(
        model(), prediction_horizon=6, control_horizon=2, move_weight=0.05, **settings
    )


def rules(feature):
    return mampc.MoveRules(price=0.05, **RULES.get(feature, {}))


def made(feature, place, method="exact", **settings):
    """A regulator with the feature, at a place."""
    own, loop = problem(feature), {}
    if place == "later data":
        loop = {"estimator": mampc.LoadBank(model(), noise=0.05), "value_of_information": True}
    if place == "plain MPC":
        controller = mampc.MPC(own)
    elif place == "penalties":
        controller = mampc.rivals.Penalised(own, penalty=mampc.rivals.L1(weight=0.1))
    else:
        controller = mampc.MAMPC(own, rules(feature), method=method, **settings)
    if place == "rules around":
        controller = mampc.rivals.DeadBand(controller, size=0.2)
    if feature == "bank" or place == "variant":
        other = mampc.MAMPC(own, rules(feature)) if feature == "valves" else mampc.MPC(own)
        controller = mampc.ControllerBank({"own": controller, "plain": other})
    if feature == "reference filter":
        loop["reference_filter"] = mampc.ReferenceFilter(time_constant=2.0, rate=0.5)
    if feature == "valves":
        loop["valves"] = mampc.Valves(band=0.2, jump=0.05)
    if feature == "learnt gains":
        loop |= {"estimator": mampc.LoadBank(model(), noise=0.05), "learn_gains": True}
    return mampc.Regulator(controller, **loop)


def asked(feature, steps=STEPS):
    reference = mampc.steps(steps, [0.0, 0.0], [(1, [2.0, 1.5])])
    if feature != "a `Zone` told":
        return reference
    return mampc.Zone(reference - np.array([0.5, 0.1]), reference + np.array([0.1, np.inf]))


def told(feature):
    if feature == "limits, manual":
        manual = np.full((STEPS, 2), np.nan)
        manual[3:5, 0] = 1.0
        limits = [None, *[mampc.Limits(u_max=[1.5, 3.0])] * (STEPS - 1)]
        return {"noise": 0.05, "limits": limits, "manual": manual}
    return {"noise": 0.05, "valves": mampc.Valves(band=0.2, jump=0.05) if feature == "valves" else None}


def ran(feature, regulator, steps=STEPS):
    during = told(feature)
    if "limits" in during:
        during = during | {"limits": during["limits"][:steps], "manual": during["manual"][:steps]}
    run = mampc.simulate(model(), regulator, asked(feature, steps), progress=False, **during)
    assert np.isfinite(run.u).all()
    assert (run.u >= -1e-9).all()
    assert (run.u <= 4.0 + 1e-9).all()
    assert not any(status.startswith("held") for status in run.statuses)
    return run


def one_method(feature, method, **settings):
    if method == "alternating":
        settings |= {"warm_up": 0, "polish": True}
    ran(feature, made(feature, method, method, **settings), steps=3)


def certified(feature):
    run = ran(feature, made(feature, "certify", "greedy", certify=True))
    assert all(np.isfinite(decision.lower_bound) for decision in run.decisions)


def batched(feature):
    regulator = made(feature, "batch")
    batch = mampc.simulate_batch(
        model(), regulator, asked(feature), seeds=[0, 1], progress=False, **told(feature)
    )
    np.testing.assert_allclose(batch.u[0], ran(feature, regulator).u, atol=1e-8)


def replayed(feature, tmp_path):
    ran(feature, made(feature, "replay")).to_csv(tmp_path / "run.csv")
    again = made(feature, "replay")
    state = again.initial_state(model().u_op, model().y_op)
    recording = mampc.Recording.from_csv(tmp_path / "run.csv", model().names)
    assert mampc.replay(again, state, recording) is None


STUDY = """
name = "matrix"
steps = 8
dt = 1.0
plant = { kind = "model" }
model = { file = "model.json" }
actuators = { band = 0.2, jump = 0.05 }
[problem]
prediction_horizon = 6
control_horizon = 2
move_weight = 0.05
limits = { u_min = 0.0, u_max = 4.0 }
PROBLEM
[reference]
initial = [0.0, 0.0]
changes = [{ at = 2, value = [2.0, 1.5] }]
REFERENCE
[[scenarios]]
name = "one"
noise = 0.05
SCENARIO
[[controllers]]
name = "own"
method = "exact"
rules = { price = 0.05 RULES }
CONTROLLER
"""
WORDS = {
    "zones": {"PROBLEM": "zone_below = 0.2"},
    "a `Zone` told": {
        "PROBLEM": "zone_below = 0.2\nzone_pull = 0.1",
        "REFERENCE": "zones = [{ at = 3, below = 0.1, above = inf }]",
    },
    "ranks": {"PROBLEM": "output_rank = [1, 2]"},
    "levels": {"RULES": ", levels = [[0, 1, 2, 2.5, 4], 0.5]"},
    "on/off": {"RULES": ', levels = [{ min_on = "2 s", min_off = 2 }, "any"]'},
    "targets and costs": {"PROBLEM": "u_target_weight = 0.01\nu_cost = [0.01, 0.0]"},
    "reference filter": {"CONTROLLER": 'reference_filter = { time_constant = "2 s" }'},
    "bank": {
        "SCENARIO": 'switches = [{ at = 3, variant = "plain" }]',
        "CONTROLLER": '[[controllers]]\nname = "plain"\nmethod = "mpc"\n[[controllers]]\nname = "both"\n'
        'method = "bank"\nvariants = ["own", "plain"]',
    },
    "limits, manual": {
        "SCENARIO": "limits = [{ at = 2, u_max = [1.5, 3.0] }]\n"
        'manual = [{ at = 3, until = 5, input = "INPUT", value = 1.0 }]',
    },
    "learnt gains": {"CONTROLLER": "learn_gains = true\n[estimator]\nmeasurement_noise = 0.05"},
    "valves": {"SCENARIO": "valves = { band = 0.2, jump = 0.05 }", "CONTROLLER": "compensate = true"},
}  # fmt: skip


def studied(feature, tmp_path):
    model().save(tmp_path / "model.json")
    text = STUDY
    for key in ("PROBLEM", "REFERENCE", "SCENARIO", "RULES", "CONTROLLER"):
        text = text.replace(key, WORDS[feature].get(key, ""))
    text = text.replace("INPUT", model().names.inputs[0])
    result = run_study(parse_study(text, folder=tmp_path))
    assert all(len(run.decisions) == 8 for run in result.runs["one"].values())


def tried(feature, place, tmp_path):
    """Make and run it; raises what it is refused with."""
    if place == "heuristics":
        for method in HEURISTICS:
            one_method(feature, method)
    elif place == "certify":
        certified(feature)
    elif place == "batch":
        batched(feature)
    elif place == "replay":
        replayed(feature, tmp_path)
    elif place == "study":
        studied(feature, tmp_path)
    else:
        ran(feature, made(feature, place))


PLACES = [
    "plain MPC", "exact", "heuristics", "certify", "later data", "variant", "batch", "replay", "study", "rules around",
    "penalties",
]  # fmt: skip


def test_the_table_names_every_feature_and_place():
    assert list(table()) == list(ROWS)
    assert all(list(row) == PLACES for row in table().values())
    assert {cell for row in table().values() for cell in row.values()} <= {"yes", "refused", "-"}


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("feature", ROWS)
def test_a_feature_works_or_is_refused_as_the_table_says(feature, place, tmp_path):
    says = table()[feature][place]
    if says == "-":
        return
    if says == "refused":
        with pytest.raises(mampc.MampcError, match="expected"):
            made(feature, place)
    else:
        tried(feature, place, tmp_path)
