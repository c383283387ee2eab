"""report.html of a front: settings of every method, means over seeds, and the runs behind them."""

import json
import re

import numpy as np
import pytest

from mampc.compare.fronts import Point, error_ratio
from mampc.compare.sweep import Sweep, points_of, run_sweep
from mampc.study import parse_study
from studies import MPC_AND_PRICE, short_study

pytest.importorskip("plotly", reason="needs plotly, which mampc[report] brings")
front_page = pytest.importorskip("mampc.report.front_page")

CONTROLLERS = (
    MPC_AND_PRICE
    + """
[[controllers]]
name = "bands <b>"
method = "dead_band"
settings = { size = [1.0, 2.0] }

[[controllers]]
name = "never"
method = "quiet_zone"
settings = { band = 1e6 }
"""
)


@pytest.fixture(scope="module")
def sweep():
    text = short_study(CONTROLLERS, steps=60, at=(100, 40))
    return Sweep(parse_study(text), seeds=2, points=3)


@pytest.fixture(scope="module")
def rows(sweep, tmp_path_factory):
    return run_sweep(sweep, tmp_path_factory.mktemp("front"), jobs=1)


@pytest.fixture(scope="module")
def page(sweep, rows):
    return front_page.front_page(sweep, rows)


def content(page):
    return json.loads(re.search(r'<script id="content" type="application/json">(.*?)</script>', page)[1])


def test_points_are_means_over_seeds_and_every_one_has_its_run(sweep, rows, page):
    assert len(page.encode()) < 6e6
    days = (60 - sweep.study.skip) * 10.0 / 86400
    for scenario in content(page)["scenarios"]:
        baseline, points = points_of(rows, scenario["name"])
        shown = {choice["name"]: choice for choice in scenario["choices"]}
        assert shown["MPC"]["x"] == pytest.approx(baseline.moves.mean() / days)
        assert shown["MPC"]["group"] == ""
        for name in ("exact", "bands <b>"):
            own = [choice for choice in scenario["choices"] if choice["group"] == name]
            assert len(own) >= 2
            expected = {round(float(p.error.mean()), 9) for p in points[name]}
            assert {round(choice["y"], 9) for choice in own} <= expected
            assert all(len(choice["signals"]) == 4 for choice in own)
            assert all(choice["y"] <= front_page.WIDEST * shown["MPC"]["y"] for choice in own)


def test_the_first_setting_shown_has_the_fewest_moves_within_the_error_that_fronts_mark(rows, page):
    for scenario in content(page)["scenarios"]:
        first = scenario["choices"][scenario["first"]]
        base = scenario["choices"][scenario["base"]]
        assert base["name"] == "MPC"
        assert first["y"] <= front_page.SHOWN * base["y"]
        assert first["x"] < base["x"]


def test_a_method_that_never_reaches_the_error_is_told_in_words(rows, page):
    baseline, points = points_of(rows, "noisy")
    assert all(error_ratio(point, baseline) > front_page.WIDEST for point in points["never"])
    assert "In noisy, no setting of never comes within 2.5 times the error of plain MPC." in page
    assert not any(choice["group"] == "never" for s in content(page)["scenarios"] for choice in s["choices"])


def test_a_long_front_is_shown_in_part_with_both_ends():
    baseline = Point("MPC", 1.0, np.full(3, 100.0), np.ones(3))
    points = [Point("x", v, np.full(3, 90.0 - v), np.full(3, 1 + v / 100)) for v in range(80)]
    shown = front_page.worth_showing(points, baseline)
    assert len(shown) == front_page.MOST_SETTINGS
    assert shown[0] is points[0]
    assert shown[-1] is points[-1]


@pytest.mark.parametrize("width", [1280, 390])
def test_the_slider_runs_along_the_front_in_a_browser(browser, page, tmp_path, width):
    from selenium.webdriver import Keys

    (tmp_path / "report.html").write_text(page, encoding="utf-8")
    browser.execute_cdp_cmd(
        "Emulation.setDeviceMetricsOverride",
        {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": width < 500},
    )
    browser.get_log("browser")
    browser.get((tmp_path / "report.html").as_uri())
    assert browser.execute_script("return document.documentElement.scrollWidth") <= width
    for name in ("sentence", "tradeoff", "slider", "signals", "wear"):
        assert browser.find_element("id", name).is_displayed()
    legend = browser.find_element("css selector", "#tradeoff .legend").text
    assert "exact" in legend
    assert "bands <b>" in legend
    slider, drawn = browser.find_element("id", "slider"), []
    slider.send_keys(Keys.HOME)
    for _ in range(int(slider.get_attribute("max")) + 1):
        told = browser.execute_script("return document.getElementById('sentence').textContent")
        last = browser.execute_script("return document.getElementById('signals').data.at(-1).y")
        drawn.append((told, tuple(last)))
        slider.send_keys(Keys.ARROW_RIGHT)
    assert len({told for told, _ in drawn}) == len(drawn)
    assert len({last for _, last in drawn}) >= 3
    assert browser.get_log("browser") == []
