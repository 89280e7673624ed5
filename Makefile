# `make demo` and `make test` need Python 3.11 or newer and nothing else: each makes the virtual
# environment, installs, and runs.

PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
# Tests run in as many processes at a time, each on its share of the processors.
WORKERS ?= 2
PYTEST := $(BIN)/python -m pytest -n $(WORKERS) --dist worksteal

.PHONY: demo check test docs coverage study-reduced test-slow fuzz lint format benchmarks clean

demo: $(STAMP)
	$(BIN)/dropo demo --out out/demo

# For every commit: two minutes on two processors.
check: lint
	$(PYTEST) -m 'not slow and not whole' --durations=3

# What every change must pass.
test: lint
	$(PYTEST) --durations=8

coverage: $(STAMP)
	$(PYTEST) --cov --cov-report=term-missing

study-reduced: $(STAMP)
	$(BIN)/dropo reproduce hopper --reduced --out out/study-reduced/hopper
	$(BIN)/dropo reproduce push --reduced --out out/study-reduced/push
	$(BIN)/dropo reproduce puck --reduced --out out/study-reduced/puck

test-slow: $(STAMP)
	$(BIN)/python -m pytest -m slow --durations=20

# The documentation as a site, in out/site: a page that is wrong, and a notebook that does not run, end it.
docs: $(STAMP)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[docs]'
	$(BIN)/python -m sphinx -W --keep-going -q -b html docs out/site
	@echo "out/site/index.html"

# Ten minutes on two processors; SEED=N for other mutations.
SEED ?= 0
fuzz: $(STAMP)
	$(BIN)/python tests/fuzz.py --mutations 10500 --workers $(WORKERS) --seed $(SEED)

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: $(STAMP)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

benchmarks: $(STAMP)
	$(BIN)/python benchmarks/objective_cost.py
	$(BIN)/python benchmarks/import_time.py

$(STAMP): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "Python 3.11 or newer is needed; name one: make PYTHON=python3.12"; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev]'
	@touch $(STAMP)

clean:
	rm -rf $(VENV) out build *.egg-info
