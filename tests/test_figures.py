"""Figures: all text is inside the picture and legible, whatever the number and the length of names."""

import numpy as np
import pytest

import mampc
from mampc.base.drawing import outline
from mampc.compare.sensitivity import SETTINGS, Point
from mampc.loop.drawing import signals_figure
from mampc.report.figures import (
    file_words,
    moves_against_error,
    result_looks,
    sensitivity_figure,
    study_figures,
    validation_figure,
)
from mampc.study import parse_study, run_study, template
from seeds import deep

LONG = "cascaded temperature controller of the second column with a rather long name"


def run(seed, names=None, steps=60, error=0.3):
    """A made-up run of two inputs and one output."""
    rng = np.random.default_rng(seed)
    u = 50 + np.cumsum(rng.normal(size=(steps, 2)) * (rng.random((steps, 2)) < rng.uniform(0.05, 1)), axis=0)
    r = np.where(np.arange(steps) < 20, 1.0, 3.0)[:, None]
    y = r + rng.normal(scale=error, size=(steps, 1))
    return mampc.Run(
        t=30.0 * np.arange(steps), u=u, y=y, y_measured=y, r=r, u_initial=u[0], decisions=(), dt=30.0,
        names=names or mampc.Names(("feed valve", "pump"), ("level",), units={"pump": "%"}),
        v=np.empty((steps, 0)), faults={},
    )  # fmt: skip


def named_runs(count, name="MPC"):
    return {f"{name} {i}": run(i) for i in range(count)}


