"""Study files: what is accepted, what is refused and how, and what comes of a run."""

import io
import json
import re

import numpy as np
import pytest
from rich.console import Console

import mampc
from mampc.report import output
from mampc.report.figures import study_figures
from mampc.report.folder import ResultFolder
from mampc.report.output import run_and_write
from mampc.report.summary import summarise
from mampc.report.tables import comparison_tables
from mampc.study import Study, builtin_studies, load_study, parse_study, run_study, template
from mampc.study.loading import _table_of

SHORT = template().replace("steps = 145", "steps = 20").replace("prbs_order = 8", "prbs_order = 6")
SHORT = SHORT.replace("at = 50", "at = 12").replace("at = 100", "at = 16")


@pytest.fixture(scope="module")
def result():
    return run_study(parse_study(SHORT))


def test_the_template_is_the_built_in_study():
    assert "quadruple-tank" in builtin_studies()
    assert parse_study(template()) == load_study("quadruple-tank")


@pytest.mark.parametrize(
    ("right", "wrong", "named", "expected"),
    [
        ("steps = 145", 'steps = "many"', "steps", "integer"),
        ("steps = 145", "steps = 145.5", "steps", "integer"),
        ("steps = 145", "steps = 0", "steps", "greater than or equal to 1"),
        ('dt = "10 s"', 'dt = "10 kg"', "dt", "units ms, s, min, h"),
        ('dt = "10 s"', 'dt = "soon"', "dt", "10 s"),
        ('dt = "10 s"', "dt = -1", "dt", "greater than 0"),
        (
            "prediction_horizon",
            "predicton_horizon",
            "problem.predicton_horizon",
            "mean 'prediction_h",
        ),
        ("{ u_min = 0.0", "{ umin = 0.0", "problem.limits.umin", "'u_min'"),
        ('kind = "quadruple-tank"', 'kind = "octuple-tank"', "plant.kind", "quadruple-tank"),
        ("move_weight = 0.1", 'move_weight = "big"', "problem.move_weight", "number"),
        ("move_weight = 0.1", "move_weight = nan", "problem.move_weight", "finite"),
        ("max_moves = 3", "max_moves = 3.5", "controllers[1].rules.max_moves", "integer"),
        ("max_moves = 3", "levels = [[]], max_moves = 3", "controllers[1].rules.levels", "at least 1"),
        ("max_moves = 3", "levels = 0.0, max_moves = 3", "controllers[1].rules.levels", "greater than 0"),
        ("max_moves = 3", "max_moves = -1", "controllers[1].rules.max_moves", "greater than or equal to 0"),
        ('method = "mpc"', 'method = "magic"', "controllers[0]", "alternating"),
        ("noise = 0.0", 'noise = "loud"', "scenarios[0].noise", "number"),
        ("{ at = 5,", "{ at = -5,", "reference.changes[0].at", "greater than or equal to 0"),
        ("[plant]", "[plnt]", "plnt", "'plant'"),
        ("skip = 15", "skip = 145", "skip", "below the 145 steps"),
        ('name = "noisy"', 'name = "Noise free"', "scenarios", "names that differ"),
    ],
)
def test_a_wrong_key_type_or_unit_is_named_with_its_place(right, wrong, named, expected):
    assert right in template()
    with pytest.raises(mampc.StudyError) as complaint:
        parse_study(template().replace(right, wrong, 1), "my-study.toml")
    message = str(complaint.value)
    assert "my-study.toml" in message
    assert named in message
    assert expected in message


@pytest.mark.parametrize(
    ("right", "wrong", "expected"),
    [
        ("control_horizon = 5", "control_horizon = 11", "control_horizon"),
        ("u_min = 0.0", "u_min = 200.0", "u_min <= u_max"),
        ("u_max = 100.0", "u_max = [1.0, 2.0, 3.0]", "received shape"),
        ("initial = [0.0, 0.0]", "initial = [0.0]", "values"),
        ("# parameters = { gamma = [0.3, 0.3] }", "parameters = { gama = 1 }", "gama"),
        ("# parameters = { gamma = [0.3, 0.3] }", "parameters = { gamma = [2.0, 0.3] }", "within 0..1"),
        ("max_moves = 3", "levels = [0.5], max_moves = 3", "one entry for each of 2 inputs"),
        ("settings = { penalty = 10.0 }", "settings = { penality = 10.0 }", "penality"),
        ("settings = { penalty = 10.0 }", "settings = { penalty = -1.0 }", "penalty"),
        ("amplitude = 25.0", "amplitude = [1.0, 2.0, 3.0]", "amplitude"),
    ],
)
def test_values_that_do_not_fit_together_are_refused(right, wrong, expected):
    assert right in SHORT
    with pytest.raises(mampc.MampcError, match=expected):
        run_study(parse_study(SHORT.replace(right, wrong, 1)))


