"""The command line: what it prints, writes, refuses and returns."""

import io
import json
import signal
import subprocess
import sys
from contextlib import chdir, redirect_stderr, redirect_stdout
from typing import NamedTuple

import numpy as np
import pytest

import mampc
from mampc.cli import main
from mampc.study import template


class Done(NamedTuple):
    returncode: int
    stdout: str
    stderr: str


def call(*arguments, cwd, out=None):
    """What the command says and returns; in this process, since a new one would spend its time on imports."""
    out, err, handler = out or io.StringIO(), io.StringIO(), signal.getsignal(signal.SIGINT)
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(out), redirect_stderr(err), chdir(cwd):
        patch.setattr(sys, "argv", ["mampc", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            main()
    signal.signal(signal.SIGINT, handler)
    return Done(ended.value.code or 0, getattr(out, "getvalue", str)(), err.getvalue())


@pytest.fixture(scope="module")
def record(tmp_path_factory):
    """A CSV file of a known model's response, and the model."""
    folder = tmp_path_factory.mktemp("record")
    rng = np.random.default_rng(0)
    model = mampc.StateSpace([[0.8, 0.1], [0.0, 0.6]], [[1.0, 0.2], [0.3, 1.0]], np.eye(2), None, dt=10.0)
    u = mampc.prbs(order=7, amplitude=2.0, inputs=2, hold=3, mean=5.0)
    y = model.response(u) + 0.05 * rng.standard_normal((len(u), 2))
    path = folder / "data.csv"
    mampc.IOData(u, y, 10.0, mampc.Names(("valve", "pump"), ("level", "flow"))).to_csv(path)
    return path


def test_identify_writes_a_model_and_its_validation(record, tmp_path):
    out = tmp_path / "model.json"
    done = call(
        "identify", record, "--inputs", "valve,pump", "--outputs", "level,flow", "--dt", "10", "--out", out,
        cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "Order 2" in done.stdout
    model = mampc.StateSpace.load(out)
    assert model.names.inputs == ("valve", "pump")
    np.testing.assert_allclose(np.sort(model.poles().real), [0.6, 0.8], atol=0.05)
    for kind in ("png", "svg"):
        assert (tmp_path / f"model.{kind}").stat().st_size > 1000


def test_new_writes_a_study_once_and_run_runs_it(tmp_path, few_figures):
    assert call("new", "my-study.toml", cwd=tmp_path).returncode == 0
    study = tmp_path / "my-study.toml"
    assert study.read_text() == template()
    again = call("new", "my-study.toml", cwd=tmp_path)
    assert again.returncode == 2
    assert "does not exist yet" in again.stderr
    study.write_text(
        template().replace("steps = 145", "steps = 20").replace("prbs_order = 8", "prbs_order = 6")
    )
    done = call("run", "my-study.toml", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "MAMPC ns=3" in done.stdout
    summary = json.loads((tmp_path / "results" / "my-study" / "summary.json").read_text())
    assert summary["steps"] == 20


IDENTIFY_SHORT = ("identify", "short.csv", "--inputs", "u", "--outputs", "y", "--dt", "1")


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("run", "no-such-study"), "quadruple-tank"),
        (("run", "bad.toml"), "did you mean 'steps'"),
        (("identify", "none.csv", "--inputs", "u", "--outputs", "y", "--dt", "1"), "none.csv"),
        (("identify", "empty.csv", "--inputs", "u", "--outputs", "y", "--dt", "1"), "at least one row"),
        (("identify", "ragged.csv", "--inputs", "u", "--outputs", "y", "--dt", "1"), "expected 2 fields"),
        (("identify", "short.csv", "--inputs", "u", "--outputs", "y", "--dt", "1"), "samples"),
        (("identify", "short.csv", "--inputs", "u", "--outputs", "z", "--dt", "1"), "'z'"),
        (("identify", "short.csv", "--inputs", "u", "--outputs", "y", "--dt", "-1"), "dt"),
        (("new", "no-such-folder/study.toml"), "written"),
        (("identify", "short.csv"), "--inputs"),
        (("identify", "a" * 300, "--inputs", "u", "--outputs", "y"), "too long"),
        (("identify", "", "--inputs", "u", "--outputs", "y"), "readable"),
        ((*IDENTIFY_SHORT, "--out", "a" * 300 + ".json"), "mampc:"),
        (("inspect", "a" * 300), "too long"),
        (("inspect", "short.csv", "--dt", "1", "--range", "u"), "--range: expected COLUMN=LOW:HIGH"),
        (("run", "a" * 300), "mampc:"),
        (("run", "quadruple-tank", "--out", "a" * 300), "mampc:"),
        (("new", "a" * 300), "mampc:"),
        (("replay", "a" * 300, "-s", "quadruple-tank"), "mampc:"),
        (("reproduce", "--out", "a" * 300), "mampc:"),
    ],
)
def test_complaints_go_to_standard_error_without_a_traceback(arguments, expected, tmp_path):
    (tmp_path / "bad.toml").write_text(template().replace("steps = 145", "stepps = 145"))
    (tmp_path / "empty.csv").write_text("")
    (tmp_path / "ragged.csv").write_text("u,y\n1,2\n3\n")
    (tmp_path / "short.csv").write_text("u,y\n1,2\n3,4\n")
    before = sorted(path.name for path in tmp_path.iterdir())
    done = call(*arguments, cwd=tmp_path)
    assert done.returncode == 2
    assert expected in done.stderr
    assert "Traceback" not in done.stderr + done.stdout
    assert sorted(path.name for path in tmp_path.iterdir()) == before


@pytest.mark.parametrize("command", [(), ("run",), ("new",), ("inspect",), ("identify",)])
def test_help_shows_how(command, tmp_path):
    done = call(*command, "--help", cwd=tmp_path)
    assert done.returncode == 0
    if command:
        assert f"mampc {command[0]} " in done.stdout.split("Example", 1)[1]
    else:  # in the order of work
        steps = ("inspect", "identify", "new", "run", "tune", "replay")
        places = [done.stdout.index(f"│ {step} ") for step in steps]
        assert places == sorted(places)


def test_a_process_of_its_own_complains_alike(tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "mampc", "run", "no-such-study"], cwd=tmp_path, capture_output=True, text=True,
        check=False,
    )  # fmt: skip
    here = call("run", "no-such-study", cwd=tmp_path)
    assert (done.returncode, done.stdout, done.stderr) == (2, here.stdout, here.stderr)


