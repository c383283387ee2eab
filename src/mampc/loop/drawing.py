"""Closed loops as signals under each other, and how their lines look."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from mampc.base.checks import Array
from mampc.base.drawing import (
    BLACK,
    BLUE,
    GREY,
    PALE,
    VERMILION,
    legend_above,
    new_figure,
    plain,
    styled,
    time_scale,
)
from mampc.base.names import Names
from mampc.program.zone import Zone

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Look:
    """How the lines of one controller are drawn; later `order` is further in front."""

    colour: str
    width: float = 1.3
    dashes: str = "-"
    order: float = 3.0


class Trajectory(Protocol):
    """What figures read of a `Run`."""

    @property
    def t(self) -> Array: ...
    @property
    def u(self) -> Array: ...
    @property
    def y(self) -> Array: ...
    @property
    def r(self) -> Array: ...
    @property
    def zone(self) -> Zone | None: ...
    @property
    def names(self) -> Names: ...


def looks(names: Sequence[str], emphasised: Sequence[str]) -> dict[str, Look]:
    """The look of every controller, those first that stand out: at most three, the first as what is compared with.

    Args:
        names: all controllers.
        emphasised: those that stand out, the reference of the comparison first, the others by merit.
    """
    strong = (Look(GREY, order=3.5), Look(BLUE, order=5.0), Look(VERMILION, order=4.5))
    chosen = dict(zip(emphasised, strong, strict=False))
    behind = [name for name in names if name not in chosen]
    for i, name in enumerate(behind):
        chosen[name] = Look(PALE[i % len(PALE)], 1.0, ("-", "--", ":")[i // len(PALE) % 3], 2.5)
    return chosen


def signals_figure(
    runs: Mapping[str, Trajectory],
    signals: Sequence[str] | None = None,
    *,
    look: Mapping[str, Look] | None = None,
    limits: Any = None,
    height: float = 1.2,
) -> Figure:
    """Signals of closed loops in panels under each other: outputs with references, inputs as staircases.

    Args:
        runs: controller -> run; all of the same plant and reference.
        signals: names of inputs and outputs, in the order of the panels; default all outputs, then all inputs.
        look: controller -> how it is drawn; default by their order.
        limits: what has fields u_min, u_max, y_min and y_max; a limit near the data is drawn as a line, others
            are told in words.
        height: of a panel in inches.

    Raises:
        MampcError: matplotlib is missing.
    """
    first = next(iter(runs.values()))
    names = first.names
    shown = (*names.outputs, *names.inputs) if signals is None else tuple(signals)
    look = looks(list(runs), list(runs)[:3]) if look is None else look
    with styled():
        figure, axes = new_figure(len(shown), height=height, sharex=True)
        scale, unit = time_scale(first.t)
        for name, panel in zip(shown, axes[:, 0], strict=True):
            output = name in names.outputs
            i = (names.outputs if output else names.inputs).index(name)
            for controller, style in look.items():
                run = runs[controller]
                panel.plot(
                    run.t / scale,
                    (run.y if output else run.u)[:, i],
                    drawstyle="default" if output else "steps-post",
                    color=style.colour,
                    linewidth=style.width,
                    linestyle=style.dashes,
                    zorder=style.order,
                    label=plain(controller),
                )
            if output and first.zone is not None and (first.zone.high > first.zone.low)[:, i].any():
                panel.fill_between(
                    first.t / scale, *_within(panel, first.zone.low[:, i], first.zone.high[:, i]), step="post",
                    facecolor=(GREY, 0.2), edgecolor=(GREY, 0.5), linewidth=0.7, zorder=1.0, label="zone",
                )  # fmt: skip
            elif output:
                panel.step(
                    first.t / scale, first.r[:, i], where="post", color=BLACK, linestyle=(0, (4, 2)),
                    linewidth=0.9, zorder=4.2, label="reference",
                )  # fmt: skip
            near, told = near_limits(limits, output, i, *panel.get_ylim())
            for limit in near:
                panel.axhline(
                    limit, color=BLACK, linewidth=0.9, linestyle=(0, (1, 1.5)), label="limit", zorder=4.1
                )
            panel.set_title(plain(names.with_unit(name) + told))
        axes[-1, 0].set_xlabel(f"time ({unit})")
        axes[-1, 0].set_xlim(0, float(first.t[-1]) / scale or None)
        legend_above(figure)
    return figure


def _within(panel: Any, low: Array, high: Array) -> tuple[Array, Array]:
    """Ends of a zone, cut to what a panel shows and a little more, so that far ones do not flatten the data."""
    bottom, top = panel.get_ylim()
    far = 0.3 * (top - bottom)
    panel.set_ylim(bottom, top) if (low < bottom - far).any() or (high > top + far).any() else None
    return np.maximum(low, bottom - far), np.minimum(high, top + far)


def near_limits(limits: Any, output: bool, i: int, low: float, high: float) -> tuple[list[float], str]:
    """The limits of a signal that lie near its range low..high, and what is to be said of the others.

    Args:
        limits: what has fields u_min, u_max, y_min and y_max, or None.
        output: whether the signal is an output.
        i: which output or input.
        low, high: the range of the data shown.
    """
    near, far = [], {}
    for side in ("min", "max"):
        given = getattr(limits, f"{'y' if output else 'u'}_{side}", None)
        values = np.ravel(np.inf if given is None else given)
        limit = float(values[i] if len(values) > 1 else values[0])
        if not np.isfinite(limit):
            continue
        if abs(limit - (low + high) / 2) <= high - low:
            near.append(limit)
        else:
            far[side] = f"{limit:g}"
    if len(far) == 2:
        return near, f", limits {far['min']} to {far['max']}"
    return near, "".join(
        f", {'at least' if side == 'min' else 'at most'} {limit}" for side, limit in far.items()
    )
