# Two commands: `make demo` flies the first flight, `make test` runs the tests.
# Each installs what it needs first; see bootstrap.sh.

PYTHON ?= python3
BIN := .venv/bin

.PHONY: setup demo test test-v4l2 check audit bench attack fuzz soak clean

setup: .venv/ready .venv/kernels

.venv/ready: requirements.lock pyproject.toml bootstrap.sh
	PYTHON=$(PYTHON) sh bootstrap.sh
	touch $@

# The compiler's cache looks at a kernel's own file only, not at those of the kernels it calls.
.venv/kernels: .venv/ready $(wildcard processing/*.py processing/*/*.py processing/*/*/*.py)
	find processing -name "*.nb[ic]" -delete
	@echo "Compiling the pipeline's kernels, so that nothing compiles in flight"
	$(BIN)/syntopic kernels
	touch $@

demo: setup
	$(BIN)/syntopic demo

# Whole flights run in real time and have the right of way (tests/conftest.py).
test: setup
	$(BIN)/python -m pytest -n 3 --dist loadfile --no-loadscope-reorder

# V4L2 heads and pulses per second against the real kernel, in a virtual machine; REQUIRED=--required where skipping is no
# answer.
test-v4l2: .venv/ready
	sh bootstrap.sh --machine
	$(BIN)/python -m tests.kernel.machine $(REQUIRED)

check: .venv/ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python -m tests.licences
	$(BIN)/python -m tests.audit

# Known vulnerabilities of what is pinned; unlike in `check`, a database out of reach is a failure.
audit: setup
	$(BIN)/python -m tests.audit --required

bench: setup
	$(BIN)/python -m benchmarks.mini

# The long form of what `make test` has in short.
attack: setup
	SYNTOPIC_ATTACKED_EXPOSURES=32 $(BIN)/python -m pytest -m attack --timeout=900 -s

# Until 30 CPU minutes bring no new edge, parser by parser: many hours. It goes on where it was ended.
fuzz: setup
	$(BIN)/python -m pip install -q --require-hashes -r requirements-fuzz.lock
	$(BIN)/python -m tests.fuzz all --quiet-minutes 30 --seconds 60 --work .fuzz

soak: setup
	$(BIN)/python -m pytest -m soak --timeout=7200

clean:
	rm -rf .venv build dist flights
