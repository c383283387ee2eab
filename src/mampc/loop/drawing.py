"""How mampc's figures look, and the figure of one closed loop."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from mampc.base.checks import Array
from mampc.base.errors import MampcError
from mampc.base.names import Names

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Okabe and Ito's palette: told apart by the colour-blind and in print.
COLOURS = ("#7f7f7f", "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000")
STYLE: Any = {
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#e6e6e6",
    "grid.linewidth": 0.6,
    "lines.linewidth": 1.3,
    "legend.frameon": False,
    "legend.fontsize": 8,
    "figure.dpi": 100,
    "savefig.dpi": 200,
    "svg.hashsalt": "mampc",
}
WIDE = (6.5, 2.6)  # inches: the text width of a one-column paper


def closed_loop_figure(t: Array, u: Array, y: Array, r: Array, names: Names) -> Figure:
    """All inputs (staircases) and outputs (with references) of a closed loop, in stacked panels."""
    rows = len(names.outputs) + len(names.inputs)
    with styled():
        figure, axes = new_figure(rows, 1, figsize=(6.5, 1.5 * rows), sharex=True)
        scale, unit = time_scale(t)
        panels = iter(axes[:, 0])
        for i, (name, panel) in enumerate(zip(names.outputs, panels, strict=False)):
            panel.step(t / scale, r[:, i], where="post", color="black", linestyle="--", label="reference")
            panel.plot(t / scale, y[:, i], color=COLOURS[1], label=label(name))
            panel.set_ylabel(label(name))
        for i, (name, panel) in enumerate(zip(names.inputs, axes[len(names.outputs) :, 0], strict=True)):
            panel.step(t / scale, u[:, i], where="post", color=COLOURS[2])
            panel.set_ylabel(label(name))
        axes[0, 0].legend(loc="best")
        axes[-1, 0].set_xlabel(f"time ({unit})")
    return figure


def time_scale(time: Array) -> tuple[float, str]:
    """Seconds per shown unit of time."""
    end = float(time[-1]) if len(time) else 0.0
    if end > 4 * 3600:
        return 3600.0, "h"
    return (60.0, "min") if end > 600 else (1.0, "s")


def new_figure(rows: int = 1, columns: int = 1, **settings: Any) -> tuple[Figure, Any]:
    """A figure and its axes (rows, columns), outside pyplot: no window, no state, nothing to close.

    Raises:
        MampcError: matplotlib is missing.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise MampcError("figures need matplotlib: pip install 'mampc[plot]'") from None
    figure = Figure(figsize=settings.pop("figsize"), layout="tight")
    return figure, figure.subplots(rows, columns, squeeze=False, **settings)


def styled() -> Any:
    """A context in which figures have mampc's style."""
    try:
        import matplotlib
    except ImportError:
        raise MampcError("figures need matplotlib: pip install 'mampc[plot]'") from None
    return matplotlib.rc_context(STYLE)


def label(name: str) -> str:
    """A name as matplotlib shows it literally: a dollar sign starts no formula."""
    return name.replace("$", r"\$")
