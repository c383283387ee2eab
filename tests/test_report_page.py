"""report.html: one page without a network, looked at in a real browser where there is one."""

import json
import re
import sys
from dataclasses import replace
from html.parser import HTMLParser
from typing import ClassVar

import numpy as np
import pytest

from mampc.report import output
from mampc.study import parse_study, run_study, template

interactive = pytest.importorskip("mampc.report.interactive")
page_content = pytest.importorskip("mampc.report.page_content")
pytest.importorskip("plotly", reason="needs plotly, which mampc[report] brings")

NASTY = '</script><img src=x onerror=alert(1)> $1 & "2" {3}'
LONG = "without noise and with a name as long as a window on a telephone is never wide"
SHORT = (
    template()
    .replace("steps = 145", "steps = 40")
    .replace("at = 100", "at = 30")
    .replace("prbs_order = 8", "prbs_order = 6")
)


@pytest.fixture(scope="module")
def result():
    named = SHORT.replace('name = "noise-free"', f'name = "{LONG}"')
    return run_study(parse_study(named.replace('name = "exact budget"', f"name = '{NASTY}'")))


@pytest.fixture(scope="module")
def page(result):
    return interactive.interactive_page(result)


def content(page):
    return json.loads(re.search(r'<script id="content" type="application/json">(.*?)</script>', page)[1])


def test_the_page_needs_nothing_from_elsewhere(page):
    class Tags(HTMLParser):
        seen: ClassVar = []

        def handle_starttag(self, tag, attributes):
            self.seen.append((tag, dict(attributes)))

    tags = Tags()
    tags.feed(page)
    assert not any({"src", "href"} & set(attributes) for _, attributes in tags.seen)
    assert not any(tag in ("link", "img", "iframe") for tag, _ in tags.seen)
    assert any("default-src 'none'" in attributes.get("content", "") for _, attributes in tags.seen)
    assert len(page.encode()) < 6e6


def test_the_page_says_what_a_controller_saves(page, result):
    scenario = content(page)["scenarios"][1]
    metrics = {name: run.metrics(threshold=0.1) for name, run in result.runs["noisy"].items()}
    for choice in scenario["choices"]:
        own = metrics[choice["name"]]
        assert choice["x"] == pytest.approx(86400 / 10 * own.sparse_density.sum())
        assert choice["y"] == own.tracking_error
    assert [choice["x"] for choice in scenario["choices"]] == sorted(c["x"] for c in scenario["choices"])
    own, base = (
        next(choice for choice in scenario["choices"] if choice["name"] == name)
        for name in ("exact price", "MPC")
    )
    ratio = f"{own['y'] / base['y']:.2f} times the tracking error of MPC"
    assert own["sentence"].startswith("exact price: from ")
    assert ratio in own["sentence"]
    assert scenario["choices"][scenario["first"]]["name"] == "exact price"


def test_the_page_shows_the_runs_as_they_were(page, result):
    for scenario, runs in zip(content(page)["scenarios"], result.runs.values(), strict=True):
        for choice in scenario["choices"]:
            run = runs[choice["name"]]
            shown = np.array(choice["signals"])
            exact = np.hstack([run.y, run.u]).T
            assert np.abs(shown - exact).max() <= 1e-4 * np.ptp(exact, axis=1).max()


def test_a_long_run_of_many_controllers_stays_small_and_keeps_its_extremes(result):
    rng, steps = np.random.default_rng(0), 50_000
    first = result.runs["noisy"]["MPC"]
    long = replace(
        first, t=10.0 * np.arange(steps), u=rng.normal(50, 1, (steps, 2)), y=rng.normal(30, 1, (steps, 2)),
        r=np.full((steps, 2), 30.0), decisions=first.decisions[:1] * steps,
    )  # fmt: skip
    table = result.study.controllers[0]
    tables = [table, *(table.model_copy(update={"name": f"controller {i}"}) for i in range(11))]
    study = result.study.model_copy(update={"controllers": tables, "steps": steps})
    runs = {"noisy": {table.name: long for table in tables}}
    page = interactive.interactive_page(replace(result, study=study, runs=runs))
    assert len(page.encode()) < 6e6
    shown = content(page)["scenarios"][0]["choices"][0]["signals"][0]
    assert max(shown) == pytest.approx(long.y[:, 0].max(), abs=1e-3)
    assert min(shown) == pytest.approx(long.y[:, 0].min(), abs=1e-3)
    assert "Of every" in page


def test_one_controller_that_never_moves_makes_a_page(result):
    study = result.study.model_copy(update={"controllers": result.study.controllers[:1], "threshold": 1e6})
    runs = {name: {"MPC": runs["MPC"]} for name, runs in result.runs.items()}
    page = interactive.interactive_page(
        replace(result, study=study, runs=runs, identified=None, warnings=("<b>",))
    )
    assert "0 moves a day" in content(page)["scenarios"][0]["choices"][0]["sentence"]
    assert "<li>&lt;b&gt;</li>" in page


