"""Sweeps over the knobs of controllers, and the fronts that come of them."""

import json
import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console
from typer.testing import CliRunner

import mampc
from mampc.cli import app
from mampc.cli.console import bar, console_for_tables
from mampc.compare.fronts import Point, moves_at, non_dominated
from mampc.compare.knobs import knob_of, variants
from mampc.compare.sweep import Sweep, points_of, run_sweep
from mampc.report.fronts import equal_error, front_figure, front_tables, write_rows
from mampc.study import parse_study
from mampc.study.schema import ControllerTable
from studies import MPC_AND_PRICE, short_study, study_of_a_model

CONTROLLERS = (
    MPC_AND_PRICE
    + """
[[controllers]]
name = "dead band"
method = "dead_band"
settings = { size = 1.0 }
"""
)


def small_text():
    return short_study(CONTROLLERS, steps=25, skip=(15, 0))


def small(**changes):
    study = parse_study(small_text())
    return study.model_copy(update={"steps": 25, "skip": 0, "scenarios": study.scenarios[-1:], **changes})


@pytest.fixture(scope="module")
def swept(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sweep")
    sweep = Sweep(small(), seeds=3, points=3)
    return sweep, folder, run_sweep(sweep, folder, jobs=1)


def test_a_row_is_a_run_and_plain_mpc_is_among_them(swept):
    sweep, _, rows = swept
    assert len(rows) == sweep.runs == (1 + 3 + 3) * 3
    baseline, points = points_of(rows, sweep.study.scenarios[0].name)
    assert len(baseline.moves) == 3
    assert {name: len(own) for name, own in points.items()} == {"exact": 3, "dead band": 3}


def test_a_run_of_a_sweep_is_the_run_of_its_study(swept):
    from mampc.study.regulators import regulator_of
    from mampc.study.running import prepare, run_controller

    sweep, _, rows = swept
    study = sweep.study
    prepared = prepare(study)
    scenario = study.scenarios[0].model_copy(update={"seed": study.scenarios[0].seed + 1})
    run = run_controller(study, prepared, scenario, regulator_of(study, prepared.model, study.controllers[0]))
    row = next(row for row in rows if row["method"] == "mpc" and row["seed"] == scenario.seed)
    assert row["moves"] == run.metrics().moves.sum()
    assert row["error"] == pytest.approx(run.metrics().tracking_error, rel=1e-9)


@pytest.mark.parametrize(
    ("weight", "compared"),
    [(1.0, None), ([3.0, 3.0], None), ([[2.0, 0.0], [0.0, 2.0]], None), ([1.0, 1e4], [1.0, 1e4])],
)
def test_outputs_that_weigh_differently_are_compared_with_their_weights(weight, compared, tmp_path):
    from mampc.report.summary import summarise
    from mampc.report.tables import error_label
    from mampc.study import run_study

    study = small()
    study = study.model_copy(update={
        "steps": 8, "controllers": study.controllers[:1],
        "problem": study.problem.model_copy(update={"output_weight": weight}),
    })  # fmt: skip
    assert study.error_weight == compared
    assert ("weighted" in error_label(False, study.error_weight)) is (compared is not None)
    result = run_study(study)
    (run,) = next(iter(result.runs.values())).values()
    (entry,) = summarise(result)["scenarios"][0]["controllers"]
    squares = ((run.y - run.r) ** 2).mean(axis=0)
    assert entry["tracking_error"] == pytest.approx(squares.sum())
    assert entry["weighted_error"] == pytest.approx(squares @ ([1.0, 1.0] if compared is None else compared))
    for row in run_sweep(Sweep(study, seeds=1, points=1), tmp_path, jobs=1):
        assert row["error"] == pytest.approx(entry["weighted_error"])


def test_two_processes_give_the_same_rows(swept, tmp_path):
    sweep, _, rows = swept
    assert run_sweep(sweep, tmp_path, jobs=2) == rows


def test_what_is_finished_is_not_run_again(swept, tmp_path, monkeypatch):
    sweep, folder, rows = swept
    lines = (folder / "sweep.jsonl").read_text().splitlines()
    (tmp_path / "sweep.jsonl").write_text("\n".join(lines[: len(lines) // 2]) + '\n{"task": "half')
    seen = []
    assert run_sweep(sweep, tmp_path, jobs=1, on_task=lambda done, total: seen.append(done)) == rows
    assert seen[0] > 0
    monkeypatch.setattr("mampc.compare.sweep.prepare", None)  # nothing is left to run
    assert run_sweep(sweep, tmp_path, jobs=1) == rows


def test_a_killed_sweep_loses_nothing_that_had_finished(tmp_path, monkeypatch):
    (tmp_path / "small.toml").write_text(small_text())
    command = ["sweep", "small.toml", "--seeds", "1", "--points", "2", "--jobs", "1", "--out", "out"]
    process = subprocess.Popen(
        [sys.executable, "-m", "mampc", *command], cwd=tmp_path, stderr=subprocess.DEVNULL
    )
    journal = tmp_path / "out" / "sweep.jsonl"
    while process.poll() is None and not (journal.exists() and journal.read_text().count("task") >= 2):
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.wait()
    finished = journal.read_text().count('"task"')
    assert finished >= 2
    monkeypatch.chdir(tmp_path)
    assert f"{finished} of" in CliRunner().invoke(app, command, catch_exceptions=False).stderr
    assert (tmp_path / "out" / "sweep.csv").read_text().startswith("scenario,controller")


def test_what_is_wrong_is_told_before_anything_runs(tmp_path):
    with pytest.raises(mampc.MampcError, match="--jobs: expected -1"):
        run_sweep(Sweep(small(), seeds=1, points=2), tmp_path / "a", jobs=0)
    for size, message in (("big", "expected a number or one per signal"), ([1.0, 2.0, 3.0], "2 values")):
        tables = [ControllerTable(name="x", method="dead_band", settings={"size": size})]
        with pytest.raises(mampc.MampcError, match=message):
            run_sweep(Sweep(small(controllers=tables), seeds=1, points=2), tmp_path / "b", jobs=1)
    result = CliRunner().invoke(app, ["sweep", "quadruple-tank", "--table", "runs.xlsx"])
    assert "expected a name that ends in .csv or .parquet" in str(result.exception) + result.output


def test_whatever_answers_in_place_of_a_scheduler_is_told_in_one_sentence(swept, tmp_path, monkeypatch):
    distributed = pytest.importorskip("distributed", reason="needs the extra mampc[cluster]")

    def answers(*arguments, **options):
        raise MemoryError("3 EiB")

    monkeypatch.setattr(distributed, "Client", answers)
    with pytest.raises(mampc.MampcError, match=r"expected a Dask scheduler at .tcp"):
        run_sweep(swept[0], tmp_path, scheduler="tcp://127.0.0.1:80")


def test_results_of_another_study_are_refused(swept, tmp_path):
    _, folder, _ = swept
    (tmp_path / "sweep.jsonl").write_bytes((folder / "sweep.jsonl").read_bytes())
    with pytest.raises(mampc.MampcError, match="another sweep"):
        run_sweep(Sweep(small(steps=26), seeds=3, points=3), tmp_path)


def test_results_of_another_model_are_refused(tmp_path):
    text = study_of_a_model("[[scenarios]]\nname = 'one'\n" + MPC_AND_PRICE, steps=8)
    for gain in (1.0, 1.0, 2.0):
        lags = {"gain": gain * np.array([[1.0, 0.3], [0.2, 1.0]]), "time_constant": np.full((2, 2), 5.0)}
        mampc.StateSpace.from_first_order(**lags, dt=1.0).save(tmp_path / "model.json")
        again = Sweep(parse_study(text, folder=tmp_path), seeds=1, points=1)
        if gain == 1.0:
            run_sweep(again, tmp_path, jobs=1)
    with pytest.raises(mampc.MampcError, match="another sweep"):
        run_sweep(again, tmp_path, jobs=1)


def test_a_scheduler_that_is_not_there_is_told_in_one_sentence(swept, tmp_path, monkeypatch):
    pytest.importorskip("distributed", reason="needs the extra mampc[cluster]")
    monkeypatch.setattr("mampc.compare.sweep.SCHEDULER_SECONDS", 0.3)
    with pytest.raises(mampc.MampcError, match=r"expected a Dask scheduler at .tcp"):
        run_sweep(swept[0], tmp_path, scheduler="tcp://127.0.0.1:9")


def test_a_cluster_gives_the_same_rows(swept, tmp_path):
    distributed = pytest.importorskip("distributed", reason="needs the extra mampc[cluster]")
    with distributed.LocalCluster(n_workers=1, dashboard_address=None, processes=False) as cluster:
        assert run_sweep(swept[0], tmp_path, scheduler=cluster.scheduler_address) == swept[2]


@pytest.mark.slow
def test_a_cluster_that_loses_a_worker_gives_the_same_rows(swept, tmp_path):
    distributed = pytest.importorskip("distributed", reason="needs the extra mampc[cluster]")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None, processes=True, silence_logs=50
    ) as cluster:
        killed = []

        def kill_one(done, total):
            if done == 2 and not killed:
                killed.append(cluster.workers[0].pid)
                os.kill(killed[0], signal.SIGKILL)

        rows = run_sweep(swept[0], tmp_path, scheduler=cluster.scheduler_address, on_task=kill_one)
    assert killed
    assert rows == swept[2]


def test_the_front_is_what_no_point_beats_in_both():
    moves, errors = np.array([10.0, 5.0, 6.0, 1.0, 2.0]), np.array([1.0, 1.2, 1.3, 2.0, 1.9])
    assert non_dominated(moves, errors).tolist() == [0, 1, 4, 3]


def test_moves_at_equal_error_are_interpolated_and_their_spread_is_that_of_the_loops():
    rng = np.random.default_rng(0)
    base = Point("MPC", 1.0, np.full(400, 100.0), np.ones(400))
    wobble = np.exp(0.2 * rng.standard_normal(400))
    points = [Point("x", v, m * wobble, np.full(400, e)) for v, m, e in [(1.0, 40.0, 1.1), (2.0, 10.0, 1.4)]]
    found = moves_at(points, base, 1.25)
    assert found.value == pytest.approx(np.sqrt(0.4 * 0.1) * wobble.mean(), rel=1e-9)
    assert found.standard_error == pytest.approx(found.value * 0.2 / np.sqrt(400), rel=0.2)
    assert np.isnan(moves_at(points, base, 1.05).value)
    assert moves_at(points, base, 3.0).value == pytest.approx(0.1 * wobble.mean())


@pytest.mark.parametrize(
    ("table", "place", "values"),
    [
        ({"method": "exact", "rules": {"price": 2.0}}, "rules.price", [0.125, 2.0, 32.0]),
        ({"method": "alternating", "rules": {"max_moves": 3}}, "rules.max_moves", [1, 3, 48]),
        ({"method": "dead_band", "settings": {"size": [1.0, 2.0]}}, "settings.size", [1 / 16, 1.0, 16.0]),
        ({"method": "periodic", "settings": {"every": 4}}, "settings.every", [1, 4, 64]),
        ({"method": "mpc"}, None, [1.0]),
    ],
)
def test_each_method_has_one_knob(table, place, values):
    table = ControllerTable(name="x", **table)
    assert knob_of(table) == place
    found = variants(table, 3)
    assert [value for value, _ in found] == pytest.approx(values)
    assert all(changed.method == table.method for _, changed in found)


def test_the_table_is_read_back_as_parquet(swept, tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet", reason="needs pyarrow")
    write_rows(swept[2], tmp_path / "runs.parquet")
    assert parquet.read_table(tmp_path / "runs.parquet").to_pylist() == swept[2]


def test_equal_error_compares_every_controller_with_plain_mpc(swept):
    sweep, _, rows = swept
    found = equal_error(rows, sweep.study.scenarios[0].name)
    assert set(found) == {"exact", "dead band"}


def test_names_that_look_like_markup_stand_as_they_are(swept, capsys):
    _, _, rows = swept
    names = {"exact": "exact [red]", "dead band": "[/b]"}
    named = [row | {"scenario": "[i]", "controller": names.get(row["controller"], "MPC")} for row in rows]
    for table in front_tables(named):
        console_for_tables().print(table)
    printed = capsys.readouterr().out
    assert all(name in printed for name in ("[i]: moves", *names.values()))


def test_the_error_that_is_marked_is_in_the_picture(swept):
    pytest.importorskip("matplotlib")
    _, _, rows = swept
    figure = front_figure(rows, rows[0]["scenario"], 6.0)
    assert figure.axes[0].get_xlim()[1] > 6.0


def test_a_bar_bears_any_file_name(monkeypatch, capsys):
    monkeypatch.setattr("mampc.cli.console.Console", partial(Console, force_terminal=True, width=100))
    with bar("{x} [/b].toml") as show:
        show(1, 2)
    assert "{x} [/b].toml" in capsys.readouterr().err


def test_the_command_draws_and_tabulates(tmp_path, monkeypatch):
    pytest.importorskip("matplotlib")
    monkeypatch.chdir(tmp_path)
    Path("small.toml").write_text(small_text())
    result = CliRunner().invoke(
        app, ["front", "small.toml", "--seeds", "2", "--points", "2", "--jobs", "1", "--out", "out"]
    )
    assert result.exit_code == 0, result.output
    assert "moves at equal error" in result.output
    assert Path("out/noisy_front.svg").exists()
    assert json.loads(Path("out/sweep.jsonl").read_text().splitlines()[0])["sweep"]


def test_a_large_grid_asks_first(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("mampc.cli.comparing.LARGE_SWEEP", 1)
    Path("small.toml").write_text(small_text())
    result = CliRunner().invoke(app, ["sweep", "small.toml", "--seeds", "2", "--points", "2"], input="n\n")
    assert result.exit_code == 1
    assert "on two cores" in result.output + (result.stderr or "")