def test_times_have_units():
    assert parse_study(template().replace('"10 s"', '"0.5 min"')).dt == 30.0
    assert parse_study(template().replace('"10 s"', "12")).dt == 12.0


def test_text_that_is_not_toml_is_refused():
    with pytest.raises(mampc.StudyError, match="TOML"):
        parse_study("name = ")


@pytest.mark.parametrize(
    ("right", "wrong", "expected"),
    [
        ("steps = 145", "steps = " + "9" * 5000, "lines of at most 2000 characters"),
        ("steps = 145", "steps = 0x" + "f" * 1000, "steps"),
        ("penalty = 10.0", "penalty = 0x" + "f" * 1000, "penalty: expected a finite number"),
        ("amplitude = 25.0", "amplitude = 0x" + "f" * 1000, "amplitude"),
        ("\nseed = 0", "\nseed = 0x" + "f" * 1000, "seed"),
        ("at = 5,", "at = 1000000000000,", "changes[0].at"),
        ('name = "MPC"', f'name = "{"中" * 80}"', "controllers[0].name: expected a name of at most 80 bytes"),
        ('name = "noisy"', f'name = "{"中" * 80}"', "scenarios[1].name: expected a name of at most 80 bytes"),
        ("[plant]", "a" + ".a" * 2000 + " = 1\n[plant]", "lines of at most 2000 characters"),
        ("[plant]", "x = " + "[\n" * 5000 + "\n[plant]", "expected TOML"),
        ("[plant]", "#\n" * 2**17 + "\n[plant]", "at most 262144 characters"),
    ],
)
def test_numbers_keys_and_names_beyond_all_bounds_are_refused_in_short(right, wrong, expected):
    assert right in template()
    with pytest.raises(mampc.StudyError) as complaint:
        parse_study(template().replace(right, wrong, 1))
    assert expected in str(complaint.value)
    assert len(str(complaint.value)) < 1000


def test_of_many_complaints_the_first_are_shown():
    text = "\n".join(f"key{i} = 1" for i in range(5000)) + "\n" + template()
    with pytest.raises(mampc.StudyError, match=r"key19: unknown key.*\n.*more like these") as complaint:
        parse_study(text)
    assert len(str(complaint.value).splitlines()) == 22


def test_a_byte_order_mark_does_not_matter(tmp_path):
    (tmp_path / "study.toml").write_text(template(), encoding="utf-8-sig")
    assert load_study(tmp_path / "study.toml").model_dump(exclude={"place"}) == parse_study(
        template()
    ).model_dump(exclude={"place"})


def test_a_model_file_with_an_impossible_name_is_refused():
    before, after = SHORT.index("[identification]"), SHORT.index("[problem]")
    text = SHORT[:before] + '[model]\nfile = "a\\u0000b"\n\n' + SHORT[after:]
    with pytest.raises(mampc.StudyError, match=r"model\.file: expected the path of a file"):
        run_study(parse_study(text))


def test_a_file_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(mampc.StudyError, match="quadruple-tank"):
        load_study(tmp_path / "none.toml")


def test_an_unstable_loop_is_warned_of():
    study = parse_study(SHORT.replace('dt = "10 s"', "dt = 5.0"))
    assert any("unstable" in warning for warning in run_study(study).warnings)


def test_every_controller_sees_the_same_noise(result):
    runs = result.runs["noisy"].values()
    noise = [run.y_measured - run.y for run in runs]
    for other in noise[1:]:
        np.testing.assert_allclose(other, noise[0], atol=1e-12)
    assert np.std(noise[0]) == pytest.approx(0.1, rel=0.5)


def test_a_noise_free_run_rests_until_the_reference_moves(result):
    run = result.runs["noise-free"]["MPC"]
    np.testing.assert_allclose(run.u[:5], 50.0, atol=1e-6)
    np.testing.assert_allclose(run.y[:5], run.r[:5], atol=1e-6)


