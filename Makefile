# make demo and make test set everything up themselves: a virtual environment in .venv, from python3 (PYTHON=… for another).
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
JOBS ?= 3
SECONDS ?= 600
MINUTES ?= 60
RATE ?= 0.1
SEEDS ?= 5
PYTEST := $(BIN)/python -m pytest -p no:cacheprovider

DESTDIR ?=
PREFIX ?= /opt/swath

MAKEFLAGS += --no-print-directory
unexport PYTHONDONTWRITEBYTECODE
export PIP_DISABLE_PIP_VERSION_CHECK := 1
export PIP_ROOT_USER_ACTION := ignore

.DEFAULT_GOAL := help
.PHONY: help demo test test-slow test-peers test-vm test-vm-long test-arm64 test-long soak soak-short fuzz lint ready bench bench-calibration install uninstall clean

help: ## say what there is to make
	@grep -hE '^[a-z0-9-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z0-9-]+):.*## (.*)/  make \1\t\2/' | expand -t 20

demo: $(VENV)/.flies ## play real recordings, then a virtual flight, through real wires into a recorder, about 2 min
	@$(BIN)/python -m demo

test: $(VENV)/.tests $(VENV)/.tools ## install and run: style, types, import rules, tests
	@$(MAKE) -j 2 --output-sync=target lint ready
	$(PYTEST) -n $(JOBS) --dist loadgroup -m "not slow and not long and not alone and not peers"
	$(PYTEST) -n 0 -m "alone and not slow and not long"

test-slow: $(VENV)/.tests $(VENV)/.tools ready ## the tests that take longer: whole flights, calibrated; the demo, the installation
	$(PYTEST) -n $(JOBS) --dist loadgroup -m "slow and not long and not alone and not peers"
	$(PYTEST) -n 0 -m "alone and slow and not long"

test-peers: $(VENV)/.tests ## beside gpsd and Foxglove's reader, which it installs (root, apt, npm)
	@for program in gpsd npm; do command -v $$program >/dev/null || \
		{ apt-get -qq update && apt-get -qq install -y --no-install-recommends $$program >/dev/null; } || exit; done
	npm ci --silent --no-audit --no-fund --prefix tests/peers
	$(PYTEST) -n 0 -v tests/peers

test-vm: $(VENV)/.tests ## on real CAN, PPS, systemd and power cuts, in a virtual machine that it installs (root, apt, alone)
	@bash tests/vm/setup.sh
	$(BIN)/python -m tests.vm -m "not long"

test-vm-long: $(VENV)/.tests ## the same with 50 power cuts and three minutes of flight
	@bash tests/vm/setup.sh
	$(BIN)/python -m tests.vm

test-arm64: $(VENV)/.tests ## decoders, log and points on an emulated ARM64, which it installs (root, apt): the same as here
	@bash tests/arm64/setup.sh $(VENV)
	$(PYTEST) -n 0 -v tests/arm64
	tests/arm64/.cache/venv/bin/python -m tests.arm64 -n $(JOBS) --dist loadgroup

test-long: $(VENV)/.tests $(VENV)/.tools ## the tests that take minutes
	$(PYTEST) -n 0 -m long

soak: $(VENV)/.tests ## two hours of all kinds of sensors at their full rates (root, for the buffers; alone)
	$(BIN)/python -m benchmarks.soak --minutes 120 --rate 1

soak-short: $(VENV)/.tests ## an hour of all kinds of sensors at a tenth of their rate (MINUTES=, RATE=)
	$(BIN)/python -m benchmarks.soak --minutes $(MINUTES) --rate $(RATE)

fuzz: $(VENV)/.tests ## inputs nobody would send, to every parser and reader: SECONDS=600 each, TARGETS=… for some, GUIDED=1 by coverage
	@if [ -n "$(GUIDED)" ]; then $(BIN)/python -m pip install -q 'atheris>=2.3'; fi
	@$(BIN)/python -m tests.fuzz --seconds $(SECONDS) $(if $(GUIDED),--guided) $(TARGETS)

lint: $(VENV)/.tests ## style, import rules and types only
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports --no-cache
	MYPY_NUM_WORKERS=2 $(BIN)/mypy

# what each worker would do for itself: loops compiled by numba, tests by Python
ready: $(VENV)/.tests
	$(BIN)/python -m swath.daemon.cli.main warm-up
	@folder=$$(mktemp -d) && $(BIN)/python -m swath.daemon.cli.main sim fly small --seconds 14 -o $$folder >/dev/null; rm -r $$folder
	@$(PYTEST) -n 0 -q --collect-only >/dev/null || true

bench: $(VENV)/.tests ## measure speed, each figure beside this machine's own limit
	$(BIN)/python -m benchmarks

bench-calibration: $(VENV)/.tests ## five whole calibration flights from their logs alone, truth known, about 40 min (SEEDS=)
	$(BIN)/python -m benchmarks.calibration_accuracy --seeds $(SEEDS)

install: ## install the service (root; DESTDIR= and PREFIX= are honoured)
	@DESTDIR="$(DESTDIR)" PREFIX="$(PREFIX)" sh systemd/install.sh install

uninstall: ## remove what install put there; configuration and logs stay
	@DESTDIR="$(DESTDIR)" PREFIX="$(PREFIX)" sh systemd/install.sh uninstall

clean: ## remove the virtual environment and everything built
	rm -rf $(VENV) build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# ---- set-up, each step once; a change of pyproject.toml repeats it

$(VENV)/bin/python:
	@sh systemd/setup.sh venv "$(PYTHON)" "$(VENV)"

$(VENV)/.flies: pyproject.toml | $(VENV)/bin/python
	@sh systemd/setup.sh pip "$(VENV)" '.[sim]'
	@touch $@

$(VENV)/.tests: pyproject.toml | $(VENV)/bin/python
	@sh systemd/setup.sh pip "$(VENV)" '.[test]'
	@touch $@ $(VENV)/.flies

# the units and rules are tested with systemd's own tools, PDF with Pango
$(VENV)/.tools: | $(VENV)/bin/python
	@sh systemd/setup.sh tools
	@touch $@
