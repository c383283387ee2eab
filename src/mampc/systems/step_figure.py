"""A model as its step responses: one panel for each output and input, with a band where they are uncertain."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from mampc.base.checks import as_array
from mampc.base.drawing import BLUE, SKY, new_figure, plain, styled, time_scale
from mampc.base.errors import MampcError
from mampc.systems.properties import properties
from mampc.systems.state_space import StateSpace

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MOST_PANELS = 100
LONGEST = 2000  # samples shown
BAND = 2.0  # standard deviations to either side


def step_figure(model: StateSpace, deviation: Any = None) -> Figure:
    """Responses to a unit step of each input; see `StateSpace.plot`."""
    outputs = model.names.outputs
    inputs = (*model.names.inputs, *model.names.disturbances)
    l, columns = len(outputs), len(inputs)
    if l * columns > MOST_PANELS:
        raise MampcError(
            f"plot: expected at most {MOST_PANELS} outputs times inputs, received {l} x {columns}"
        )
    if deviation is None and model.evidence is not None:
        deviation = model.evidence.deviation
    if deviation is None:
        samples = int(1.3 * properties(model).settling_time / model.dt) + 10
    else:
        deviation = as_array("deviation", deviation)
        if deviation.ndim != 3 or deviation.shape[1:] != (l, columns) or not len(deviation):
            raise MampcError(
                f"deviation: expected shape (samples, {l}, {columns}), received {deviation.shape}"
            )
        samples = len(deviation)
    response = model.step_response(min(samples, LONGEST))
    time = model.dt * np.arange(len(response))
    scale, unit = time_scale(time)
    with styled():
        figure, axes = new_figure(
            l, columns, width=max(3.0, min(2.2 * columns, 14.0)), height=1.1, sharex=True
        )
        for i, j in np.ndindex(l, columns):
            panel = axes[i, j]
            course = response[:, i, j]
            panel.plot(time / scale, course, color=BLUE)
            if deviation is not None:
                around = BAND * deviation[: len(course), i, j]
                panel.fill_between(
                    time / scale, course - around, course + around, color=SKY, alpha=0.4, linewidth=0
                )
            if i == 0:
                panel.set_title(plain(f"step of {model.names.with_unit(inputs[j])}", 24))
            if j == 0:
                panel.set_ylabel(plain(model.names.with_unit(outputs[i]), 16))
            if i == l - 1:
                panel.set_xlabel(f"time ({unit})")
                panel.set_xlim(0, float(time[-1]) / scale or None)
    return figure