def test_the_summary_holds_what_is_promised(result):
    summary = json.loads(json.dumps(summarise(result), allow_nan=False))
    assert {"study", "steps", "dt", "scenarios"} <= set(summary)
    assert [scenario["name"] for scenario in summary["scenarios"]] == ["noise-free", "noisy"]
    for scenario in summary["scenarios"]:
        names = [entry["name"] for entry in scenario["controllers"]]
        assert names == [table.name for table in result.study.controllers]
        for entry in scenario["controllers"]:
            for part in (entry, entry["without_transient"]):
                assert part["sparse_density"]["threshold"] == 0.1
                assert len(part["sparse_density"]["per_input"]) == 2
                assert len(part["sparse_density"]["exact_per_input"]) == 2
                assert part["tracking_error"] >= 0
            assert entry["without_transient"]["skipped"] == 15
            assert {"median", "p99", "max"} == set(entry["solve_time_us"])
            assert {"proven", "bounded", "median", "max"} == set(entry["gap"])
            assert sum(entry["status"].values()) == 20
            assert len(entry["travel_per_input"]) == 2
            assert entry["moves"] == sum(entry["moves_per_input"])
            priced = next(
                t.rules and t.rules.price for t in result.study.controllers if t.name == entry["name"]
            )
            assert entry["counts_on_later_data"] is bool(priced)
            assert entry["largest_offset"] == [None, None]  # without a tail


def test_the_files_of_a_run_can_be_read_back(tmp_path, monkeypatch):
    names = ("noisy_u1", "noisy_moves-against-error")
    monkeypatch.setattr(
        output, "study_figures", lambda result: (f for f in study_figures(result) if f.name in names)
    )
    result, summary, missing = run_and_write(parse_study(SHORT), tmp_path / "out")
    assert missing == ()
    assert json.loads((tmp_path / "out" / "summary.json").read_text()) == summary
    model = mampc.StateSpace.load(tmp_path / "out" / "model.json")
    np.testing.assert_array_equal(model.A, result.model.A)
    trajectory = np.genfromtxt(tmp_path / "out" / "noisy_mpc.csv", delimiter=",", names=True)
    np.testing.assert_array_equal(trajectory["u1"], result.runs["noisy"]["MPC"].u[:, 0])
    for name in names:
        for kind in ("png", "svg"):
            assert (tmp_path / "out" / "figures" / f"{name}.{kind}").stat().st_size > 1000


def test_a_file_of_a_result_folder_appears_whole_or_not_at_all(tmp_path):
    folder = ResultFolder(tmp_path / "out", last="summary.json")
    with pytest.raises(RuntimeError), folder.writing("a.csv") as unfinished:
        unfinished.write_text("half")
        raise RuntimeError
    assert not (tmp_path / "out" / "a.csv").exists()
    with folder.writing("a.csv") as unfinished:
        unfinished.write_text("whole")
    assert (tmp_path / "out" / "a.csv").read_text() == "whole"


def test_a_new_run_clears_the_last_one_away_and_leaves_files_of_others(tmp_path):
    target = tmp_path / "out"
    for names in (("a.csv", "figures/b.png", "summary.json"), ("c.csv", "summary.json")):
        folder = ResultFolder(target, last="summary.json")
        (target / "notes.txt").write_text("mine")
        folder.clear()
        for name in names:
            with folder.writing(name) as unfinished:
                unfinished.write_text(name)
    left = {path.relative_to(target).as_posix() for path in target.rglob("*") if path.is_file()}
    assert left == {"c.csv", "summary.json", "notes.txt", ".mampc-files"}


def test_a_list_of_files_that_leads_out_of_its_folder_is_not_believed(tmp_path):
    (tmp_path / "mine.csv").write_text("mine")
    folder = ResultFolder(tmp_path / "out", last="summary.json")
    (tmp_path / "out" / ".mampc-files").write_text("../mine.csv\n")
    folder.clear()
    assert (tmp_path / "mine.csv").exists()


def test_what_a_killed_run_left_half_written_is_cleared_away(tmp_path):
    target = tmp_path / "out"
    target.mkdir()
    (target / ".mampc-files").write_text("a.csv\n")
    (target / ".a.csv.partial-999999999").write_text("half")
    (target / ".notes.partial-999999999").write_text("not ours")
    (target / ".a.csv.partial-draft").write_text("not ours")
    ResultFolder(target, last="summary.json")
    left = {path.name for path in target.iterdir()}
    assert left == {".mampc-files", ".notes.partial-999999999", ".a.csv.partial-draft"}