def texts(figure):
    """Every text that a drawn figure shows, with its box in pixels."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.text import Text

    renderer = FigureCanvasAgg(figure).get_renderer()
    figure.draw(renderer)
    found = [text for legend in figure.legends for text in legend.get_texts()]
    for panel in (panel for panel in figure.axes if panel.get_visible()):
        found += [*panel.texts, panel.xaxis.label, panel.yaxis.label]
        found += [panel.title, panel._left_title, panel._right_title]
        for axis, (low, high) in ((panel.xaxis, panel.get_xlim()), (panel.yaxis, panel.get_ylim())):
            shown = [tick for tick in axis.get_major_ticks() if low <= tick.get_loc() <= high]
            found += [tick.label1 for tick in shown if tick.label1.get_visible()]
    # An annotation's own box would hold its line too.
    return [(text, Text.get_window_extent(text, renderer)) for text in found if text.get_text().strip()]


def assert_legible(figure):
    """All text is inside the canvas, no two texts share a place, and the panels keep the width and their height."""
    boxes = texts(figure)
    for text, box in boxes:
        room = figure.bbox.padded(1)
        assert room.contains(box.x0, box.y0), text.get_text()
        assert room.contains(box.x1, box.y1), text.get_text()
    for i, (text, box) in enumerate(boxes):
        for other, second in boxes[:i]:
            # Of boxes with the blank above and below letters, a pixel and a half may be shared.
            apart = box.padded(-1.5).overlaps(second.padded(-1.5))
            assert not apart, (text.get_text(), other.get_text())
    panels = [panel.get_window_extent() for panel in figure.axes if panel.get_visible()]
    assert max(p.x1 for p in panels) - min(p.x0 for p in panels) > 0.85 * figure.bbox.width
    assert min(p.height for p in panels) > 0.8 * figure.dpi
    for legend in figure.legends:
        box = legend.get_window_extent()
        assert not any(box.padded(-2).overlaps(panel) for panel in panels)


COUNTS = [n if n in (1, 12) else pytest.param(n, marks=pytest.mark.slow) for n in range(1, 13)]


@pytest.mark.parametrize("name", ["W" * 80, *deep("MPC", LONG)])
@pytest.mark.parametrize("count", COUNTS)
def test_all_names_are_inside_the_picture_and_apart(count, name):
    runs = named_runs(count, name)
    limits = mampc.Limits(u_min=0.0, u_max=[60.0, 1e6], y_max=3.5)
    assert_legible(signals_figure(runs, limits=limits))
    assert_legible(signals_figure(runs, ["pump"], limits=limits))


@pytest.mark.parametrize("name", ["MPC", LONG])
@pytest.mark.parametrize("count", COUNTS)
def test_labels_of_moves_against_error_are_inside_and_apart(count, name):
    assert_legible(moves_against_error(named_runs(count, name), 0.1))


@pytest.mark.parametrize("name", ["MPC", LONG])
def test_labels_of_equal_points_are_apart(name):
    same = run(3)
    assert_legible(moves_against_error({f"{name} {i}": same for i in range(8)}, 0.1))


def test_inputs_that_never_move_and_a_perfect_plant_can_be_drawn():
    still = run(0, error=0.0)
    object.__setattr__(still, "u", np.full_like(still.u, 50.0))
    object.__setattr__(still, "u_initial", still.u[0])
    assert_legible(moves_against_error({"MPC": still, "other": still}, 0.1))
    assert_legible(signals_figure({"MPC": still}))


def test_long_names_of_signals_are_inside_the_picture():
    names = mampc.Names((LONG, "$1$ {pump}"), (LONG + " 2",), units={LONG: "kg/h"})
    assert_legible(signals_figure({"MPC": run(1, names)}))


def test_signals_whose_names_differ_in_marks_alone_have_files_of_their_own():
    words = file_words(["TI-1", "TI 1", "ti.1", "TI-1-2", "overview", "level"])
    assert len(set(words)) == 6
    assert words[0] == "ti-1"
    assert words[-1] == "level"
    assert "overview" not in words


def test_a_run_draws_itself_with_all_its_signals():
    drawn = run(2)
    figure = drawn.plot(limits=mampc.Limits(y_max=drawn.y.max() + 0.1))
    assert [panel._left_title.get_text() for panel in figure.axes] == ["level", "feed valve", "pump (%)"]
    assert {text.get_text() for text in figure.legends[0].get_texts()} == {
        "closed loop",
        "reference",
        "limit",
    }
    assert_legible(figure)


def test_limits_near_the_data_are_lines_and_others_are_told():
    figure = signals_figure({"MPC": run(2)}, ["pump"], limits=mampc.Limits(u_min=-1e3, u_max=1e3))
    assert figure.axes[0]._left_title.get_text() == "pump (%), limits -1000 to 1000"
    assert len(figure.axes[0].lines) == 1
    figure = signals_figure({"MPC": run(2)}, ["level"], limits=mampc.Limits(y_max=4.0))
    assert [line.get_label() for line in figure.axes[0].lines] == ["MPC", "reference", "limit"]


@pytest.mark.parametrize("count", [1, 2, 6, 12])
def test_at_most_three_controllers_stand_out(count):
    lines = signals_figure(named_runs(count), ["pump"]).axes[0].lines
    assert sum(line.get_linewidth() > 1 for line in lines) == min(count, 3)
    assert len({(line.get_color(), line.get_linestyle()) for line in lines}) == count


def test_the_figures_of_a_study_are_legible_and_say_what_they_show():
    text = template().replace("steps = 145", "steps = 40").replace("prbs_order = 8", "prbs_order = 7")
    text = text.replace("at = 100", "at = 30")
    result = run_study(parse_study(text))
    drawings = list(study_figures(result))
    names = [drawing.name for drawing in drawings]
    assert names[:3] == ["prbs-inputs", "prbs-outputs", "noise-free_overview"]
    assert len(set(names)) == len(names) == 14
    for drawing in drawings:
        if not drawing.name.startswith("noise-free"):
            assert_legible(drawing.figure)
        assert drawing.caption.endswith(".")
        assert "_" not in drawing.caption
    assert next(d.caption for d in drawings if d.name == "noisy_u1").startswith(
        "Input u1 (%), scenario noisy"
    )
    assert next(iter(result_looks(result))) == "MPC"


def test_validation_and_sensitivity_figures_are_legible():
    plant = mampc.plants.QuadrupleTank()
    signal = mampc.prbs(order=6, amplitude=10.0, hold=5, mean=plant.u_op)
    data = mampc.excite(plant, signal, dt=10.0, noise=0.1, seed=1)
    own, rest = data.split()
    assert_legible(validation_figure(rest, mampc.n4sid(own, order=4).validate(rest)))
    points = [
        Point(setting, value, ratio, 1.5 - ratio)
        for setting in SETTINGS
        for value, ratio in ((1.0, 0.5), (10.0, 0.7), (100.0, 0.9))
    ]
    assert_legible(sensitivity_figure(points, SETTINGS))
    assert_legible(sensitivity_figure(points[:3], SETTINGS))


def test_units_are_shown_and_kept_in_model_files(tmp_path):
    names = mampc.Names(("u1",), ("y1",), units={"u1": "kg/h"})
    model = mampc.StateSpace([[0.5]], [[1.0]], [[1.0]], None, 1.0, names=names)
    model.save(tmp_path / "model.json")
    kept = mampc.StateSpace.load(tmp_path / "model.json").names
    assert (kept.with_unit("u1"), kept.with_unit("y1")) == ("u1 (kg/h)", "y1")


@pytest.mark.parametrize("units", [{"u9": "%"}, {"u1": 3}, 7, "m", ("u1", "%")])
def test_units_of_no_signal_are_refused(units):
    with pytest.raises(mampc.MampcError, match=r"names.units: expected.*received"):
        mampc.Names(("u1",), ("y1",), units=units)


def test_long_lines_are_drawn_by_their_largest_and_least_values():
    rng = np.random.default_rng(0)
    time, values = np.arange(50_001.0), rng.standard_normal(50_001)
    values[12_345], values[-1] = 9.0, -9.0
    x, y = outline(time, values)
    assert len(x) <= 8000
    assert (np.diff(x) > 0).all()
    assert (y == values[x.astype(int)]).all()
    assert {12_345.0, 50_000.0} <= set(x)
    np.testing.assert_array_equal(outline(time[:100], values[:100])[1], values[:100])
