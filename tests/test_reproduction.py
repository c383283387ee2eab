"""The page that puts the paper's results beside ours, and the sensitivity runs behind it."""

import re
from itertools import islice

import pytest
from joblib import parallel_config

from mampc.compare.sensitivity import Point, holding, sensitivity, varied
from mampc.report import output, reproduction
from mampc.report.figures import study_figures
from mampc.report.page import Page
from mampc.study import load_study, parse_study, template
from mampc.study.regulators import regulator_of
from mampc.study.running import prepare, run_controller


def short_study(name):
    """The built-in one, with less to run."""
    study = load_study(name)
    shorter = study.identification.model_copy(update={"prbs_order": 6})
    return study.model_copy(update={"steps": 50, "identification": shorter})


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """The page of one short case with a small grid."""
    folder = tmp_path_factory.mktemp("page") / "out"
    patch = pytest.MonkeyPatch()
    patch.setattr(reproduction, "CASES", {"quadruple-tank": {"penalty": [1.0, 10.0], "noise": [0.1]}})
    patch.setattr(reproduction, "study_figures", lambda result: islice(study_figures(result), 2))
    patch.setattr(reproduction, "load_study", short_study)
    patch.setattr(output, "FIGURE_KINDS", ("svg",))
    with parallel_config("sequential"):  # processes would take longer to start than the runs
        cases = reproduction.reproduce(folder)
    patch.undo()
    return folder, cases


def test_the_page_shows_the_papers_figures_beside_the_runs(written):
    folder, cases = written
    text = (folder / "report.md").read_text()
    for published in ("0.579 0.613", "0.217", "0.193 0.193", "0.257", "0.553 0.584", "0.054"):
        assert published in text
    for scenario in cases[0].summary["scenarios"]:
        for controller in scenario["controllers"][:3]:  # the last is not the paper's
            assert f"{controller['tracking_error']:.3f}" in text
            assert f"{controller['without_transient']['tracking_error']:.3f}" in text


def test_the_html_page_needs_no_other_file(written):
    folder, _ = written
    page = (folder / "report.html").read_text()
    assert page.count("<svg") == (folder / "report.md").read_text().count("![")
    assert not re.search(r'(src|href)="(?!#)', page.replace('xlink:href="#', 'data-x="#'))
    ids = re.findall(r'\bid="([^"]+)"', page)
    assert len(ids) == len(set(ids))


def test_judgements_follow_from_the_figures(written):
    _, cases = written
    tables = []
    page = Page("judged")
    page.table = lambda header, rows: tables.append(rows)
    reproduction._judge(page, cases)
    for *_, paper, ours, judgement in tables[0]:
        same = all((float(ratio) < 1) == (float(paper) < 1) for ratio in ours.split(" / "))
        assert judgement.startswith("agrees") == same


def test_a_sensitivity_point_equals_the_runs_it_stands_for(written):
    _, cases = written
    study = cases[0].study
    prepared, scenario = prepare(study), study.scenarios[-1]
    plain, sparse = study.controllers[0], study.controllers[2]
    base, other = (
        run_controller(study, prepared, scenario, regulator_of(study, prepared.model, table)).metrics(
            threshold=0.1
        )
        for table in (plain, varied(study, scenario, sparse, "penalty", 1.0)[2])
    )
    point = cases[0].points[0]
    assert (point.setting, point.value) == ("penalty", 1.0)
    assert point.error_ratio == pytest.approx(other.tracking_error / base.tracking_error)
    assert point.changes_ratio == pytest.approx(other.sparse_density.sum() / base.sparse_density.sum())


@pytest.mark.parametrize(
    ("setting", "value", "look"),
    [
        ("move_weight", 0.3, lambda study, scenario, sparse: study.problem.move_weight),
        ("dt", 15.0, lambda study, scenario, sparse: study.dt),
        ("noise", 0.2, lambda study, scenario, sparse: scenario.noise),
        ("penalty", 3.0, lambda study, scenario, sparse: sparse.settings["penalty"]),
        ("max_moves", 5, lambda study, scenario, sparse: sparse.rules.max_moves),
        ("sparsity_horizon", 2, lambda study, scenario, sparse: sparse.rules.sparsity_horizon),
        ("reference", 2.0, lambda study, scenario, sparse: study.reference.changes[0].value[0] / 2),
    ],
)
def test_one_setting_changes_at_a_time(setting, value, look):
    study = parse_study(template())
    changed = varied(study, study.scenarios[0], study.controllers[2], setting, value)
    assert look(*changed) == value
    same = [a == b for a, b in zip(changed, (study, study.scenarios[0], study.controllers[2]), strict=True)]
    assert sum(same) == 2


def test_the_claim_holds_where_changes_fall_and_the_error_hardly_rises():
    points = [
        Point("dt", value, changes, error)
        for value, changes, error in ((1.0, 0.5, 1.1), (2.0, 0.5, 1.3), (3.0, 1.1, 1.0), (4.0, None, 1.0))
    ]
    assert [point.value for point in holding(points, 1.25)] == [1.0]


def test_progress_counts_every_run():
    short = short_study("quadruple-tank").model_copy(update={"steps": 20, "skip": 0})
    seen = []
    points = sensitivity(
        short, short.scenarios[0], short.controllers[3], {"penalty": [1.0, 10.0], "max_moves": [2]}, jobs=1,
        on_point=lambda done, total: seen.append((done, total)),
    )  # fmt: skip
    assert seen == [(1, 3), (2, 3), (3, 3)]
    assert [(point.setting, point.value) for point in points] == [
        ("penalty", 1.0),
        ("penalty", 10.0),
        ("max_moves", 2),
    ]