def test_a_study_that_does_not_fit_leaves_the_last_results_alone(tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "summary.json").write_text("old")
    wrong = SHORT.replace("control_horizon = 5", "control_horizon = 15")
    with pytest.raises(mampc.StudyError):
        run_and_write(parse_study(wrong), tmp_path / "out")
    assert (tmp_path / "out" / "summary.json").read_text() == "old"


def test_names_that_look_like_markup_are_shown_as_they_are(tmp_path, few_figures):
    text = SHORT.replace('name = "MPC"', r"name = 'a [/b] $\foo{$'")
    outcome, summary, missing = run_and_write(parse_study(text), tmp_path / "out")
    assert missing == ()
    console = Console(width=200, file=io.StringIO())
    for scenario in summary["scenarios"]:
        for entry in scenario["controllers"]:
            entry["tracking_error"] = 1.234e-9  # of outputs in small units
    for table in comparison_tables(outcome.study, summary):
        console.print(table)
    assert "a [/b] $" in console.file.getvalue()
    assert "1.23e-09" in console.file.getvalue()


def test_trajectories_of_names_that_share_words_stay_apart(tmp_path, few_figures):
    text = SHORT.replace('name = "noise-free"', 'name = "a"').replace('name = "noisy"', 'name = "a-b"')
    text = text.replace('name = "MPC"', 'name = "c"').replace('name = "MAMPC ns=1"', 'name = "b-c"')
    outcome, *_ = run_and_write(parse_study(text), tmp_path / "out")
    runs = sum(len(runs) for runs in outcome.runs.values())
    assert len(list((tmp_path / "out").glob("a*.csv"))) == runs


def test_an_identified_model_file_can_be_studied(result, tmp_path):
    result.model.save(tmp_path / "model.json")
    before, after = SHORT.index("[identification]"), SHORT.index("[problem]")
    text = SHORT[:before] + '[model]\nfile = "model.json"\n\n' + SHORT[after:]
    (tmp_path / "study.toml").write_text(text.replace('kind = "quadruple-tank"', 'kind = "model"'))
    outcome = run_study(load_study(tmp_path / "study.toml"))
    assert outcome.identified is None
    assert outcome.runs["noise-free"]["MPC"].statuses == {"optimal": 20}
    np.testing.assert_array_equal(outcome.model.A, result.model.A)


def test_a_path_outside_the_studys_folder_is_refused(result, tmp_path):
    result.model.save(tmp_path / "model.json")
    (tmp_path / "inner").mkdir()
    before, after = SHORT.index("[identification]"), SHORT.index("[problem]")
    text = SHORT[:before] + '[model]\nfile = "../model.json"\n\n' + SHORT[after:]
    (tmp_path / "inner" / "study.toml").write_text(text)
    with pytest.raises(mampc.StudyError, match="within the study's folder"):
        run_study(load_study(tmp_path / "inner" / "study.toml"))


def keys_of(table, seen=()):
    """Every key that a study may have, with those of the tables in it."""
    for name, field in table.model_fields.items():
        yield name
        inner = _table_of(field.annotation)
        if inner is not None and inner not in seen:
            yield from keys_of(inner, (*seen, inner))


def test_the_template_shows_every_key():
    text = template()
    missing = {key for key in keys_of(Study) if not re.search(rf"\b{key}\b", text)}
    assert missing <= {"place"}


def test_what_the_template_shows_in_comments_can_be_said():
    """Zones that change, ranks, resting values, banks and switches, all at once."""
    text = template().replace("steps = 145", "steps = 60").replace("prbs_order = 8", "prbs_order = 6")
    text = text.replace("at = 100", "at = 55")
    for key in (
        "zone_below",
        "zone_above",
        "zone_pull",
        "output_rank",
        "u_target",
        "u_target_weight",
        "u_cost",
        "zones",
        "switches",
    ):
        assert re.search(rf"^# {key} = ", text, re.M), key
        text = re.sub(rf"^# {key} = ", f"{key} = ", text, flags=re.M)
    text = re.sub(r"^#   value, or one per output; inf.*$", "", text, flags=re.M)
    bank = text[text.index("# [[controllers]]") :]
    text = text.replace(bank, re.sub(r"^# ", "", bank, flags=re.M)).replace(
        'variant = "brisk"', 'variant = "exact price"'
    )
    study = parse_study(text)
    assert study.controllers[-1].variants == ["MPC", "exact price"]
    assert study.scenarios[-1].switches[0].variant == "exact price"
    assert study.reference.zones[0].above == [0.2, np.inf]
    assert study.problem.output_rank == [1, 2]
