# Everything from a fresh clone: `make demo` and `make test` need only Python 3.10 or 3.11, make and git.
PYTHON ?= $(shell command -v python3.11 || command -v python3.10 || command -v python3)
VENV ?= .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed

.PHONY: demo test test-slow docs benchmark benchmark-learning notebooks lint format type check clean

$(INSTALLED): setup.cfg constraints.txt
	@$(PYTHON) -c 'import sys; v = sys.version_info[:2]; sys.exit(None if (3, 10) <= v < (3, 12) else "Python %d.%d was found, but PyBullet 3.2.7 has wheels up to Python 3.11 only: install Python 3.10 or 3.11 and run `make PYTHON=python3.11 ...`" % v)'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install -q --upgrade -c constraints.txt pip setuptools wheel
	$(BIN)/pip install -q -c constraints.txt torch
	$(BIN)/pip install -q -c constraints.txt --no-build-isolation -e ".[zoo,dev]"
	touch $@

demo: $(INSTALLED)
	$(BIN)/python -m sb3_uspl.demo

test: $(INSTALLED) lint type
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2

test-slow: $(INSTALLED)
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -m slow

# 15 to 35 minutes on two cores that nobody else uses; prints tables and writes benchmarks/results.json.
benchmark: $(INSTALLED)
	$(BIN)/python -m benchmarks

# Hours: trains until success, writes benchmarks/learning.json.
benchmark-learning: $(INSTALLED)
	$(BIN)/python -m benchmarks.to_success

# Runs every text in notebooks/ and stores it as a notebook with its outputs; minutes each. One: make notebooks NOTEBOOKS=notebooks/01_the_gap.py
NOTEBOOKS ?= $(wildcard notebooks/*.py)
notebooks: $(INSTALLED)
	$(BIN)/pip install -q -c constraints.txt --no-build-isolation -e ".[zoo,dev,experiments,notebooks]"
	OMP_NUM_THREADS=1 $(BIN)/python -m jupytext --to ipynb --execute --set-kernel python3 $(NOTEBOOKS)

# The site, into build/docs; a warning is an error.
docs: $(INSTALLED)
	$(BIN)/pip install -q -c constraints.txt --no-build-isolation -e ".[zoo,docs]"
	OMP_NUM_THREADS=1 $(BIN)/python -m sphinx -W --keep-going -q -b html docs build/docs

lint: $(INSTALLED)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

type: $(INSTALLED)
	$(BIN)/mypy

format: $(INSTALLED)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean:
	rm -rf $(VENV) build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache
