# Everything a fresh machine needs: `make leaderboard` and `make test` install what they use.
PYTHON ?= python3
VENV   ?= .venv
TIER   ?= standard
TORCH  := $(shell grep '^torch==' constraints.txt)
BIN    := $(VENV)/bin
READY  := $(VENV)/.ready

.DEFAULT_GOAL := help
.PHONY: help install leaderboard test lint types contracts tests test-slow benchmark clean

help:  ## this list
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:[^#]*##/\t/' | expand -t 16

install: $(READY)  ## virtual environment with pinned packages (in .venv)

$(READY): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "beliefgym needs Python 3.11 or newer; say make PYTHON=python3.12")'
	$(PYTHON) -m venv $(VENV)
# torch first and pinned: a CPU build lying in a folder that pip looks in is taken before the index's larger one
	$(BIN)/pip install --quiet --no-index --no-deps $(TORCH) 2>/dev/null || $(BIN)/pip install -c constraints.txt $(TORCH)
	$(BIN)/pip install --quiet -c constraints.txt --editable '.[dev]'
	@touch $(READY)

leaderboard: $(READY)  ## train, evaluate and rank the agents (TIER=standard; full takes an hour and a half)
	$(BIN)/beliefgym leaderboard --tier $(TIER)

test: lint types contracts tests  ## lint, types, import contracts and the test suite

lint: $(READY)  ## ruff
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(READY)  ## mypy
	$(BIN)/mypy

contracts: $(READY)  ## imports flow one way
	$(BIN)/lint-imports

tests: $(READY)  ## the test suite
	OMP_NUM_THREADS=1 $(BIN)/pytest -n 2 --dist worksteal

test-slow: $(READY)  ## learning tests and long comparisons
	OMP_NUM_THREADS=1 $(BIN)/pytest -n 2 --dist worksteal -m slow

benchmark: $(READY)  ## speed of the environments beside their rivals
	$(BIN)/pip install --quiet '.[rivals]' -c constraints.txt || true
	$(BIN)/beliefgym benchmark env

clean:  ## remove the virtual environment and caches
	rm -rf $(VENV) .pytest_cache .mypy_cache .ruff_cache .import_linter_cache
