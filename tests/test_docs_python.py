"""The Python on the pages runs, each page from top to bottom, with the names that it takes for granted."""

import re
from contextlib import suppress
from functools import partial
from itertools import islice, repeat
from pathlib import Path

import numpy as np
import pytest

import mampc
from builders import tank_model
from mampc.compare import candidates, scenarios, tuning

ROOT = Path(__file__).parents[1]
OF_THEIR_OWN = ("data",)  # see test_docs_data
PAGES = [
    page
    for page in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))
    if "```python" in page.read_text() and page.stem not in OF_THEIR_OWN
]


def taken_for_granted(page):
    """What every reader has by then: a plant, its model and problem, a regulator and its last sample."""
    model, reference, limits = tank_model(), np.array([34.0, 28.0]), mampc.Limits(u_min=0.0, u_max=100.0)
    if page.name == "methods.md":  # two inputs and one output
        model, reference = mampc.StateSpace.load(ROOT / "examples/two-valves.json"), np.array([68.0])
    problem = mampc.TrackingProblem(model, prediction_horizon=20, control_horizon=3, limits=limits)
    controller, rules = mampc.MAMPC(problem, mampc.MoveRules(price=1.0)), mampc.MoveRules(price=1.0)
    regulator = mampc.Regulator(controller)
    state = regulator.initial_state()
    plant = islice(repeat((model.y_op, None, None)), 3)  # it answers three times
    return {
        "mampc": mampc, "np": np, "plant": model, "model": model, "limits": limits, "problem": problem,
        "rules": rules, "controller": controller, "sparse": controller, "regulator": regulator, "state": state,
        "reference": reference, "y": model.y_op, "y_now": model.y_op, "u_now": model.u_op,
        "decision": regulator.step(state, model.y_op, reference), "read_plant": lambda: next(plant),
        "write_plant": lambda u: None, "log": lambda *words: None, "range": lambda n: range(min(n, 3)),
    }  # fmt: skip


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_the_python_of_a_page_runs(page, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(mampc, "tune", partial(mampc.tune, jobs=1))
    monkeypatch.setattr(tuning, "ROUNDS", tuning.ROUNDS._replace(**dict.fromkeys(tuning.ROUNDS._fields, 3)))
    monkeypatch.setattr(candidates, "MOVE_WEIGHTS", (0.1,))
    monkeypatch.setattr(candidates, "TAILS", (0.0,))
    monkeypatch.setattr(scenarios, "LENGTHS", (60, 60))
    scope = taken_for_granted(page)
    for number, code in enumerate(re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.S)):
        with suppress(StopIteration):  # of a loop that goes on as long as the plant answers
            exec(compile(code, f"{page.name}, block {number}", "exec"), scope)
    if page.stem == "models":
        the_gains_are_those_that_the_page_says(scope)


def the_gains_are_those_that_the_page_says(scope):
    np.testing.assert_allclose(scope["column"].dc_gain(), [[12.8, -18.9], [6.6, -19.4]])
    assert scope["error"].max() <= 0.01
    assert scope["found"].accepted
    off = scope["plant"].dc_gain() / scope["column"].dc_gain()
    still_off = scope["corrected"].dc_gain() / scope["plant"].dc_gain()
    assert np.abs(still_off - 1).max() < np.abs(1 / off - 1).max() / 2
