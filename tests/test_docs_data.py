"""docs/data.md: its commands run on its export, and do what the page says."""

import json
import shlex
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

import mampc
from mampc.cli import app

DOCS = Path(__file__).parents[1] / "docs"


def commands():
    """Every line of the page that starts a mampc command."""
    lines = (line.strip() for line in (DOCS / "data.md").read_text().splitlines())
    return [shlex.split(line)[1:] for line in lines if line.startswith("mampc ")]


def told():
    """What the page says that `mampc inspect` tells."""
    return (DOCS / "data.md").read_text().split("```text")[1].split("```")[0].strip().splitlines()


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(DOCS))
    monkeypatch.chdir(tmp_path)
    from ugly_export import ugly_export

    (tmp_path / "export.csv").write_bytes(ugly_export().encode("cp1252"))
    yield tmp_path
    sys.modules.pop("ugly_export", None)


def test_the_commands_lead_from_the_export_to_a_running_study(folder, few_figures):
    assert len(commands()) >= 3
    for command in commands():
        outcome = CliRunner().invoke(app, command)
        assert outcome.exit_code == 0, outcome.output
        if command == ["inspect", "export.csv"]:
            assert all(sentence in outcome.output for sentence in told())
    model = mampc.StateSpace.load(folder / "tank.json")
    assert (model.dt, model.n_inputs, model.n_outputs) == (10.0, 2, 2)
    assert dict(model.names.units)["LI-1.PV"] == "cm"
    assert (folder / "export-columns.png").exists()
    summary = json.loads((folder / "results" / "tank" / "summary.json").read_text())
    assert not summary["warnings"]
    mpc, price = summary["scenarios"][0]["controllers"][:2]
    assert price["moves"] < mpc["moves"] / 10


def test_the_python_of_the_page_runs(folder):
    code = (DOCS / "data.md").read_text().split("```python")[1].split("```")[0]
    scope = {}
    exec(code, scope)
    assert [len(record) for record in scope["export"].records] == [333, 69, 95, 171, 248, 324]
    assert len(scope["fitted"].fit) == 2