def test_a_run_writes_its_page_or_says_how_to_get_it(tmp_path, monkeypatch):
    study = parse_study(SHORT)
    study = study.model_copy(update={"controllers": study.controllers[:1], "scenarios": study.scenarios[:1]})
    monkeypatch.setattr(output, "study_figures", lambda result: ())
    *_, missing = output.run_and_write(study, tmp_path / "with")
    assert (tmp_path / "with" / "report.html").stat().st_size > 4e6
    assert missing == ()
    monkeypatch.setitem(sys.modules, "plotly.offline", None)
    *_, missing = output.run_and_write(study, tmp_path / "without")
    assert missing == ("no report.html written; it needs plotly: pip install 'mampc[report]'",)
    assert not (tmp_path / "without" / "report.html").exists()


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"),
        (59.6, "60"),
        (1316.0, "1\u202f300"),
        (0.0123, "0.012"),
        (9.99, "10"),
        (2e-9, "2e-09"),
        (99.9, "100"),
    ],
)
def test_numbers_are_said_to_two_digits(value, text):
    assert page_content.number(value) == text


@pytest.fixture(params=[1280, 390])
def opened(request, browser, page, tmp_path):
    (tmp_path / "report.html").write_text(page, encoding="utf-8")
    browser.execute_cdp_cmd(
        "Emulation.setDeviceMetricsOverride",
        {"width": request.param, "height": 900, "deviceScaleFactor": 1, "mobile": request.param < 500},
    )
    browser.get_log("browser")
    browser.get((tmp_path / "report.html").as_uri())
    yield browser, request.param
    assert browser.get_log("browser") == []


def drawn(browser):
    """What the figure of the signals shows: name -> first input, and the sentence above it."""
    names = browser.execute_script("return document.getElementById('signals').data.map(t => t.name)")
    return set(names), browser.execute_script("return document.getElementById('sentence').textContent")


def test_everything_is_visible_and_as_wide_as_the_window(opened):
    browser, width = opened
    assert browser.execute_script("return document.documentElement.scrollWidth") <= width
    for name in ("sentence", "tradeoff", "slider", "signals", "wear", "scenarios"):
        element = browser.find_element("id", name)
        assert element.is_displayed()
        assert element.rect["width"] > 0.7 * min(width, 1120)
    panels = browser.execute_script("return document.querySelectorAll('#signals .subplot').length")
    assert panels == 4
    assert browser.execute_script("return document.querySelectorAll('body img').length") == 0


def test_the_slider_and_a_click_change_what_is_shown(opened):
    from selenium.webdriver import ActionChains, Keys

    browser, _ = opened
    slider = browser.find_element("id", "slider")
    last = int(slider.get_attribute("max"))
    seen = {drawn(browser)[1]}
    slider.send_keys(Keys.HOME)
    for _ in range(last):
        slider.send_keys(Keys.ARROW_RIGHT)
        names, sentence = drawn(browser)
        seen.add(sentence)
        assert {"MPC", "reference"} <= names
    assert len(seen) == last + 1
    names, sentence = drawn(browser)
    assert sentence.startswith("MPC, which the others are compared with")
    wear = browser.find_element("id", "wear").text
    assert "→" not in wear
    # A click on the point of the fewest moves.
    point = browser.find_elements("css selector", "#tradeoff .points path")[0]
    browser.execute_script(
        "arguments[0].scrollIntoView({block: 'center'})", browser.find_element("id", "tradeoff")
    )
    ActionChains(browser).move_to_element(point).click().perform()
    assert "exact price" in drawn(browser)[0]
    assert slider.get_attribute("value") == "0"
    assert "→" in browser.find_element("id", "wear").text


def test_another_scenario_shows_its_own_runs(opened):
    browser, _ = opened
    before = browser.execute_script("return document.getElementById('signals').data[1].y")
    browser.find_elements("css selector", "#scenarios input")[1].click()
    assert browser.execute_script("return document.getElementById('signals').data[1].y") != before
    shown = [table.is_displayed() for table in browser.find_elements("css selector", "table[data-scenario]")]
    assert shown == [False, True]


def test_a_printed_page_fits_its_paper_and_the_window_after_it(opened):
    browser, width = opened
    for event, media in (("beforeprint", "print"), ("afterprint", "")):
        browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": media})
        browser.execute_script(f"window.dispatchEvent(new Event('{event}'))")
        plot = browser.find_element("css selector", "#signals .main-svg").rect["width"]
        assert plot == 680 if media else plot <= width
        assert browser.find_element("id", "slider").is_displayed() == (media == "")


def test_the_page_draws_zones_that_move_as_bands_within_what_a_panel_shows():
    told = "zones = [{ at = 15, below = 0.1, above = [inf, 0.4] }]\n\n[[scenarios]]"
    text = SHORT.replace("# zone_below", "zone_below").replace("# zone_above", "zone_above")
    text = text.replace("[[scenarios]]", told, 1)
    study = parse_study(text[: text.index("[[scenarios]]")] + text[text.rindex("[[scenarios]]") :])
    study = study.model_copy(update={"controllers": study.controllers[:1]})
    result = run_study(study)
    page = interactive.interactive_page(result)
    (scenario,) = content(page)["scenarios"]
    zone = result.runs["noisy"]["MPC"].zone
    panels = scenario["panels"]
    assert [panel["reference"] for panel in panels] == [None] * 4
    assert [panel["zone"] for panel in panels[2:]] == [None, None]
    for i, panel in enumerate(panels[:2]):
        (low, high), (bottom, top) = panel["zone"], panel["range"]
        np.testing.assert_allclose(low, zone.low[:, i], atol=2e-3)
        shown = np.isfinite(zone.high[:, i])
        np.testing.assert_allclose(np.array(high)[shown], zone.high[shown, i], atol=2e-3)
        assert (np.array(high)[~shown] > top).all()
        assert max(high) <= top + (top - bottom)
    assert "Grey bands are zones" in page
    assert "<th>time outside</th>" in page
