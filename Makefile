# make demo | test | lint: each builds .venv first when it is missing or its requirements changed.
# Needs Python 3.11-3.14 and make, nothing else.  PYTHON=/path/to/python chooses the interpreter.

.SHELLFLAGS := -ec
.DEFAULT_GOAL := help

VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
WORKERS ?= 2
OUT ?= out/demo
PART ?=
RECORDINGS ?=

# The first interpreter that really runs (version managers leave shims that do not), is in range and can make a venv.
CANDIDATES := python3.11 python3.12 python3.13 python3.14 python3
PYTHON ?=

.PHONY: help demo test test-slow coverage additions faults fuzz mutants chaos lint format docs pictures install venv clean

help:
	@echo "make demo       map an apartment, run five agents on it, write a report under $(OUT)"
	@echo "make test       the test suite without the slow tests (WORKERS=$(WORKERS) processes)"
	@echo "make test-slow  the slow tests: sweeps, long tracks, statistical claims; PART=1/3: a third of the files"
	@echo "make coverage   make test, and the share of lines that it runs; fails below the floor in pyproject.toml"
	@echo "make additions  take out a sensor, a metric, a planner, a robot in turn: the rest must pass"
	@echo "make faults     faulty images for SLAM and agents; RECORDINGS=DIR adds TUM folders to the simulated walks"
	@echo "make chaos      kill commands at random moments, fill their disks, start them twice (about half an hour)"
	@echo "make fuzz       10,000 damaged files for every reader: each is read or refused within bounds (30 min)"
	@echo "make mutants    put errors of the science into a copy, one at a time: its tests must fail (about half an hour)"
	@echo "make lint       ruff (rules and format) and mypy"
	@echo "make format     rewrite the code as ruff wants it"
	@echo "make docs       the documentation as a static site under site/, without network (two minutes)"
	@echo "make pictures   the moving pictures of the environments' pages (ten minutes)"
	@echo "make clean      remove .venv, caches and build products"

install: $(STAMP)

venv:
	@chosen=""; \
	for python in $(or $(PYTHON),$(CANDIDATES)); do \
	  if "$$python" -c 'import sys, venv, ensurepip; sys.exit(not (3, 11) <= sys.version_info < (3, 15))' >/dev/null 2>&1; \
	  then chosen="$$python"; break; fi; \
	done; \
	if [ -z "$$chosen" ]; then \
	  echo "error: no working Python 3.11-3.14 with venv among: $(or $(PYTHON),$(CANDIDATES)); set PYTHON=" >&2; exit 1; \
	fi; \
	if ! $(BIN)/python -m pip --version >/dev/null 2>&1; then \
	  echo "creating $(VENV) with $$chosen ($$("$$chosen" --version))"; "$$chosen" -m venv --clear $(VENV); \
	fi

$(STAMP): constraints.txt pyproject.toml Makefile
	@$(MAKE) --no-print-directory venv
	@echo "installing into $(VENV) (two to four minutes)"
	@extras=dev,rl,dynamics,datasets,docs,cluster; \
	if $(BIN)/python -c 'import sys; sys.exit(sys.version_info[:2] != (3, 11))'; then extras=$$extras,bullet; \
	else echo "no PyBullet: it has a wheel for Python 3.11 only; physics=\"bullet\" and its tests need it"; fi; \
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-input -c constraints.txt \
	  --config-settings editable_mode=compat -e ".[$$extras]"  # found before a folder vssm_gym of the working directory
	@touch $@

demo: $(STAMP)
	$(BIN)/vssm-gym demo --out $(OUT) --resume

test: $(STAMP)
	$(BIN)/python -m pytest -m "not slow" -n $(WORKERS) --dist loadfile  # a file's fixtures and compilations: once

test-slow: $(STAMP)
	$(BIN)/python -m pytest -m slow -n $(WORKERS) $(if $(PART),--part $(PART))

# Python 3.12 and later report lines at next to no cost; before, a tracer in C follows every call.
coverage: $(STAMP)
	$(BIN)/coverage erase
	COVERAGE_CORE=$$($(BIN)/python -c 'import sys; print("sysmon" if sys.version_info >= (3, 12) else "ctrace")') \
	  $(BIN)/coverage run -m pytest -m "not slow" -n $(WORKERS) --dist loadfile
	$(BIN)/coverage combine --quiet
	$(BIN)/coverage report

additions: $(STAMP)
	$(BIN)/python tests/remove_additions.py

fuzz: $(STAMP)
	$(BIN)/python -m tests.fuzz --workers $(WORKERS)

mutants: $(STAMP)
	$(BIN)/python -m tests.mutants --workers $(WORKERS)

faults: $(STAMP)
	failed=0; $(BIN)/vssm-gym faults slam $(RECORDINGS) || failed=1; $(BIN)/vssm-gym faults navigation || failed=1; exit $$failed

chaos: $(STAMP)
	$(BIN)/python -m tests.chaos

lint: $(STAMP)
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy

format: $(STAMP)
	$(BIN)/ruff check --fix
	$(BIN)/ruff format

docs: $(STAMP)
	rm -rf site
	$(BIN)/python -m sphinx --quiet --fresh-env --fail-on-warning --keep-going -c docs/site -b html -d build/docs . site
	$(BIN)/python docs/site/check_links.py site

pictures: $(STAMP)
	$(BIN)/python docs/site/moving_pictures.py

clean:
	rm -rf $(VENV) site build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis .coverage .coverage.*
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
