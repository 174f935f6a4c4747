# Two commands: `make demo` flies the first flight, `make test` runs the tests.
# Each installs what it needs first; see bootstrap.sh.

PYTHON ?= python3
BIN := .venv/bin
# Processes that run tests side by side.
WORKERS ?= 3
# Images of containers set it; every program that tests start would compile all its modules again.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: setup wheel demo test test-busy release-check test-v4l2 check audit docs bench attack fuzz
.PHONY: soak schemas clean

setup: .venv/ready .venv/kernels

.venv/ready: requirements.lock pyproject.toml bootstrap.sh
	@PYTHON=$(PYTHON) sh bootstrap.sh
	@touch $@

.venv/kernels: .venv/ready $(wildcard processing/*.py processing/*/*.py processing/*/*/*.py) \
		processing/pipelines/kernel_variants.toml
	@echo "[5/5] Compiled kernels ..."
	@$(BIN)/syntopic kernels
	@touch $@

# Browser, npm packages and other programs that only tests use.
.venv/tests: .venv/ready bootstrap.sh tests/support/npm.lock
	sh bootstrap.sh --tests
	$(BIN)/python -m tests.support.npm
	touch $@

# The wheels of Syntopic, with its manual page, and of the photographs for the emulator.
wheel: .venv/ready
	rm -rf build/lib build/man build/scenes dist
	mkdir -p build
	$(BIN)/python -m daemon.cli.man_page build/man/syntopic.1
	cp -r sim_hw/scenes build/scenes
	$(BIN)/python -m pip wheel -q --no-deps --no-build-isolation --no-index -w dist . ./build/scenes

demo: setup
	$(BIN)/syntopic demo

# Whole flights run in real time and have the right of way (tests/conftest.py). STRICT=--fail-on-skip
# where only skips of tests/support/expected_skips.toml are allowed.
test: setup .venv/tests .venv/docs
	$(BIN)/python -m pytest -n $(WORKERS) --dist loadfile --no-loadscope-reorder $(STRICT)

# The tests that need real time, five times in a row, with four busy loops next to them.
test-busy: setup .venv/tests
	$(BIN)/python -m tests.support.busy

# `make demo` and `make test` in a fresh root of each release; as root, with debootstrap.
release-check:
	$(PYTHON) -m tests.installed.release_check $(RELEASES)

# V4L2 heads and pulses per second against the real kernel, in a virtual machine;
# REQUIRED=--required where skipping is no answer.
test-v4l2: .venv/ready
	sh bootstrap.sh --machine
	@# Compiles every module that the tests import, which takes the machine's processor minutes.
	$(BIN)/python -m pytest --collect-only -qq -p no:cacheprovider tests/installed/kernel
	$(BIN)/python -m tests.installed.kernel.machine $(REQUIRED)

check: .venv/ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python -m tests.repository.licences
	$(BIN)/python -m tests.repository.audit

# JSON Schemas of rig.toml and service.toml, after a change of their keys.
schemas: .venv/ready
	$(BIN)/python -m daemon.configuration.schemas

# Known vulnerabilities of what is pinned; unlike in `check`, a database out of reach is a failure.
audit: setup
	$(BIN)/python -m tests.repository.audit --required

# The documents as a site in build/site. Once its packages are installed it needs no network.
docs: .venv/docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet
	@echo "Built build/site/index.html"

.venv/docs: .venv/ready requirements-docs.lock
	$(BIN)/python -m pip install -q --disable-pip-version-check --require-hashes -r requirements-docs.lock
	touch $@

bench: setup
	$(BIN)/python -m benchmarks.mini

# The long form of what `make test` has in short.
attack: setup .venv/tests
	SYNTOPIC_ATTACKED_EXPOSURES=32 $(BIN)/python -m pytest -m attack --timeout=900 -s

# Until 30 CPU minutes bring no new edge, parser by parser: many hours. It goes on where it was ended.
fuzz: setup
	$(BIN)/python -m pip install -q --require-hashes -r requirements-fuzz.lock
	$(BIN)/python -m tests.robustness.fuzz all --quiet-minutes 30 --seconds 60 --work .fuzz

soak: setup .venv/tests
	$(BIN)/python -m pytest -m soak --timeout=7200

clean:
	rm -rf .venv build dist flights
