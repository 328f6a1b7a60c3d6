# Everything goes through .venv, which `make setup` makes; every target below runs that first.
# Nothing needs to be activated.

PYTHON ?= python3
LAYERS ?= unit contract fuzz integration ros faults
ARGS   ?=

SHELL := /bin/bash
BIN   := .venv/bin
BENCHMARKS := decide latency throughput command startup apply slave_cost keep_cost balance handoff scale restart sealed simulation transfer start_cost web criu soak crash

# .venv is complete in itself. What another environment left behind (a sourced ROS 2, or the
# bootstrapper of the ROS wheels in another virtual environment) would mix its libraries with these.
unexport _ROS_WHEELS_BOOTSTRAP_COMPLETE LD_LIBRARY_PATH PYTHONPATH PYTHONHOME VIRTUAL_ENV
unexport AMENT_PREFIX_PATH CMAKE_PREFIX_PATH COLCON_PREFIX_PATH ROS_DISTRO RMW_IMPLEMENTATION

# Many container images set this. Every process of a cluster would then compile rosrm from its
# source, which doubles the CPU time of its start.
unexport PYTHONDONTWRITEBYTECODE

# By default DDS multicasts on every interface: what runs from here stays on this machine.
export ROS_AUTOMATIC_DISCOVERY_RANGE := LOCALHOST

# Where `make setup` puts CRIU, if it is available.
export ROSRM_CRIU_PREFIX ?= $(CURDIR)/.venv/criu

.DEFAULT_GOAL := help
.PHONY: help setup environment check test lint format pins docs docs-links screenshots demo demo-migration demo-rollout bench evaluation fuzz clean

help: ## this list
	@echo "make TARGET, each sets up what it needs:"
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  %-16s%s\n", $$1, $$2 }' $(MAKEFILE_LIST)
	@echo "Variables: PYTHON=python3.12 (setup), LAYERS=\"unit ros\" ARGS=\"-k name\" (test), DRIVE=path (demo-migration, demo-rollout), OUT=folder (evaluation), MINUTES=60 (fuzz)"

setup: SETUP := --tests
setup: environment ## make .venv with all that the other targets need

environment: ## make .venv with what the demos need
	@command -v $(PYTHON) >/dev/null || { \
	  echo "make setup: no '$(PYTHON)' here; install Python 3.10 to 3.13 or say PYTHON=/path/to/it" >&2; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10))' || { \
	  echo "make setup: $(PYTHON) is $$($(PYTHON) --version 2>&1); rosrm needs Python 3.10 to 3.13:" \
	       "make setup PYTHON=python3.12" >&2; exit 1; }
	@$(PYTHON) scripts/setup.py $(SETUP) $(if $(filter-out file,$(origin PYTHON)),--chosen)

check: setup ## the inner loop, below 3 minutes: lint, types, unit and contract tests
	@$(BIN)/python scripts/run_tests.py --layers unit contract $(ARGS)

test: setup ## lint, types and all tests (LAYERS and ARGS narrow it down)
	@$(BIN)/python scripts/run_tests.py --layers $(LAYERS) $(ARGS)

lint: setup ## ruff, the architecture's contracts, mypy
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/lint-imports
	$(BIN)/mypy

format: setup ## correct what ruff can correct
	$(BIN)/ruff check --fix
	$(BIN)/ruff format

pins: setup ## resolve all requirements on each supported Python, after a change of constraints.txt
	@$(BIN)/python -m scripts.pins

# Without -W on the links: an answer that is slow or moved is reported, and does not end the check.
SPHINX := $(BIN)/python -m sphinx -c docs/site -d build/doctrees -j auto

docs: setup ## the documentation as a site: out/docs/index.html
	@$(SPHINX) -W --keep-going -q -b html . out/docs
	@echo "The site: out/docs/index.html"

docs-links: setup ## follow the links of the documentation to other sites (network)
	@$(SPHINX) -q -b linkcheck . out/docs-links

demo: environment ## three hosts on this machine map a LiDAR drive: out/demo/
	@$(BIN)/python -m rosrm_examples.demo --out out/demo

demo-migration: environment ## a LiDAR drive is mapped while the SLAM moves to another host: out/migration/
	@$(BIN)/python -m rosrm_examples.demo_migration --out out/migration $(if $(DRIVE),--drive "$(DRIVE)")

demo-rollout: environment ## an application gets new versions while it maps a drive: out/rollout/
	@$(BIN)/python -m rosrm_examples.demo_rollout --out out/rollout $(if $(DRIVE),--drive "$(DRIVE)")

bench: setup ## all benchmarks; each ends with one line of JSON
	@set -e; for name in $(BENCHMARKS); do echo "== $$name"; $(BIN)/python -m benchmarks.$$name; done

fuzz: setup ## hostile input with random seeds for a while: make fuzz MINUTES=60
	@$(BIN)/python scripts/fuzz.py --minutes "$(or $(MINUTES),60)"

screenshots: setup ## the pictures of the page in the docs, taken while a demo runs (Chromium)
	@$(BIN)/python -m scripts.screenshots

evaluation: setup ## the paper's figures and table, on virtual hosts: out/evaluation/ (root, 40 minutes)
	@$(BIN)/python -m benchmarks.paper all --out "$(or $(OUT),out/evaluation)"

clean: ## remove .venv, results and caches
	rm -rf .venv build out dist .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
	find . -name __pycache__ -type d -not -path './.git/*' -prune -exec rm -rf {} +
