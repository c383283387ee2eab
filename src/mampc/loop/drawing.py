"""How mampc's figures look, and closed loops as signals under each other."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from mampc.base.checks import Array
from mampc.base.errors import MampcError
from mampc.base.names import Names

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Okabe and Ito's palette: told apart by the colour-blind and in print.
BLACK, BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY = (
    "#000000", "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9",
)  # fmt: skip
GREY = "#5c5c5c"
PALE = ("#a6dccb", "#e8c4d8", "#f5d796", "#bfe0f5", "#c9c9c9", "#e5b8a0")  # of controllers in the background
STYLE: Any = {
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e6e6e6",
    "grid.linewidth": 0.6,
    "lines.linewidth": 1.3,
    "legend.frameon": False,
    "legend.fontsize": 8,
    "figure.dpi": 100,
    "savefig.dpi": 200,
    "svg.hashsalt": "mampc",
}
WIDTH = 6.5  # inches: the text width of a one-column paper
_LINE = 46  # characters that fit into the width whatever they are


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
            if output:
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


def time_scale(time: Array) -> tuple[float, str]:
    """Seconds per shown unit of time."""
    end = float(time[-1]) if len(time) else 0.0
    if end > 4 * 24 * 3600:
        return 24 * 3600.0, "days"
    if end > 4 * 3600:
        return 3600.0, "h"
    return (60.0, "min") if end > 600 else (1.0, "s")


def new_figure(
    rows: int = 1, columns: int = 1, *, width: float = WIDTH, height: float = 1.5, **settings: Any
) -> tuple[Figure, Any]:
    """A figure and its axes (rows, columns), outside pyplot: no window, no state, nothing to close.

    Args:
        rows, columns: of panels.
        width: of the figure in inches.
        height: of each row in inches, its title and labels left out.
        settings: of `Figure.subplots`.

    Raises:
        MampcError: matplotlib is missing.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise MampcError("figures need matplotlib: pip install 'mampc[plot]'") from None
    size = (width, 0.5 + rows * (height + 0.3))
    figure = Figure(figsize=size, layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False, **settings)


def legend_above(figure: Figure) -> None:
    """One legend for all panels above them, in as many columns as the width holds; the figure grows by its rows."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    entries: dict[str, Any] = {}
    for panel in figure.axes:
        entries |= {name: handle for handle, name in zip(*panel.get_legend_handles_labels(), strict=True)}
    renderer: Any = FigureCanvasAgg(figure).get_renderer()  # type: ignore[no-untyped-call]
    wide = figure.bbox.width - 10
    for columns in range(len(entries), 0, -1):
        legend = figure.legend(list(entries.values()), list(entries), loc="outside upper left", ncols=columns)
        extent = legend.get_window_extent(renderer)
        if extent.width <= wide or columns == 1:
            break
        legend.remove()
    figure.set_figheight(figure.get_figheight() + extent.height / figure.dpi)


def styled() -> Any:
    """A context in which figures have mampc's style."""
    try:
        import matplotlib
    except ImportError:
        raise MampcError("figures need matplotlib: pip install 'mampc[plot]'") from None
    return matplotlib.rc_context(STYLE)


def plain(text: str, width: int = _LINE) -> str:
    """Text as matplotlib shows it literally, in lines that fit: a dollar sign starts no formula."""
    return textwrap.fill(text, width).replace("$", r"\$")
