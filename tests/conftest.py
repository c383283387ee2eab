"""Optimal solves of every test are checked for their optimality conditions: one of ten, or with `make deep` all."""

import gc
import os
import shutil
import sys

# Before NumPy is there: tests run one process a core, and more threads than cores only wait for each other.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

from collections import Counter
from itertools import count, islice

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, settings

from builders import load_bank
from mampc import KalmanFilter
from mampc.program.daqp import DaqpSolver
from mampc.program.qp import UNBOUNDED, QPStatus
from mampc.report import output
from mampc.report.figures import study_figures
from seeds import examples

# For tests/test_fuzz.py alone; other tests keep the settings that they state.
settings.register_profile(
    "short", max_examples=examples(100, quick=12), stateful_step_count=20, deadline=None, derandomize=True,
    phases=[Phase.explicit, Phase.generate],  # shrinking takes many minutes; `make fuzz` does it
    suppress_health_check=[HealthCheck.too_slow],
)  # fmt: skip
settings.register_profile(
    "long",
    settings.get_profile("short"),
    max_examples=3000,
    derandomize=False,
    print_blob=True,
    phases=list(Phase),
)

SOLVES = count()  # numbers the optimal solves of a process
TOLERANCE = 1e-8  # relative to the sizes of the data


def largest(array):
    return np.max(np.abs(array), initial=0.0)


def certify(program, f, lower, upper, solution):
    """Fail unless the solution satisfies the Karush-Kuhn-Tucker conditions of its program."""
    z, pull = solution.z, solution.multipliers
    bounds = np.concatenate([lower, upper])
    bounds = bounds[np.abs(bounds) < UNBOUNDED]
    size = max(1.0, largest(program.rows(z)), largest(bounds))
    gradient = max(1.0, largest(f), largest(program.H) * largest(z), largest(pull))
    assert program.primal_residual(lower, upper, solution) <= TOLERANCE * size
    assert program.dual_residual(f, solution) <= TOLERANCE * gradient
    assert program.duality_gap(lower, upper, solution) <= TOLERANCE * gradient * size


@pytest.fixture(autouse=True, scope="session")
def _optimal_solves_are_certified():
    solve = DaqpSolver.solve

    def certified(self, f, lower, upper):
        solution = solve(self, f, lower, upper)
        if solution.status is QPStatus.OPTIMAL and next(SOLVES) % examples(1, quick=10) == 0:
            certify(self.program, f, lower, upper, solution)
        return solution

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(DaqpSolver, "solve", certified)
        yield


def pytest_collection():
    """Nothing that is imported or collected is garbage."""
    gc.disable()


def pytest_collection_finish():
    """It stays: the garbage collector need not look at it again and again."""
    gc.freeze()
    gc.enable()


FUZZED: Counter[str] = Counter()  # steps of the regulator by status, of all processes


def _fuzzed_here():
    fuzz = sys.modules.get("test_fuzz")
    return Counter() if fuzz is None else fuzz.STEPPED


def pytest_sessionfinish(session):
    """A process of several tells the first one what it fuzzed."""
    if hasattr(session.config, "workeroutput"):
        session.config.workeroutput["fuzzed"] = {str(status): n for status, n in _fuzzed_here().items()}


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node):
    FUZZED.update(getattr(node, "workeroutput", {}).get("fuzzed", {}))


def pytest_terminal_summary(terminalreporter):
    """How many steps were fuzzed, and how they ended."""
    FUZZED.update(_fuzzed_here())
    if FUZZED:
        ends = ", ".join(f"{count} {status}" for status, count in FUZZED.most_common())
        terminalreporter.write_line(f"{FUZZED.total()} fuzzed steps of the regulator: {ends}")


@pytest.fixture(params=["kalman filter", "load bank"])
def either_estimator(request, monkeypatch):
    """Runs a test with each estimator as the default one of all regulators."""
    estimators = {
        "kalman filter": lambda controller: KalmanFilter.offset_free(controller.problem.model),
        "load bank": lambda controller: load_bank(controller.problem),
    }
    monkeypatch.setattr("mampc.loop.regulator.default_estimator", estimators[request.param])
    return request.param


@pytest.fixture(scope="session")
def browser():
    """Chromium without a window; skipped where there is none."""
    driver = pytest.importorskip("selenium.webdriver", reason="needs selenium")
    chromium, chromedriver = shutil.which("chromium"), shutil.which("chromedriver")
    if chromium is None or chromedriver is None:
        pytest.skip("needs chromium and chromedriver: apt-get install chromium chromium-driver")
    options = driver.ChromeOptions()
    options.binary_location = chromium
    for argument in ("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"):
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    browser = driver.Chrome(options=options, service=driver.ChromeService(chromedriver))
    yield browser
    browser.quit()


@pytest.fixture
def few_figures(monkeypatch):
    """A run draws the first of its figures, and commands draw PNG alone, since drawing takes most of their time."""
    monkeypatch.setattr(output, "FIGURE_KINDS", ("png",))
    monkeypatch.setattr(output, "study_figures", lambda result: islice(study_figures(result), 1))
