# Two commands: `make demo` and `make test`. Each makes what it needs first. `make nightly` runs the long tests too.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt
CORE := $(VENV)/.installed# what a user needs, and the demo
STAMP := $(VENV)/.installed-dev# what tests and documentation need too

.PHONY: demo test nightly lint docs dist clean

demo: $(CORE)
	rm -rf demo
	PYTHONDONTWRITEBYTECODE= $(BIN)/mstfilter demo --out demo

PYTEST := PYTHONDONTWRITEBYTECODE= OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist worksteal

test: $(STAMP) lint
	$(PYTEST) -m "not nightly"

nightly: $(STAMP) lint
	$(PYTEST)

lint: $(STAMP)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/lint-imports --no-cache
	$(BIN)/mypy

docs: $(STAMP)
	$(BIN)/python -m sphinx -W -q -b html docs docs/_build/html
	@echo "docs: docs/_build/html/index.html"

dist: $(STAMP)
	rm -rf dist
	$(PIP) -e '.[release]'
	$(BIN)/python -m build
	$(BIN)/python -m twine check --strict dist/*

# Modules are compiled when they are first imported, so the demo starts sooner.
$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "error: $(PYTHON) is missing or older than 3.11; hint: make PYTHON=python3.12 ..."; exit 2; }
	@$(PYTHON) -c 'import venv, ensurepip' 2>/dev/null || { echo "error: $(PYTHON) has no venv module; hint: apt install python3-venv"; exit 2; }
	@$(PYTHON) -m venv $(VENV)

$(CORE): pyproject.toml constraints.txt | $(BIN)/python
	$(PIP) --no-compile -e .
	@touch $@

$(STAMP): pyproject.toml constraints.txt | $(BIN)/python
	$(PIP) --no-compile -e '.[dev]'
	@touch $(CORE) $@

clean:
	rm -rf $(VENV) demo build dist docs/_build
