"""The comparison table on the terminal: every controller beside the baseline and published figures."""

from __future__ import annotations

from typing import Any

import numpy as np
from rich.markup import escape
from rich.table import Column, Table

from mampc.report.columns import numbers
from mampc.study.schema import ControllerTable, PublishedTable, Study

OUTSIDE = (("time_outside", ".0%"), ("mean_distance_outside", ".3g"))  # of zones: key and how it is shown


def comparison_tables(study: Study, summary: dict[str, Any]) -> list[Table]:
    """Tables of each scenario: all samples, without the first `skip`, and what the actuators bear if it has some."""
    tables = []
    for scenario in summary["scenarios"]:
        tables.append(_table(study, scenario, None))
        if study.skip:
            tables.append(_table(study, scenario, "without_transient"))
        if study.actuators is not None:
            tables.append(_wear_table(study, scenario))
    return tables


def has_zones(study: Study) -> bool:
    """Whether errors are counted from zones, for some outputs or some of the time."""
    widths = (study.problem.zone_below, study.problem.zone_above)
    return bool(study.reference.zones) or any(np.any(width) for width in widths)


def error_label(zones: bool, output_weight: Any) -> str:
    """What errors are, with a weight where outputs weigh differently."""
    if output_weight is not None:
        return "weighted distance² outside, mean" if zones else "weighted tracking error, mean |y − r|²"
    return "distance² outside, mean" if zones else "tracking error, mean |y − r|²"


def _outside(entry: dict[str, Any], key: str, form: str) -> str:
    """One value an output, a dash for set points."""
    return " ".join("-" if value is None else f"{value:{form}}" for value in entry[f"{key}_per_output"])


def baseline(study: Study) -> ControllerTable:
    """The controller that ratios refer to: the first plain MPC, or the first of all."""
    return next((table for table in study.controllers if table.method == "mpc"), study.controllers[0])


def _table(study: Study, scenario: dict[str, Any], part: str | None) -> Table:
    base, zones = baseline(study), has_zones(study)
    samples = f"all {study.steps} samples" if part is None else f"without the first {study.skip} samples"
    published = any(_published(controller, part) for controller in study.controllers)
    headers = [
        f"changes\n> {study.threshold:g}",
        "changes\nat all",
        "distance²\noutside" if zones else "tracking\nerror",
        *(("time\noutside", "mean distance\noutside") if zones else ()),
        f"changes, error\n/ {escape(base.name)}",
    ]
    headers += (
        ["published\nchanges", "published\nerror", f"published\n/ {escape(base.name)}"] if published else []
    )
    caption = {"caption": _caption(study, scenario), "caption_justify": "left"}
    table = _titled(study, scenario, samples, [*headers, "step\nµs"], **caption)
    entries = {entry["name"]: entry if part is None else entry[part] for entry in scenario["controllers"]}
    times = {entry["name"]: entry["solve_time_us"]["median"] for entry in scenario["controllers"]}
    largest = max(found["tracking_error"] for found in entries.values())
    error_form = ".3f" if 0.1 <= largest < 1e5 else ".3g"  # errors of any unit have digits to compare
    for controller in study.controllers:
        entry, reference = entries[controller.name], entries[base.name]
        density = entry["sparse_density"]
        row = [
            escape(controller.name),
            _several(density["per_input"]),
            _several(density["exact_per_input"]),
            f"{entry['tracking_error']:{error_form}}",
            *(_outside(entry, key, form) for key, form in OUTSIDE if zones),
            _ratios(
                density["per_input"], reference["sparse_density"]["per_input"],
                entry["weighted_error"], reference["weighted_error"],
            ),
        ]  # fmt: skip
        if published:
            row += _published_cells(_published(controller, part), _published(base, part))
        table.add_row(*row, f"{times[controller.name]:.0f}")
    return table


def _titled(study: Study, scenario: dict[str, Any], what: str, headers: list[str], **caption: Any) -> Table:
    """A table without rows, of controllers and numbers."""
    title = escape(f"{study.name}, {scenario['name']} — {what}")
    columns = Column("controller", no_wrap=True), *numbers(*headers, no_wrap=True)
    return Table(*columns, title=title, title_justify="left", title_style="bold", **caption)


def _caption(study: Study, scenario: dict[str, Any]) -> str | None:
    """What the ratios of errors weigh, where outputs weigh differently, and who estimates how."""
    weighed = (
        None if study.error_weight is None else "Errors are compared with the output_weight of the problem."
    )
    return " ".join(filter(None, (weighed, _estimators(scenario)))) or None


def _estimators(scenario: dict[str, Any]) -> str | None:
    """Who estimates with a load bank, and counts on later data; None where all have a Kalman filter."""
    banks = [entry["name"] for entry in scenario["controllers"] if entry["estimator"] == "load_bank"]
    if not banks:
        return None
    counting = [entry["name"] for entry in scenario["controllers"] if entry["counts_on_later_data"]]
    later = f" Plans count on later data: {', '.join(counting)}." if counting else ""
    if len(banks) == len(scenario["controllers"]):
        return escape(f"All have a load bank.{later}")
    return escape(f"With a load bank: {', '.join(banks)}; the others have a Kalman filter.{later}")


def _wear_table(study: Study, scenario: dict[str, Any]) -> Table:
    """What the actuators bear, one value per input: of all samples."""
    headers = ["travel", "reversals", "starts", "starts\nper hour", "of what\nis rated", "life\nyears"]
    table = _titled(study, scenario, "wear of the actuators", headers)
    for entry in scenario["controllers"]:
        share, life = entry["share_of_rated_starts_per_input"], entry["life_years_per_input"]
        table.add_row(
            escape(entry["name"]),
            " ".join(f"{travel:.4g}" for travel in entry["travel_per_input"]),
            " ".join(map(str, entry["reversals_per_input"])),
            " ".join(map(str, entry["starts_per_input"])),
            " ".join(f"{rate:.3g}" for rate in entry["starts_per_hour_per_input"]),
            "-" if share is None else " ".join(f"{part:.0%}" for part in share),
            "-" if life is None else " ".join("∞" if years is None else f"{years:.3g}" for years in life),
        )
    return table


def _published(controller: ControllerTable, part: str | None) -> PublishedTable | None:
    figures = controller.published
    return figures if figures is None or part is None else figures.without_transient


def _published_cells(figures: PublishedTable | None, base: PublishedTable | None) -> list[str]:
    if figures is None:
        return ["", "", ""]
    cells = [_several(figures.sparse_density), f"{figures.tracking_error:.3f}"]
    if base is None:
        return [*cells, ""]
    ratios = _ratios(figures.sparse_density, base.sparse_density, figures.tracking_error, base.tracking_error)
    return [*cells, ratios]


def _several(values: list[float]) -> str:
    return " ".join(f"{value:.3f}" for value in values)


def _ratios(density: list[float], base_density: list[float], error: float, base_error: float) -> str:
    return f"{_ratio(sum(density), sum(base_density))}, {_ratio(error, base_error)}"


def _ratio(value: float, base: float) -> str:
    return f"{value / base:.2f}" if base > 0 else "-"
