# make reconstruct IMAGES=photos/ [OUT=outputs] [CONFIG=pipeline.yaml] [MASKS=dir/] [JOBS=2]
# make test | bench [SCENES='sphere*'] [BENCH_OUT=dir/] | faults (the long set; some 45 minutes) | clean | help
# The first target that needs it creates .venv with the locked versions; only Python 3.11 (or newer) and make are needed.

IMAGES    ?= data/examples
OUT       ?= outputs
CONFIG    ?= pipeline.yaml
MASKS     ?=
JOBS      ?=
SCENES    ?=
BENCH_OUT ?=
# The first interpreter that is new enough; PYTHON=/path/to/python overrides.
PYTHON    ?= $(shell for p in python3.11 python3 python3.12 python3.13; do \
               $$p -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && echo $$p && break; done)

VENV  := .venv
BIN   := $(VENV)/bin
STAMP := $(VENV)/.ready
# Values reach the recipes through the environment: names with spaces need no quoting there.
export IMAGES OUT CONFIG MASKS JOBS SCENES BENCH_OUT

.PHONY: reconstruct test faults lint bench setup clean help
.DEFAULT_GOAL := help

help:
	@sed -n 's/^# //p;/^$$/q' Makefile

setup: $(STAMP)

$(STAMP): requirements.lock pyproject.toml
	@test -n "$(PYTHON)" || { echo "sftex needs Python 3.11 or newer; make PYTHON=/path/to/python3.11 if it is not on the PATH" >&2; exit 1; }
	@echo "setting up $(VENV) with $(PYTHON) (first use, or the dependencies changed) ..." >&2
	@"$(PYTHON)" -m venv --clear $(VENV)
	@$(BIN)/python -m pip install -qq --disable-pip-version-check --require-hashes -r requirements.lock
	@$(BIN)/python -m pip install -qq --disable-pip-version-check --no-deps --no-build-isolation -e .
	@touch $@

reconstruct: $(STAMP)
	@$(BIN)/sftex run "$$IMAGES" --out "$$OUT" --config "$$CONFIG" $${MASKS:+--masks "$$MASKS"} $${JOBS:+--jobs "$$JOBS"}

test: lint
	@$(BIN)/python -m pytest

faults: $(STAMP)
	@SFTEX_FAULTS=long $(BIN)/python -m pytest tests/faults

lint: $(STAMP)
	@$(BIN)/ruff check sftex_stages tests
	@$(BIN)/mypy

bench: $(STAMP)
	@$(BIN)/python -m sftex_stages.bench --config "$$CONFIG" $${SCENES:+--scenes "$$SCENES"} $${BENCH_OUT:+--out "$$BENCH_OUT"} $${JOBS:+--jobs "$$JOBS"}

clean:
	rm -rf $(VENV) build *.egg-info .pytest_cache .mypy_cache .ruff_cache
	find sftex_stages tests -name __pycache__ -type d -prune -exec rm -rf {} +
