"""From exports to a model file: which part estimates, which validates, and what to say of the result."""

from __future__ import annotations

import os
import shlex
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mampc.base.checks import Array, as_number
from mampc.base.errors import MampcError, MampcWarning, counted
from mampc.identification import Identified, IOData, Validation, n4sid
from mampc.identification.excitation import left_open, movement_of
from mampc.identification.export.together import read_together
from mampc.report.figures import validation_figure
from mampc.report.output import save_figure
from mampc.systems.evidence import Evidence
from mampc.systems.properties import properties
from mampc.systems.state_space import StateSpace

POOR_FIT = 40.0  # percent; a model below it is hardly one to control with
SHORTEST = 10  # samples on either side of a cut
SHORT = 30  # samples: a piece with fewer has neither past nor future for the usual 15 block rows
SEGMENTS = 8  # without each of which the model is estimated again
LONG = 2.0  # seconds of work of which is told
LONGEST_BAND = 200  # samples of a step response whose uncertainty is kept


@dataclass(frozen=True, eq=False)
class Outcome:
    """What became of exports; the records themselves are let go of.

    Attributes:
        model: with what is known of it.
        order: dead times not counted.
        fit: to the part that the model was estimated on, percent per output.
        held_out: the longest piece of the rest.
        validation: on that piece.
        found: what identification found and decided, in sentences.
        notes: what reading the exports noticed and did.
        warnings: what to look at before the model is used.
        records: numbers of samples to estimate on, one each.
    """

    model: StateSpace
    order: int
    fit: Array
    held_out: IOData
    validation: Validation
    found: tuple[str, ...]
    notes: tuple[str, ...]
    warnings: tuple[str, ...]
    records: tuple[int, ...]


def identify_and_write(
    exports: Sequence[Path],
    target: Path,
    show: Callable[[str], None],
    *,
    reading: dict[str, Any],
    settings: dict[str, Any],
    share: float,
) -> Outcome:
    """Read exports, identify a model, validate it and write it beside its validation figure.

    Args:
        exports: files of one plant.
        target: model file, whose name ends in .json.
        show: is told each stage.
        reading: arguments of `read_export`.
        settings: arguments of `n4sid`.
        share: part of the samples to estimate on.
    """
    show("reading the record")
    records, notes = read_together(exports, **reading)
    require_writable(target)
    outcome = _identified(records, notes, show, settings, share)
    del records  # a long one leaves room for the drawing
    show("writing the model and its figure")
    outcome.model.save(target)
    warnings = list(outcome.warnings)
    if warnings:
        warnings.append(f"plan a better record: mampc plan-test test.csv --model {shlex.quote(str(target))}")
    try:
        save_figure(validation_figure(outcome.held_out, outcome.validation), target.with_suffix(""))
    except MampcError as error:
        warnings.append(f"no figure written; {error}")
    return replace(outcome, warnings=tuple(warnings))


def _identified(
    records: list[IOData],
    notes: list[str],
    show: Callable[[str], None],
    settings: dict[str, Any],
    share: float,
) -> Outcome:
    """The model of some records, and what it leaves open."""
    estimation, rest = hold_out(long_enough(records, notes), share)
    show("identifying a model")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", MampcWarning)  # `left_open` tells it of all records
            identified = n4sid(
                estimation if len(estimation) > 1 else estimation[0], progress=show, **settings
            )
    except MampcError as error:
        told = [
            *movement_of(estimation),
            "`mampc plan-test` says how far, how often and how long to move inputs",
        ]
        raise MampcError("\n  - ".join([str(error), *told])) from None
    validation = identified.validate(rest)
    show("estimating how certain it is")
    evidence = evidence_of(identified, records, lambda words: show(f"estimating how certain it is{words}"))
    model = replace(identified.model, evidence=evidence)
    doubts = []
    if identified.stabilised:
        doubts.append(
            "poles outside the unit circle were mirrored to its inside; check the record for drifts"
        )
    poor = [name for name, fit in zip(rest.names.outputs, validation.fit, strict=True) if not fit > POOR_FIT]
    if poor:
        doubts.append(
            f"the model explains less than {POOR_FIT:g} % of {', '.join(poor)} on the hold-out part; look at the "
            "figure, and try another --order or --detrend, or a richer record"
        )
        if len(estimation) > 1:
            doubts.append(
                f"each of the {len(estimation)} pieces has a constant of its own, so that levels that inputs kept "
                "within a piece say nothing of their gains; make up short gaps (--fill), or a clock's (--time-zone)"
            )
    doubts += left_open(model, records)
    return Outcome(
        model, identified.order, identified.fit, replace(rest, u=rest.u.copy(), y=rest.y.copy()), validation,
        identified.notes, tuple(notes), tuple(doubts), tuple(map(len, estimation)),
    )  # fmt: skip


