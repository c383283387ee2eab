"""How mampc's figures look: colours, sizes, one legend above all panels, text taken literally."""

from __future__ import annotations

import textwrap
from typing import TYPE_CHECKING, Any

import numpy as np

from mampc.base.checks import Array
from mampc.base.errors import MampcError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Okabe and Ito's palette: told apart by the colour-blind and in print.
BLACK, BLUE, VERMILION, GREEN, ORANGE, SKY = (
    "#000000", "#0072b2", "#d55e00", "#009e73", "#e69f00", "#56b4e9",
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


def outline(time: Array, values: Array, most: int = 8000) -> tuple[Array, Array]:
    """A line of at most about so many points: where there are more, the least and the largest of each stretch."""
    if len(values) <= most:
        return time, values
    size = -(-2 * len(values) // most)
    starts = np.arange(0, len(values), size)
    ends = np.append(starts[1:], len(values))
    kept = np.unique(
        [
            start + place(values[start:end])
            for start, end in zip(starts, ends, strict=True)
            for place in (np.argmin, np.argmax)
        ]
    )
    return time[kept], values[kept]
