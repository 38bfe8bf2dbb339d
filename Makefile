# `make demo` and `make test` install what they need into .venv and start from nothing but python3, gcc and make.
PYTHON ?= python3
BIN := .venv/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check
SEED ?= 0
PEOPLE ?= 4
DURATION ?= 60

.PHONY: help demo test lint clean

help:
	@echo "make demo   export, simulate, drive for $(DURATION) s and write out/demo/report.html"
	@echo "make test   lint, type-check and run the tests"
	@echo "make lint   ruff and mypy only"
	@echo "make clean  remove out/ (keeps .venv)"

.venv/bin/python:
	@$(PYTHON) -m venv .venv || { rm -rf .venv; echo "make: $(PYTHON) cannot make a virtual environment; on Debian: apt-get install python3-venv" >&2; exit 1; }

# Stamps are newer than what they were installed from: a second run installs nothing.
.venv/.demo-installed: pyproject.toml constraints.txt | .venv/bin/python
	@echo "installing the demo's packages into .venv (once)" >&2
	$(PIP) install --quiet -c constraints.txt -e ".[export,sim]"
	@touch $@

.venv/.test-installed: .venv/.demo-installed
	@echo "installing the test packages into .venv (once)" >&2
	$(PIP) install --quiet -c constraints.txt -e ".[export,sim,dev]"
	@touch $@

demo: .venv/.demo-installed
	@$(BIN)/python -m tools.demo --out out/demo --duration $(DURATION) --seed $(SEED) --people $(PEOPLE)

lint: .venv/.test-installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

test: lint
	$(BIN)/pytest

clean:
	rm -rf out