def long_enough(records: Sequence[IOData], notes: list[str]) -> Sequence[IOData]:
    """The records that say more than where they begin, if they are most of the samples; a note tells of the others."""
    kept = [record for record in records if len(record) >= SHORT]
    samples, left = sum(map(len, records)), sum(map(len, kept))
    if len(kept) == len(records):
        return records
    lost = f"{counted(len(records) - len(kept), 'piece')} of fewer than {SHORT} samples, {samples - left} of {samples}"
    if left < samples / 2:
        notes.append(f"{lost}, say little; --fill closes short gaps")
        return records
    notes.append(f"{lost}, left out of the identification; --fill closes short gaps")
    return kept


def evidence_of(
    identified: Identified, records: Sequence[IOData], show: Callable[[str], None] = lambda words: None
) -> Evidence:
    """The ranges of all records, and how uncertain the step response is until it has settled."""
    inputs, outputs = (
        np.stack(
            [np.min([s.min(axis=0) for s in own], axis=0), np.max([s.max(axis=0) for s in own], axis=0)],
            axis=1,
        )
        for own in ([record.u for record in records], [record.y for record in records])
    )
    samples = int(properties(identified.model).settling_time / identified.model.dt) + 1
    try:
        deviation = identified.uncertainty(
            min(max(samples, SHORTEST), LONGEST_BAND), segments=SEGMENTS, progress=time_left(show, SEGMENTS)
        )
    except MampcError:  # too short a record
        deviation = None
    return Evidence(inputs, outputs, deviation)


def time_left(show: Callable[[str], None], total: int) -> Callable[[int], None]:
    """Tells how long the rest of some equal pieces of work takes, where it takes long."""
    start = time.monotonic()

    def tell(done: int) -> None:
        left = (time.monotonic() - start) / done * (total - done) if done else 0.0
        if left > LONG:
            show(f", about {left:.0f} s left")

    return tell


def hold_out(records: Sequence[IOData], share: float) -> tuple[list[IOData], IOData]:
    """Records to estimate on, about `share` of all samples from the first on, and the longest of the rest.

    Raises:
        MampcError: a share that leaves no samples on one side.
    """
    if len(records) == 1:
        before, after = records[0].split(share)
        return [before], after
    left = round(as_number("share", share, 0.0) * sum(map(len, records)))
    estimation, rest = [], []
    for record in records:
        if left >= len(record) - SHORTEST:
            estimation.append(record)
        elif left < SHORTEST:
            rest.append(record)
        else:
            estimation.append(record[:left])
            rest.append(record[left:])
        left -= min(left, len(record))
    if not estimation or not rest:
        raise MampcError(f"share: expected one that leaves samples on both sides, received {share}")
    return estimation, max(rest, key=len)


def fit_table(outcome: Outcome) -> Any:
    """One row an output."""
    from rich.markup import escape
    from rich.table import Table

    from mampc.report.columns import numbers

    headers = ("fit, estimation part (%)", "fit, hold-out part (%)", "whiteness of residuals (p)")
    table = Table("output", *numbers(*headers))
    outputs, validation = outcome.model.names.outputs, outcome.validation
    rows = zip(outputs, outcome.fit, validation.fit, validation.whiteness, strict=True)
    for name, on_own, on_rest, p in rows:
        table.add_row(escape(name), f"{on_own:.1f}", f"{on_rest:.1f}", f"{p:.3f}")
    return table


def require_writable(target: Path) -> None:
    """Raise `MampcError` unless the target is a new file or a model, in a folder that is there."""
    if target.suffix != ".json":
        raise MampcError(f"--out: expected a name that ends in .json, received {target}")
    if not os.path.isdir(target.parent):
        raise MampcError(f"--out: expected a file in a folder that exists, received {target}")
    if not os.access(target.parent, os.W_OK):
        raise MampcError(f"--out: expected a file in a folder that can be written to, received {target}")
    if os.path.exists(target):
        try:
            StateSpace.load(target)
        except MampcError:
            raise MampcError(
                f"--out: expected a new file or a model to replace, received {target}, which is neither"
            ) from None
