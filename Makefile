PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/pip --disable-pip-version-check install --quiet --constraint constraints.txt

.DEFAULT_GOAL := help
.PHONY: help demo test docs figures blender lint format clean

help: ## show this list
	@awk -F ':.*## ' '/^[a-z]+:.*## / { printf "make %-8s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

demo: $(VENV)/.stamp-fast,render,peers,report,preview ## render a short sequence, denoise it, compare, and write pictures and a report to demo/
	$(BIN)/mcdenoise demo -o demo

# OMP_NUM_THREADS: each process has a core, which threads would only share. GOMP_SPINCOUNT: those of tests that ask for
# more must not spin, which on a busy machine makes torch many times slower.
test: $(VENV)/.stamp-dev ## run every test that is not marked slow or attack, on up to four cores
	OMP_NUM_THREADS=1 GOMP_SPINCOUNT=0 $(BIN)/pytest -m "not slow and not attack" --numprocesses auto --maxprocesses 4

docs: $(VENV)/.stamp-fast,oidn,docs ## build the documentation as a site that opens from disk: build/site/index.html
	OMP_NUM_THREADS=1 GOMP_SPINCOUNT=0 $(BIN)/mkdocs build --quiet
	@echo "build/site/index.html"

figures: $(VENV)/.stamp-fast,render,peers,report ## measure anew what the documentation says of error and run time; takes two hours
	$(BIN)/mcdenoise generate --takes --unseen --seeds 900140-900155,900170-900189,900200-900259 -o build/figures/takes
	$(BIN)/mcdenoise generate --takes --unseen --plain --frames 32 --seeds 900132-900139,900160-900167 -o build/figures/long
	for takes in takes long; do rm -f benchmarks/$$takes.json && $(BIN)/python examples/takes.py build/figures/$$takes \
		--clean build/figures/clean-$$takes --json benchmarks/$$takes.json || exit; done
	$(BIN)/python examples/run_time.py --threads 2 --rounds 5 --json benchmarks/run-time.json
	$(BIN)/python examples/write_tables.py benchmarks

blender: $(VENV)/.stamp-export ## build the extension for Blender: build/mcdenoise-blender.zip
	$(BIN)/python extensions/blender/build.py -o build/mcdenoise-blender.zip

lint: $(VENV)/.stamp-dev ## check style, format and types; change nothing
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy

format: $(VENV)/.stamp-dev ## mend style and format where that is safe
	$(BIN)/ruff check --fix
	$(BIN)/ruff format

clean: ## remove .venv, caches and everything written by make
	rm -rf $(VENV) demo build dist *.egg-info .mypy_cache .pytest_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# One stamp for each set of extras, so that a second run installs nothing.
$(VENV)/.stamp-%: pyproject.toml constraints.txt | $(BIN)/pip
	@echo "installing mcdenoise[$*] into $(VENV); the first time this takes some minutes"
	@$(PIP) torch
	@$(PIP) --editable '.[$*]'
	@touch $@

# pip comes after the interpreter: a venv without it was interrupted, and is made again.
$(BIN)/pip:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || { \
	  echo "mcdenoise needs Python 3.11 or newer; '$(PYTHON)' is not. Name one, such as: make demo PYTHON=python3.12" >&2; \
	  exit 1; }
	@$(PYTHON) -m venv --clear $(VENV)