def test_identify_replaces_models_and_nothing_else(record, tmp_path):
    data = tmp_path / "data.json"
    data.write_bytes(record.read_bytes())
    done = call("identify", data, "--inputs", "valve", "--outputs", "level", "--dt", "10", cwd=tmp_path)
    assert done.returncode == 2
    assert data.read_bytes() == record.read_bytes()


def test_a_model_that_explains_little_is_warned_of(tmp_path):
    rng = np.random.default_rng(0)
    mampc.IOData(rng.standard_normal((300, 1)), rng.standard_normal((300, 1)), 1.0).to_csv(
        tmp_path / "noise.csv"
    )
    done = call("identify", "noise.csv", "--inputs", "u1", "--outputs", "y1", cwd=tmp_path)
    assert done.returncode == 0
    assert "warning: the model explains less" in done.stderr


@pytest.fixture
def gappy(record, tmp_path):
    """The record with two marks and a gap, under names with commas."""
    lines = record.read_text().splitlines()
    lines[0] = 'time,"valve, left",pump,level,flow'
    lines[50] = lines[50].rsplit(",", 1)[0] + ",Bad"
    del lines[90:95]
    (tmp_path / "gappy.csv").write_text("\n".join(lines))
    return tmp_path / "gappy.csv"


def test_identify_tells_what_it_noticed_and_takes_every_piece(gappy, tmp_path, few_figures):
    names = ("--inputs", '"valve, left",pump', "--outputs", "level,flow")
    done = call("identify", "gappy.csv", *names, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "flow: no number in 1 of" in done.stdout
    assert "2 gaps in the record" in done.stdout
    assert "Estimated on 2 pieces of" in done.stdout or "Estimated on 3 pieces of" in done.stdout
    poles = mampc.StateSpace.load(tmp_path / "gappy.json").poles()
    np.testing.assert_allclose(np.sort(poles.real), [0.6, 0.8], atol=0.05)


def test_identify_takes_several_files(record, gappy, tmp_path, few_figures):
    (tmp_path / "other.csv").write_text(gappy.read_text().replace('"valve, left"', "valve"))
    done = call(
        "identify", record, "other.csv", "--inputs", "valve,pump", "--outputs", "level,flow", "-o", "m.json",
        cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "other.csv: 2 gaps" in done.stdout


def test_a_sample_time_against_the_file_is_refused(record, tmp_path):
    done = call("identify", record, "--inputs", "valve", "--outputs", "level", "--dt", "1", cwd=tmp_path)
    assert done.returncode == 2
    assert "dt: expected 10 s, the step of column 'time', received 1 s" in done.stderr
    assert not list(tmp_path.iterdir())


def test_inspect_shows_columns_gaps_and_marks_and_draws_them(gappy, tmp_path):
    done = call("inspect", "gappy.csv", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    for words in (
        "valve, left",
        "could be an input",
        "1 gap in the record",
        "flow: no number in 1 of",
        "every 10 s",
    ):
        assert words in done.stdout
    assert (tmp_path / "gappy-columns.png").stat().st_size > 10_000
    assert (tmp_path / "gappy-columns.svg").exists()


def test_inspect_tells_what_is_missing_and_what_to_decide(tmp_path):
    n = 60
    u = np.where(np.arange(n) % 10 < 5, 1.0, 2.0)
    rows = [f"{k % 7 + 60 * k},{u[k]},{2 * u[k]},{k > 30:d},{k / 7}" for k in range(n)]
    rows[7] = rows[7].rsplit(",", 1)[0] + ",12 bar"
    (tmp_path / "a.csv").write_text("nr,u,v,w,y\n" + "\n".join(rows))
    done = call("inspect", "a.csv", "--inputs", "u,v,w", "--outputs", "y", "--out", "seen.png", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "u and v move together (correlation of moves 1.00)" in done.stdout
    assert "w moves 1 time in 60 samples" in done.stdout
    assert "received '12 bar'" in done.stdout.split("To decide before")[1]
    assert (tmp_path / "seen.svg").exists()


def test_scattered_bad_values_do_not_spoil_a_model(tmp_path, few_figures):
    rng = np.random.default_rng(1)
    model = mampc.StateSpace([[0.9]], [[1.0]], [[1.0]], None, dt=10.0)
    u = mampc.prbs(order=8, amplitude=1.0, hold=4)
    y = model.response(u) + 0.1 * rng.standard_normal((len(u), 1))
    cells = [[f"{10 * k}", f"{a[0]}", f"{b[0]:.4f}"] for k, (a, b) in enumerate(zip(u, y, strict=True))]
    for k in rng.choice(len(cells), 40, replace=False):
        cells[k][2] = "Bad"
    (tmp_path / "a.csv").write_text("time,u,y\n" + "\n".join(map(",".join, cells)))
    left_out, filled = "left out of the identification; --fill", "40 missing values put in"
    for options, words in (((), left_out), (("--fill", "5"), filled)):
        done = call("identify", "a.csv", "--inputs", "u", "--outputs", "y", *options, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        assert words in done.stdout
        identified = mampc.StateSpace.load(tmp_path / "a.json")
        assert mampc.validate(identified, mampc.IOData(u, y, 10.0)).fit[0] > 90


def test_an_interruption_says_what_was_kept_and_exits_with_130(tmp_path):
    process = subprocess.Popen(
        [sys.executable, "-m", "mampc", "run", "quadruple-tank", "--out", "out"],
        cwd=tmp_path, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True,
    )  # fmt: skip
    assert process.stderr is not None
    said = process.stderr.readline()  # the first stage has begun
    process.send_signal(signal.SIGINT)
    said += process.stderr.read()
    assert process.wait() == 130
    assert "mampc: interrupted; what had finished is written" in said
    assert "Traceback" not in said


@pytest.mark.parametrize("encoding", ["ascii", "cp1252"])
def test_output_that_knows_few_signs_gets_the_others_replaced(encoding, tmp_path):
    names = mampc.Names(("Ventil Ω",), ("T",), units={"T": "°C"})
    mampc.StateSpace([[0.9]], [[0.1]], [[1.0]], None, dt=1.0, names=names).save(tmp_path / "model.json")
    out = io.TextIOWrapper(io.BytesIO(), encoding=encoding)
    done = call("show", "model.json", cwd=tmp_path, out=out)
    assert done.returncode == 0, done.stderr
    out.seek(0)
    assert "Ventil ?" in out.read()
