"""How mampc's figures look, and the figure of one closed loop."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from mampc.arrays import Array
from mampc.errors import MampcError
from mampc.names import Names

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Okabe and Ito's palette: told apart by the colour-blind and in print.
COLOURS = ("#7f7f7f", "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000")
STYLE = {
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
    plt = pyplot()
    rows = len(names.outputs) + len(names.inputs)
    with plt.rc_context(STYLE):
        figure: Figure
        figure, axes = plt.subplots(rows, 1, figsize=(6.5, 1.5 * rows), sharex=True, squeeze=False)
        scale, unit = time_scale(t)
        panels = iter(axes[:, 0])
        for i, (name, panel) in enumerate(zip(names.outputs, panels, strict=False)):
            panel.step(t / scale, r[:, i], where="post", color="black", linestyle="--", label="reference")
            panel.plot(t / scale, y[:, i], color=COLOURS[1], label=name)
            panel.set_ylabel(name)
        for i, (name, panel) in enumerate(zip(names.inputs, axes[len(names.outputs) :, 0], strict=True)):
            panel.step(t / scale, u[:, i], where="post", color=COLOURS[2])
            panel.set_ylabel(name)
        axes[0, 0].legend(loc="best")
        axes[-1, 0].set_xlabel(f"time ({unit})")
        figure.tight_layout()
    return figure


def time_scale(time: Array) -> tuple[float, str]:
    """Seconds per shown unit of time."""
    end = float(time[-1]) if len(time) else 0.0
    if end > 4 * 3600:
        return 3600.0, "h"
    return (60.0, "min") if end > 600 else (1.0, "s")


def pyplot() -> Any:
    """matplotlib without a window, or an error that says how to get it."""
    try:
        import matplotlib
    except ImportError:
        raise MampcError("figures need matplotlib: pip install 'mampc[plot]'") from None
    if matplotlib.get_backend().lower() != "agg":
        matplotlib.use("agg", force=False)
    import matplotlib.pyplot

    return matplotlib.pyplot
