# `make demo` on a fresh machine with git, make and Python 3.11 or newer: environment, two runs, reports.
SHELL := /bin/bash
.SHELLFLAGS := -eu -o pipefail -c
.DEFAULT_GOAL := help

PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.softloop-is-installed
SOURCES := wire dynamics devices plant controller watch offline deploy tests benchmarks docs

CHROMIUM ?= /usr/bin/chromium

.PHONY: help setup demo docs test exact test-page test-docs test-long test-rerun test-net kill mutate fuzz monitor rearm flood lint lock clean

help:
	@echo 'make demo   set up, then run the two demonstration trajectories on the simulated rig'
	@echo 'make test   set up, then all tests'
	@echo 'make exact  set up, then the three exactness contracts for every law, with both cores kept busy'
	@echo 'make test-page  the live page in a real browser (Debian: apt install chromium)'
	@echo 'make test-long  whole rigs on several hosts, over TLS, several at once, under the doctor'
	@echo 'make test-net   a rig on three hosts in network namespaces, with delay, loss and cut cables (root); NET=--full: all of it'
	@echo 'make test-docs  every command of the documentation, run'
	@echo 'make test-rerun  logs in the reader of rerun, which is installed for it'
	@echo 'make docs   the documentation as pages, in docs/_build/html'
	@echo 'make kill, make mutate, make fuzz, make monitor, make rearm, make flood   the long campaigns, see docs/campaigns.md'
	@echo 'make lint   ruff, mypy and the rules of who may import whom'
	@echo 'make lock   compute requirements.lock again from pyproject.toml'
	@echo 'make clean  remove the environment, caches and built files; runs/ stays'

setup: $(STAMP)

# Everything by hash; then softloop itself, editable, built with the locked setuptools.
$(STAMP): requirements.lock pyproject.toml
	@test -n '$(PYTHON)' && '$(PYTHON)' -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
		|| { echo 'make: Python 3.11 or newer is needed, as python3.11 or python3 (or make PYTHON=...)' >&2; exit 3; }
	test -x $(BIN)/python || '$(PYTHON)' -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --editable .
	@touch $@

# On a machine that stands still for longer than the gate waits a run ends in a FAULT, as it must (exit code 1): then once more.
demo: $(STAMP)
	$(BIN)/softloop warm
	@for bench in sim sim_t2; do for try in 1 2 3; do \
		code=0; $(BIN)/softloop run $$bench || code=$$?; \
		test $$code -eq 1 -a $$try -lt 3 || break; \
		echo "make: try $$try of 3 of $$bench did not reach its end; again" >&2; \
	done; test $$code -eq 0 || exit $$code; done

# Three at a time, by file, for many wait for processes; those of a whole rig come last and one at a time: they need the machine for themselves.
test: $(STAMP)
	$(BIN)/softloop warm
	$(BIN)/python -m pytest -n 3 --dist loadfile -m 'not rig and not exact and not page and not commands and not long and not rerun and not net'
	$(BIN)/python -m pytest -m 'rig and not page and not long'

# The live page in Debian's chromium, a whole rig behind it in the last tests; other browsers by CHROMIUM=PATH.
test-page: $(STAMP)
	@test -x '$(CHROMIUM)' || { echo 'make: no browser at $(CHROMIUM); install chromium, or make CHROMIUM=PATH' >&2; exit 3; }
	$(BIN)/softloop warm
	$(BIN)/python -m pytest tests/page --chromium '$(CHROMIUM)'

# The long campaigns: counts on the screen, JSON under build/campaigns, exit code 1 on a failure. A hundredth of each is in `test`.
kill: $(STAMP)
	$(BIN)/softloop warm
	$(BIN)/python -m tests.campaigns.kill

mutate: $(STAMP)
	$(BIN)/python -m tests.campaigns.mutate

fuzz: $(STAMP)
	$(BIN)/softloop warm
	$(BIN)/python -m tests.campaigns.fuzz

monitor: $(STAMP)
	$(BIN)/softloop warm
	$(BIN)/python -m tests.campaigns.monitor

rearm: $(STAMP)
	$(BIN)/softloop warm
	$(BIN)/python -m tests.campaigns.rearm

flood: $(STAMP)
	$(BIN)/softloop warm
	$(BIN)/python -m tests.campaigns.flood

exact: $(STAMP)
	$(BIN)/softloop warm
	$(BIN)/python -m pytest -m exact

# Whole rigs on several hosts, over TLS, several at once, and under the doctor's eyes.
test-long: $(STAMP)
	$(BIN)/softloop warm
	$(BIN)/python -m pytest -m long

# Logs in rerun's own reader. Its library is not locked: 670 MB unpacked, and nothing of softloop needs it.
test-rerun: $(STAMP)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-build-isolation --editable '.[rerun]'
	$(BIN)/python -m pytest -m rerun tests/offline/test_rerun.py

# Three computers of namespaces, a network between them that delays and loses. Needs root: else one line, and exit code 3 of the
# program, which make shows as its own 2.
test-net: $(STAMP)
	@$(BIN)/python -m tests.net.needs
	$(BIN)/softloop warm
	$(BIN)/python -m pytest -m net tests/net
	$(BIN)/python -m tests.net $(NET)

# Every command that the documentation shows, run as it stands there, but shorter.
test-docs: $(STAMP)
	$(BIN)/softloop warm
	$(BIN)/python -m pytest -m commands

# Warnings are errors.
docs: $(STAMP)
	$(BIN)/python -m sphinx -W --keep-going -q -b html docs docs/_build/html
	@echo 'docs/_build/html/index.html'

lint: $(STAMP)
	$(BIN)/ruff check $(SOURCES)
	$(BIN)/ruff format --check $(SOURCES)
	$(BIN)/mypy
	$(BIN)/lint-imports

lock: $(STAMP)
	test -x $(BIN)/uv || $(BIN)/python -m pip install --quiet --disable-pip-version-check uv
	$(BIN)/uv pip compile --quiet --universal --generate-hashes --no-emit-index-url --no-header \
		--extra dev --extra docs --extra foxglove --output-file requirements.lock pyproject.toml

clean:
	rm -rf $(VENV) build dist docs/_build docs/generated .mypy_cache .ruff_cache .pytest_cache .import_linter_cache .hypothesis src/*.egg-info
	find $(SOURCES) -name __pycache__ -type d -prune -exec rm -rf {} +
