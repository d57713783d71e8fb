# Both commands set up what they need: a virtual environment in .venv with the exact versions of requirements.lock.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin

PEERS := .venv-peers
SUITES := .venv-suites
RACE := benchmarks/results/own-speed.json
WHEEL := .venv-wheel

LINTED := src tests benchmarks examples docs/site_hooks.py

.PHONY: quickstart test test-slow peers suites wheel docs fuzz check lint format types benchmark benchmark-details clean

quickstart: $(VENV)/installed  ## compare four variants on HalfCheetah-v4, in minutes
	$(BIN)/saclab compare HalfCheetah-v4 --protocol quick

test: $(VENV)/installed  ## the fast tests
	$(BIN)/python -m pytest -n auto --dist loadfile

test-slow: $(VENV)/installed  ## learning to a threshold, long kill-and-resume
	$(BIN)/python -m pytest -n auto --dist loadfile -m slow

peers: $(PEERS)/installed  ## the other libraries, for `make benchmark` and for a slow test that compares updates with one

suites: $(SUITES)/installed  ## dm_control and gymnasium-robotics, for a slow test that trains on them

wheel: $(VENV)/installed  ## build the wheel, install it into an empty environment, and train with it there
	rm -rf build dist $(WHEEL)
	$(BIN)/pip wheel --quiet --disable-pip-version-check --no-deps --wheel-dir dist .
	$(PYTHON) -m venv $(WHEEL)
	$(WHEEL)/bin/pip install --quiet --disable-pip-version-check --constraint requirements.lock dist/saclab-*.whl
	cd $(WHEEL) && bin/saclab --version && bin/saclab compare Pendulum-v1 --variants sac sac-auto --protocol quick \
		--max-updates 50 --random-steps 200 --batch-size 32 --evaluation-interval-steps 250 --runs runs

docs: $(VENV)/installed  ## the documentation site, in site/: read site/index.html
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build

fuzz: $(VENV)/installed  ## look for damage and misuse that is not told of, for as long as it takes
	SACLAB_FUZZ=long $(BIN)/python -m pytest -m "slow or not slow" tests/fuzz

check: lint types test

lint: $(VENV)/installed
	$(BIN)/ruff check $(LINTED)
	$(BIN)/ruff format --check $(LINTED)

format: $(VENV)/installed
	$(BIN)/ruff check --fix $(LINTED)
	$(BIN)/ruff format $(LINTED)

types: $(VENV)/installed
	$(BIN)/mypy

benchmark: $(VENV)/installed $(PEERS)/installed  ## speed against other libraries: leave the machine alone meanwhile
	$(BIN)/python benchmarks/speed.py --peers $(PEERS)/bin/python --results $(RACE)
	$(BIN)/python benchmarks/tables.py speed --results $(RACE)
	$(BIN)/python benchmarks/tables.py peers --results $(RACE)

benchmark-details: $(VENV)/installed  ## where the time and the memory go: leave the machine alone meanwhile
	NPROC=1 OPENBLAS_NUM_THREADS=1 taskset -c 0 $(BIN)/python benchmarks/breakdown.py HalfCheetah-v4
	NPROC=1 OPENBLAS_NUM_THREADS=1 taskset -c 0 $(BIN)/python benchmarks/least.py HalfCheetah-v4
	NPROC=1 OPENBLAS_NUM_THREADS=1 taskset -c 0 $(BIN)/python benchmarks/growth.py
	$(BIN)/python benchmarks/memory.py
	$(BIN)/python benchmarks/batches.py HalfCheetah-v4 --runs 1 4 16 --alone

$(PEERS)/installed: benchmarks/peers.txt
	$(PYTHON) -m venv $(PEERS)
	$(PEERS)/bin/pip install --quiet --disable-pip-version-check --requirement benchmarks/peers.txt
	touch $@

$(SUITES)/installed: tests/environments/suites.txt requirements.lock pyproject.toml
	$(PYTHON) -m venv $(SUITES)
	grep -v -e '^mujoco' -e '^numpy' requirements.lock > $(SUITES)/constraints.txt
	$(SUITES)/bin/pip install --quiet --disable-pip-version-check --constraint $(SUITES)/constraints.txt \
		--constraint tests/environments/suites.txt --editable '.[dev,dm-control,robotics]'
	touch $@

$(VENV)/installed: requirements.lock pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check --requirement requirements.lock
	$(BIN)/pip install --quiet --disable-pip-version-check --no-deps --editable .
	touch $@

clean:
	rm -rf $(VENV) $(PEERS) $(SUITES) $(WHEEL) build dist site src/*.egg-info
