# Every target sets up what it needs in .venv, from a fresh clone, with Python >= 3.11, git and make.
PYTHON ?= python3
UV_DIR := .uv
UV := $(shell command -v uv 2>/dev/null || echo $(UV_DIR)/bin/uv)
BIN := .venv/bin
export UV_COMPILE_BYTECODE := 1
export UV_PYTHON_DOWNLOADS := never
export UV_LINK_MODE := copy
export VIRTUAL_ENV := $(CURDIR)/.venv
# One thread a process: the tests and benchmarks share the cores among processes, and small matrices gain nothing.
export OPENBLAS_NUM_THREADS := 1
export OMP_NUM_THREADS := 1
# Compiled modules are kept, or every process of the tests compiles them again.
unexport PYTHONDONTWRITEBYTECODE
PYTEST := $(BIN)/python -m pytest -n auto --dist worksteal
# A file of deep tests is run again when it or the package has changed; `make deep -k` goes on past a file that fails.
SOURCES := $(shell find src -name '*.py') $(filter-out tests/test_%,$(wildcard tests/*.py))
DEEP := $(patsubst tests/%.py,.deep/%.stamp,$(wildcard tests/test_*.py))

.PHONY: demo test deep coverage fuzz lint format bench conditioning methods attention figures lock clean help
.DEFAULT_GOAL := help

help:  ## what can be made
	@grep -hE '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 12

demo: .venv/run.stamp  ## run the quadruple-tank study: a table, results/quadruple-tank with figures
	$(BIN)/mampc run quadruple-tank --out results/quadruple-tank

test: .venv/dev.stamp  ## run the tests
	$(PYTEST) $(PYTEST_ARGS)

deep: $(DEEP)  ## run all tests with every seed and example, file by file; goes on where it stopped

.deep/%.stamp: tests/%.py $(SOURCES) | .venv/dev.stamp
	@mkdir -p .deep
	MAMPC_DEEP=1 $(PYTEST) -m "" $(PYTEST_ARGS) $<
	@touch $@

coverage: .venv/dev.stamp  ## run the tests and show which branches none of them takes
	$(PYTEST) --cov --cov-report=term-missing:skip-covered $(PYTEST_ARGS)

fuzz: .venv/dev.stamp  ## 100 000 fuzzed steps of the regulator
	$(PYTEST) tests/test_fuzz.py --hypothesis-profile long $(PYTEST_ARGS)

lint: .venv/dev.stamp  ## style, types and the layers of imports
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

format: .venv/dev.stamp  ## put the code in shape
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: .venv/dev.stamp  ## speed, as ratios measured side by side
	$(BIN)/python benchmarks/bench.py

conditioning: .venv/dev.stamp  ## 2000 badly conditioned problems against brute force in 120 digits
	$(BIN)/python benchmarks/conditioning.py

methods: .venv/dev.stamp  ## compare all methods on random instances, and renew their table in docs/methods.md
	$(BIN)/python benchmarks/methods.py --markdown

attention: .venv/dev.stamp  ## moves at equal error on every plant, load and method; renew docs/comparison.md
	$(BIN)/python benchmarks/attention.py

figures: .venv/run.stamp  ## redraw the figures of the documentation
	$(BIN)/python docs/draw_figures.py

lock: .venv/dev.stamp  ## pin the versions that tests and demo use
	$(UV) export --quiet --no-hashes --no-emit-project --no-header --no-annotate \
	  --all-extras --group dev --output-file requirements.lock
	rm -f uv.lock

clean:  ## remove environments and caches
	rm -rf .venv .uv .deep .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache

.venv/pyvenv.cfg:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
	  || { echo "mampc needs Python 3.11 or newer; set PYTHON=..."; exit 1; }
	@echo "Setting up .venv, once ..."
	@command -v uv >/dev/null 2>&1 || test -x $(UV_DIR)/bin/uv \
	  || { $(PYTHON) -m venv $(UV_DIR) && $(UV_DIR)/bin/python -m pip install --quiet uv; }
	@$(UV) venv --quiet --allow-existing --python $(PYTHON) .venv

.venv/run.stamp: .venv/pyvenv.cfg pyproject.toml requirements.lock
	@echo "Installing what a run needs ..."
	@$(UV) pip install --quiet --constraint requirements.lock --editable '.[plot,report]'
	@touch $@

.venv/dev.stamp: .venv/pyvenv.cfg pyproject.toml requirements.lock
	@echo "Installing what tests and linters need ..."
	@$(UV) pip install --quiet --requirement requirements.lock --editable '.[plot,report]'
	@touch $@ .venv/run.stamp
