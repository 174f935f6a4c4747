# Two commands: `make demo` flies the first flight, `make test` runs the tests.
# Each installs what it needs first; see bootstrap.sh.

PYTHON ?= python3
BIN := .venv/bin

.PHONY: setup demo test check bench soak clean

setup: .venv/ready

.venv/ready: requirements.lock pyproject.toml bootstrap.sh
	PYTHON=$(PYTHON) sh bootstrap.sh
	touch $@

demo: setup
	$(BIN)/syntopic demo

test: setup
	$(BIN)/python -m pytest

check: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

bench: setup
	$(BIN)/python -m benchmarks.mini

soak: setup
	$(BIN)/python -m pytest -m soak --timeout=7200

clean:
	rm -rf .venv build dist flights
