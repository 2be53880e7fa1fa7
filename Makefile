# Verbs of the house. Everything runs in .venv, which is made from constraints.txt on first need.

PYTHON ?= python3
VENV := .venv
STAMP := $(VENV)/.stamp
BIN := $(VENV)/bin

.DEFAULT_GOAL := help
.PHONY: help run test test-slow test-container exhaustive sbom chaos check format bench clean

help:  ## List the verbs.
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*##/\t/'

$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; v = sys.version_info[:2]; sys.exit(0 if (3, 11) <= v < (3, 15) else f"needs Python 3.11 to 3.14, not {v[0]}.{v[1]}; try make PYTHON=python3.11")'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@echo "installing about 3 GB of packages into $(VENV); several minutes"
	$(BIN)/pip install --quiet -c constraints.txt -e '.[dev]'
	touch $@

run: $(STAMP)  ## Collect, train, collect again, evaluate: a small campaign, a few minutes on two cores.
	$(BIN)/adaafford run --preset smoke --out runs/smoke

test: $(STAMP)  ## The tests, without the slow ones and chaos, in two processes.
	$(BIN)/python -m pytest -q -m "not slow and not chaos and not exhaustive" -n 2 --dist worksteal

test-slow: $(STAMP)  ## The slow tests, without those of containers, in two processes.
	@# Pytest ends with 5 where it selects no test, which is no failure of a suite that may be empty.
	$(BIN)/python -m pytest -q -m "slow and not container" -n 2 --dist worksteal || test $$? -eq 5

test-container: $(STAMP)  ## Build the image and run the services of docker-compose.yml by podman, ten minutes; needs root.
	$(BIN)/python -m pytest -q -s -m container

exhaustive: $(STAMP)  ## Twenty thousand hostile files, and every error at every step of reading, an hour or more.
	$(BIN)/python -m pytest -q -s -m exhaustive

sbom: $(STAMP)  ## List what is installed, with versions and licences, into build/sbom.json (CycloneDX).
	@# Its program has a separate environment: its dependencies make every import of Ray two seconds slower.
	test -x build/cyclonedx/bin/cyclonedx-py || { $(PYTHON) -m venv build/cyclonedx && \
	  build/cyclonedx/bin/pip install --quiet -c constraints.txt cyclonedx-bom; }
	build/cyclonedx/bin/cyclonedx-py environment --output-reproducible --output-file build/sbom.json $(BIN)/python

chaos: $(STAMP)  ## Kill campaigns at random moments and disturb every write step, in two processes; SEED=N for other moments.
	$(if $(SEED),ADAAFFORD_CHAOS_SEED=$(SEED)) $(BIN)/python -m pytest -q -m chaos -n 2 --dist worksteal tests/chaos

check: $(STAMP)  ## Lint, formatting, types, import directions.
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports --no-cache

format: $(STAMP)  ## Put the code in its form.
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

bench: $(STAMP)  ## Fidelity, dynamics and speed of push and pull, and of learning, into dated files; OBJECTS=FOLDER for real objects.
	@for task in push pull; do \
	  for what in "adaafford bench fidelity --trials 500" "adaafford bench dynamics" \
	      "adaafford bench collect --workers 2" "python -m benchmarks.published"; do \
	    echo "== $$what, $$task"; \
	    $(BIN)/$$what --task $$task $(if $(OBJECTS),--objects $(OBJECTS)) --out benchmarks || exit 1; \
	  done; \
	done
	@for name in storing learning adapting; do $(BIN)/python -m benchmarks.$$name --out benchmarks || exit 1; done

clean:  ## Remove the environment, caches and runs/.
	rm -rf $(VENV) runs build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
