"""Labels beside points, none upon another."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from mampc.base.checks import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SIZE = 8  # of the text, in points
_MARKER = 4.5  # points, half the side of the square that a marker takes
_GAP = 1.5  # points between labels
_NEAR = 12.0  # points up to which a label needs no line to its point
_DISTANCES = (6, 10, 14, 20, 28, 38, 50)  # points; a label further away is hardly read as its point's
_SIXTEENTHS = (0, 2, 14, 8, 6, 10, 4, 12, 1, 15, 3, 13, 7, 9, 5, 11)  # directions in order of preference


class Box(NamedTuple):
    """An upright rectangle, in points."""

    left: float
    bottom: float
    right: float
    top: float

    @classmethod
    def around(cls, centre: Array, half: Array) -> Box:
        return cls(*(centre - half), *(centre + half))

    def meets(self, other: Box) -> bool:
        return (
            self.left < other.right + _GAP
            and other.left < self.right + _GAP
            and self.bottom < other.top + _GAP
            and other.bottom < self.top + _GAP
        )

    def within(self, other: Box) -> bool:
        return (
            self.left >= other.left
            and self.right <= other.right
            and self.bottom >= other.bottom
            and self.top <= other.top
        )


def label_points(
    panel: Axes, points: Sequence[tuple[float, float]], texts: Sequence[str], front: Sequence[bool]
) -> bool:
    """Write each text near its point, inside the panel and clear of all other texts, points and lines between them.

    Labels of points in front are placed first, each at the first free place: near before far, to the right
    before elsewhere. The layout of the figure is final afterwards.

    Args:
        panel: its limits are final.
        points: in data units.
        texts: one a point.
        front: which points matter most.

    Returns:
        Whether all texts found a place; if not, nothing is written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    figure: Any = panel.figure
    renderer: Any = FigureCanvasAgg(figure).get_renderer()  # type: ignore[no-untyped-call]
    figure.draw_without_rendering()
    to_points = 72 / figure.dpi
    room = Box(*(to_points * np.asarray(panel.get_window_extent(renderer).extents)))
    places = panel.transData.transform(np.asarray(points)) * to_points
    taken = [Box.around(place, np.full(2, _MARKER)) for place in places]
    found: dict[int, tuple[Array, bool]] = {}
    for i in sorted(range(len(points)), key=lambda i: (not front[i], -places[i][1], i)):
        half = _half_size(panel, texts[i], renderer) * to_points
        own = taken[i]
        others = [box for box in taken if box != own]
        centre = _free_place(places[i], half, places[(places != places[i]).any(axis=1)], others, room)
        if centre is None:
            return False
        line = _line(places[i], centre, half)
        taken += [Box.around(centre, half), *line]
        found[i] = centre - places[i], bool(line)
    figure.set_layout_engine("none")
    for i, (offset, lined) in found.items():
        panel.annotate(
            texts[i],
            points[i],
            xytext=(offset[0], offset[1]),
            textcoords="offset points",
            ha="center",
            va="center",
            multialignment="left",
            fontsize=SIZE,
            zorder=6,
            arrowprops=_LEADER if lined else None,
        )
    return True


_LEADER = {"arrowstyle": "-", "color": "#8a8a8a", "linewidth": 0.6, "shrinkA": 0, "shrinkB": 4}


def _free_place(point: Array, half: Array, others: Array, taken: Sequence[Box], room: Box) -> Array | None:
    """The first free centre of a label of the given half size.

    A label without a line is nearer to its own point than to any of the `others`, shape (k, 2).
    """
    for centre in _centres(point, half):
        box, line = Box.around(centre, half), _line(point, centre, half)
        if not box.within(room) or any(step.meets(other) for step in (box, *line) for other in taken):
            continue
        if not line:
            own = np.linalg.norm(_nearest(point, centre, half) - point)
            away = np.linalg.norm(_nearest(others, centre, half) - others, axis=1)
            if (away < 1.5 * own).any():
                continue
        return centre
    return None


def _nearest(points: Array, centre: Array, half: Array) -> Array:
    """The points of a label nearest to the given ones."""
    return np.clip(points, centre - half, centre + half)


def _centres(point: Array, half: Array) -> Iterator[Array]:
    for distance in _DISTANCES:
        for sixteenth in _SIXTEENTHS:
            way = np.array([np.cos(np.pi / 8 * sixteenth), np.sin(np.pi / 8 * sixteenth)])
            side = np.clip(1.5 * way, -1, 1)  # the part of the label that faces its point
            yield point + distance * way + side * half


def _line(point: Array, centre: Array, half: Array) -> list[Box]:
    """The line from a point to its label as a row of small boxes; none where the label is near."""
    end = _nearest(point, centre, half)
    length = float(np.linalg.norm(end - point))
    if length <= _NEAR:
        return []
    shares = np.arange(2 * _MARKER, length - _GAP, 4.0) / length
    return [Box.around(point + share * (end - point), np.zeros(2)) for share in shares]


def _half_size(panel: Axes, text: str, renderer: Any) -> Array:
    """Half of width and height of a text, in pixels."""
    measured = panel.text(0, 0, text, fontsize=SIZE)
    extent = measured.get_window_extent(renderer)
    measured.remove()
    return np.array([extent.width, extent.height]) / 2
