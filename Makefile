# Both commands set up what they need: a virtual environment in .venv with the exact versions of requirements.lock.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin

.PHONY: quickstart test test-slow check lint format types clean

quickstart: $(VENV)/installed  ## compare four variants on HalfCheetah-v4, in minutes
	$(BIN)/saclab compare HalfCheetah-v4 --protocol quick

test: $(VENV)/installed  ## the fast tests
	$(BIN)/python -m pytest -n auto --dist loadfile

test-slow: $(VENV)/installed  ## learning to a threshold, long kill-and-resume
	$(BIN)/python -m pytest -n auto --dist loadfile -m slow

check: lint types test

lint: $(VENV)/installed
	$(BIN)/ruff check src tests benchmarks
	$(BIN)/ruff format --check src tests benchmarks

format: $(VENV)/installed
	$(BIN)/ruff check --fix src tests benchmarks
	$(BIN)/ruff format src tests benchmarks

types: $(VENV)/installed
	$(BIN)/mypy

$(VENV)/installed: requirements.lock pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check --requirement requirements.lock
	$(BIN)/pip install --quiet --disable-pip-version-check --no-deps --editable .
	touch $@

clean:
	rm -rf $(VENV) build dist src/*.egg-info
