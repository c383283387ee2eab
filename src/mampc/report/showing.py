"""A model in words and tables."""

from __future__ import annotations

from typing import Any

import numpy as np

from mampc.base.errors import listed
from mampc.systems.properties import doubtful_gains, gain_deviation, properties, time_in_words
from mampc.systems.state_space import StateSpace

INTERACTING = 10.0  # condition number, or relative gain, from which one is told


def model_tables(model: StateSpace) -> list[Any]:
    """Channels with gain, time constant and dead time; the relative gains of a model with several inputs."""
    from rich.markup import escape
    from rich.table import Table

    from mampc.report.columns import numbers

    found = properties(model)
    inputs, outputs = (*model.names.inputs, *model.names.disturbances), model.names.outputs
    deviation = gain_deviation(model, found)
    units = dict(model.names.units)
    gains = numbers("gain", *(["± (standard deviation)"] if deviation is not None else []))
    times = numbers("time constant", "dead time")
    channels = Table("output", "input", *gains, "unit", *times, title="channels")
    for i, j in np.ndindex(found.gain.shape):
        if found.gain[i, j] == 0:
            continue
        integrates = bool(found.integrating[i, j])
        unit = _unit(units.get(outputs[i]), units.get(inputs[j]), integrates)
        constant, dead = float(found.time_constant[i, j]), float(found.dead_time[i, j])
        channels.add_row(
            escape(outputs[i]),
            escape(inputs[j]),
            f"{found.gain[i, j]:.4g}",
            *([f"{deviation[i, j]:.2g}"] if deviation is not None else []),
            escape(unit),
            "integrates" if integrates else time_in_words(constant) if np.isfinite(constant) else "grows",
            time_in_words(dead) if dead > 0 else "none",
        )
    if found.relative_gain is None or max(found.relative_gain.shape) < 2:
        return [channels]
    relative = Table("output", *numbers(*map(escape, model.names.inputs)), title="relative gains")
    for name, row in zip(outputs, found.relative_gain, strict=True):
        relative.add_row(escape(name), *(f"{round(value, 2) + 0.0:.2f}" for value in row))
    return [channels, relative]


def model_words(model: StateSpace) -> list[str]:
    """Everything that is no property of one channel, a sentence each."""
    found = properties(model)
    settles = "" if found.unstable else f"; settles within {time_in_words(found.settling_time)}"
    sentences = [f"sampled every {time_in_words(model.dt)}{settles}"]
    if found.integrators:
        sentences.append(f"poles that integrate, at exactly one: {found.integrators}")
    if found.unstable:
        sentences.append(f"unstable: {found.unstable} of its poles are outside the unit circle")
    if found.condition is not None and found.condition > 1:
        hard = found.condition > INTERACTING
        sentences.append(
            f"condition number of the gains {found.condition:.3g}, all signals taken alike"
            + ("; some combination of outputs takes large moves of all inputs" if hard else "")
        )
    if found.limiting_zeros is not None and len(found.limiting_zeros):
        times = ", ".join(time_in_words(value) for value in found.limiting_zeros[:5])
        sentences.append(
            f"zeros in the right half plane with time constants {times}: no control is faster than about that"
        )
    if model.noise is not None:
        sentences.append(f"noise of the outputs: {_named(model.names.outputs, model.noise.output)}")
        if model.noise.drift.any():
            sentences.append(
                f"wandering of the outputs: {_named(model.names.outputs, model.noise.drift)} a sample"
            )
    doubtful = doubtful_gains(model, found)
    if doubtful:
        sentences.append(f"the sign of the gain is uncertain: {', '.join(doubtful)}; move these inputs more")
    return sentences


def _unit(output: str | None, of_input: str | None, integrates: bool) -> str:
    if not output and not of_input:
        return "1/s" if integrates else ""
    below = of_input or "1"
    below = f"({below})" if set("/*· ") & set(below) else below  # t/h
    return f"{output or '1'}/{below}" + ("/s" if integrates else "")


def _named(names: tuple[str, ...], values: Any) -> str:
    return listed([f"{name} {value:.3g}" for name, value in zip(names, values, strict=True)])
