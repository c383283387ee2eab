"""Plants of the user's own: the documented example, in a study and without."""

from pathlib import Path

import pytest

import mampc
from mampc.study import load_study, parse_study, run_study

DOCS = Path(__file__).parents[1] / "docs" / "plants.md"
STUDY = """
name = "reactor"
steps = 30
dt = 10.0
[plant]
kind = "{kind}"
[identification]
amplitude = 0.005
prbs_order = 7
hold = 3
noise = 0.001
[problem]
prediction_horizon = 10
control_horizon = 3
move_weight = 1.0
limits = {{ u_min = 0.0, u_max = 0.1 }}
[reference]
initial = [0.0]
changes = [{{ at = 5, value = [0.05] }}]
[[scenarios]]
name = "noisy"
noise = 0.001
[[controllers]]
name = "MPC"
method = "mpc"
"""


@pytest.fixture
def example():
    """The documented class, as text."""
    return DOCS.read_text().split("```python")[1].split("```")[0]


@pytest.fixture
def folder(tmp_path, example, monkeypatch):
    """A folder with a study and, beside it, a module with the documented class."""
    module = f"reactor_{tmp_path.name}"
    (tmp_path / f"{module}.py").write_text(example)
    (tmp_path / "study.toml").write_text(STUDY.format(kind=f"{module}:StirredTank"))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_example_has_ten_lines(example):
    class_text = example[example.index("class ") :]
    assert len([line for line in class_text.splitlines() if line.strip()]) <= 10


def test_the_documented_example_runs_in_a_study(folder):
    run = run_study(load_study("study.toml")).runs["noisy"]["MPC"]
    assert run.y[-1, 0] == pytest.approx(run.r[-1, 0], abs=0.01)


def test_the_documented_example_is_a_plant(example):
    space = {}
    exec(example, space)
    plant = space["StirredTank"]()
    assert isinstance(plant, mampc.plants.Plant)
    assert mampc.linearise(plant).discretise(10.0).is_stable()


def test_code_of_a_study_from_elsewhere_needs_trust(folder, tmp_path_factory, monkeypatch):
    monkeypatch.chdir(tmp_path_factory.mktemp("elsewhere"))
    with pytest.raises(mampc.StudyError, match="--trust"):
        run_study(load_study(folder / "study.toml"))
    assert run_study(load_study(folder / "study.toml", trust=True)).runs


def test_text_is_trusted_only_when_asked(folder):
    text = (folder / "study.toml").read_text()
    with pytest.raises(mampc.StudyError, match="trust=True"):
        run_study(parse_study(text))
    assert run_study(parse_study(text, trust=True)).runs


@pytest.mark.parametrize(
    ("code", "expected"),
    [
        ("def (", "imported, received SyntaxError: invalid syntax"),
        ("raise SystemExit(0)", "imported, received SystemExit: 0, in line 1 of"),
        ("import no_such_module", "imported, received: No module named 'no_such_module'"),
        (
            "class Plant:\n  def __init__(self): 1 / 0",
            "can be made, received ZeroDivisionError: .* in line 2 of",
        ),
        ("class Plant:\n  def __init__(self): exit(0)", "can be made, received SystemExit"),
        ("class Plant:\n  names = property(lambda self: 1 / 0)", "can be made, received ZeroDivisionError"),
    ],
)
def test_plants_whose_code_fails_are_refused_with_the_place(code, expected, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / f"wrong_{tmp_path.name}.py").write_text(code)
    (tmp_path / "study.toml").write_text(STUDY.format(kind=f"wrong_{tmp_path.name}:Plant"))
    with pytest.raises(mampc.StudyError, match=f"plant.kind: .*{expected}"):
        run_study(load_study("study.toml"))


@pytest.mark.parametrize(
    ("kind", "expected"),
    [
        ("no_such_module:Plant", "imported"),
        ("math:NoSuchClass", "NoSuchClass"),
        ("fractions:Fraction", "members"),
        ("../reactor:Plant", "module:Class"),
    ],
)
def test_plants_that_are_none_are_refused(kind, expected, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "study.toml").write_text(STUDY.format(kind=kind))
    with pytest.raises(mampc.StudyError, match=expected):
        run_study(load_study("study.toml"))
