"""report.html of tuning: the front to click through, with runs at its prices beside the baseline.

Moves and errors are means over the scenarios of tuning's second round; trajectories are of the study that it writes.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from mampc.base.files import written_whole
from mampc.compare.candidates import is_dear
from mampc.compare.fronts import Point, error_ratio
from mampc.compare.scenarios import scenario_length
from mampc.compare.sweep import points_of
from mampc.compare.tuned import Tuned
from mampc.compare.tuned_study import baseline_of, rules_table
from mampc.loop.regulator import Regulator
from mampc.loop.run import Run
from mampc.report.interactive import interactive_page
from mampc.report.page_content import DAY, Means
from mampc.report.tuning import widest
from mampc.study.running import Made, StudyResult, prepare, run_controller
from mampc.study.schema import ControllerTable, Study

PAGE = "report.html"
MOST_PRICES, MOST_DEAR = 8, 4  # on the page, evenly along the front; where loops are stepped one by one


def write_tuning_page(
    tuned: Tuned,
    study: Study,
    folder: Path,
    outcome: str,
    *,
    by_scenario: bool,
    on_run: Callable[[int, int], None] = lambda done, total: None,
) -> None:
    """Write report.html into a folder.

    Args:
        tuned: what was found.
        study: that tuning writes.
        folder: of the page.
        outcome: of tuning, in sentences.
        by_scenario: whether scenarios of the study are the kinds of load that tuning took in turn.
        on_run: called with the number of finished and of all runs.

    Raises:
        MampcError: plotly is missing.
    """
    page = tuning_page(tuned, study, outcome, by_scenario=by_scenario, on_run=on_run)
    with written_whole(folder / PAGE) as unfinished:
        unfinished.write_text(page, encoding="utf-8")


def tuning_page(
    tuned: Tuned,
    study: Study,
    outcome: str,
    *,
    by_scenario: bool,
    on_run: Callable[[int, int], None] = lambda done, total: None,
) -> str:
    """The text of report.html; arguments as in `write_tuning_page`."""
    prepared = prepare(study, model=tuned.problem.model)
    baseline, points = points_of(tuned.rows, "tuning")
    table = baseline_of(tuned).model_copy(update={"name": tuned.expected.beside})
    chosen = f"tuned, price {tuned.rules.price:.3g}"
    shown: dict[str, tuple[ControllerTable, Regulator, Point]] = {
        table.name: (table, tuned.baseline, baseline)
    }
    if not tuned.is_plain:
        for point in _shown(points[tuned.setting], baseline, tuned):
            name = chosen if point.value == tuned.rules.price else f"price {point.value:.3g}"
            rules = rules_table(tuned.rules).model_copy(update={"price": point.value})
            own = ControllerTable(name=name, method="exact", rules=rules)
            shown[name] = own, tuned.at_price(point.value), point
    weight = 1.0 if study.error_weight is not None else float(tuned.problem.output_weight[0, 0])
    days = scenario_length(tuned.problem) * tuned.problem.model.dt / DAY
    means: dict[str, dict[str, tuple[float, float]]] = {}
    runs: dict[str, dict[str, Run]] = {}
    for place, scenario in enumerate(study.scenarios):
        loops = slice(place, None, len(study.scenarios)) if by_scenario else slice(None)
        means[scenario.name], runs[scenario.name] = {}, {}
        for number, (name, (_, regulator, point)) in enumerate(shown.items(), 1):
            means[scenario.name][name] = (
                float(point.moves[loops].mean()) / days, float(point.error[loops].mean()) / weight,
            )  # fmt: skip
            runs[scenario.name][name] = run_controller(study, prepared, scenario, regulator)
            on_run(place * len(shown) + number, len(shown) * len(study.scenarios))
    made = {name: Made.of(regulator) for name, (_, regulator, _) in shown.items()}
    tables = [own.model_copy(update={"name": name}) for name, (own, _, _) in shown.items()]
    all_of_them = study.model_copy(update={"controllers": tables})
    result = StudyResult(all_of_them, prepared.model, None, None, runs, tuned.cautions, made)
    group = dict.fromkeys([name for name in shown if name != table.name], "prices")
    first = dict.fromkeys(means, table.name if tuned.is_plain else chosen)
    kinds = len(study.scenarios)
    of_load = (
        f", {len(baseline.moves) // kinds} under each kind of load," if by_scenario and kinds > 1 else ""
    )
    told = (
        f"Moves and errors are means over {len(baseline.moves)} scenarios of tuning{of_load} on stand-ins for the "
        "plant; trajectories are of single runs of the study."
    )
    return interactive_page(result, Means(study, means, group, first, told, outcome))


def _shown(points: list[Point], baseline: Point, tuned: Tuned) -> list[Point]:
    """Prices of the front whose errors are not far beyond the baseline's, the one chosen among them."""
    prices = [point.price for point in tuned.front]
    own = sorted((point for point in points if point.value in prices), key=lambda point: point.value)
    own = [p for p in own if p.value == tuned.rules.price or error_ratio(p, baseline) <= widest(tuned)]
    most = MOST_DEAR if is_dear(tuned.problem, tuned.rules) else MOST_PRICES
    places = np.linspace(0, len(own) - 1, min(len(own), most)).round().astype(int).tolist()
    return [p for i, p in enumerate(own) if i in places or p.value == tuned.rules.price]
