# `make demo` and `make test` do all the set-up; a second run starts at once.

VENV := .venv
BIN := $(VENV)/bin
# the first interpreter that is new enough
FIND_PYTHON = for p in $(PYTHON) python3 python3.14 python3.13 python3.12 python3.11 python; do \
  command -v $$p >/dev/null 2>&1 \
  && $$p -c 'import sys, venv, ensurepip; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1 \
  && echo $$p && exit 0; done; \
  echo "no Python 3.11 or newer with venv: install one, or say make PYTHON=/path/to/python3" >&2; exit 1
PYTEST_FLAGS ?= -n 2 --dist worksteal -q
SOURCES := sysid_btr reference_simulator tests benchmarks sample_logs notebooks docs

.PHONY: demo test quick lint types check notebooks docs dev format clean

demo: $(VENV)/installed
	$(BIN)/sysid-btr demo

test: dev lint types check

# what takes less than two minutes on two cores
quick: lint types
	$(BIN)/python -m pytest $(PYTEST_FLAGS) -m "not slow"

dev: $(VENV)/installed-dev

lint: $(VENV)/installed-dev
	$(BIN)/ruff check $(SOURCES)
	$(BIN)/ruff format --check --quiet $(SOURCES)
	$(BIN)/lint-imports --no-logo

types: $(VENV)/installed-dev
	$(BIN)/mypy

# each worker simulates on threads of its own: threads of BLAS beside them only wait for each other
check quick notebooks docs: export OPENBLAS_NUM_THREADS := 1

# notebooks are executed in copies that keep their outputs: `make docs` shows them
EXECUTE = rm -rf executed && mkdir executed && cp notebooks/*.ipynb executed

# the notebooks first, each is long: one at the end would leave the other worker without work
check: $(VENV)/installed-dev
	$(EXECUTE)
	$(BIN)/python -m pytest $(PYTEST_FLAGS) --nbmake --overwrite executed tests

notebooks: $(VENV)/installed-dev
	$(EXECUTE)
	$(BIN)/python -m pytest --nbmake --overwrite -p no:warnings -q executed

docs: $(VENV)/installed-dev
	$(BIN)/python docs/build.py

format: $(VENV)/installed-dev
	$(BIN)/ruff check --fix $(SOURCES)
	$(BIN)/ruff format $(SOURCES)

clean:
	rm -rf $(VENV) demo_out docs/html dist executed .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
	find $(SOURCES) -name '*.nb[ci]' -delete

$(VENV)/bin/python:
	python=$$($(FIND_PYTHON)) && $$python -m venv $(VENV)

$(VENV)/installed: pyproject.toml | $(VENV)/bin/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable .
	touch $@

$(VENV)/installed-dev: pyproject.toml | $(VENV)/bin/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev]'
	touch $(VENV)/installed $@
