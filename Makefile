# Two commands from a fresh clone: `make demo` and `make test`. Both set up .venv first.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

.PHONY: setup demo test test-long test-processors attack lint types suite site clean
.DEFAULT_GOAL := demo

$(VENV)/.installed: pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check -e '.[dev]'
	touch $@

setup: $(VENV)/.installed

demo: setup  ## A synthetic dive through the whole pipeline; the result is runs/demo/report.html
	$(BIN)/swimm3r demo --out runs/demo

attack: setup  ## Bad input over every command; hours on two cores, or one family: make attack FAMILIES=outputs
	$(BIN)/python -m tests.attack $(FAMILIES)

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: setup
	$(BIN)/pyright

suite: setup
	$(BIN)/pytest -n 2 --dist loadfile --no-loadscope-reorder

test: lint  ## Linters, then the type checker beside the test suite
	$(MAKE) --no-print-directory -j 2 types suite

test-long: setup  ## The tests that `make test` leaves out because they compute for long
	$(BIN)/pytest -n 2 --dist load -m long

test-processors: setup  ## The numerically delicate tests as other processors and thread counts see them
	$(BIN)/python tests/processors.py $(PROFILES)

site: setup  ## The documents as a web site: site/index.html (the test suite builds it, too)
	DISABLE_MKDOCS_2_WARNING=true NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

clean:
	rm -rf runs site .pytest_cache .ruff_cache
