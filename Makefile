# make demo and make test set everything up themselves: a virtual environment in .venv, from python3 (PYTHON=… for another).
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
JOBS ?= 3
SECONDS ?= 600
MINUTES ?= 60
RATE ?= 0.1
SEEDS ?= 5
# how workers share the tests: tests/conftest.py says which belong together, and which begin
SHARED := --dist loadgroup --no-loadscope-reorder
# WITHOUT: a mark whose tests test-slow leaves out. RESULTS: a folder for a JUnit file of each run, which .ci/run sums up
PYTEST = $(BIN)/python -m pytest -p no:cacheprovider $(if $(RESULTS),--junitxml=$(RESULTS)/$@$(1).xml)

DESTDIR ?=
PREFIX ?= /opt/swath

MAKEFLAGS += --no-print-directory
unexport PYTHONDONTWRITEBYTECODE
export PIP_DISABLE_PIP_VERSION_CHECK := 1
export PIP_ROOT_USER_ACTION := ignore

.DEFAULT_GOAL := help
.PHONY: help demo test test-slow test-computing test-peers pictures test-vm test-vm-services test-vm-times test-vm-long test-arm64 test-long soak soak-short fuzz lint ready programs for-tiers for-peers for-vm bench bench-calibration install uninstall clean

help: ## list the targets
	@grep -hE '^[a-z0-9-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z0-9-]+):.*## (.*)/  make \1\t\2/' | expand -t 26

demo: $(VENV)/.flies ## record real recordings and a simulated flight over real wires, show the console, make points and a page (about 3 min)
	@$(BIN)/python -m demo

test: $(VENV)/.tests $(VENV)/.tools ## install what they need, then run style, types, import rules and tests
	@$(MAKE) -j 2 --output-sync=target lint ready
	$(PYTEST) -n $(JOBS) $(SHARED) -m "not slow and not long and not alone and not peers"
	$(call PYTEST,-alone) -n 0 -m "alone and not slow and not long"

test-slow: $(VENV)/.tests $(VENV)/.tools ready ## run the longer tests: whole flights and calibrations, the demo, the installation
	$(PYTEST) -n $(JOBS) $(SHARED) -m "slow and not long and not alone and not peers$(if $(WITHOUT), and not $(WITHOUT))"
	$(call PYTEST,-alone) -n 0 -m "alone and slow and not long"

test-computing: $(VENV)/.tests ready ## run those of test-slow that only compute, and so may run beside anything
	$(PYTEST) -n $(JOBS) $(SHARED) -m "computing and not long and not alone"

test-peers: $(VENV)/.tests for-peers ## run the tests against gpsd, Foxglove's reader and Chromium, which it installs (root, apt, npm)
	$(PYTEST) -n 0 -v tests/peers

pictures: $(VENV)/.tests for-peers ## make the pictures of docs/console.md again, by Chromium (3 min)
	$(BIN)/python -m tests.peers.console_pictures

test-vm: test-vm-services test-vm-times ## run the tests of CAN, PPS, systemd and power cuts in a virtual machine, which it installs (root, apt, alone)

test-vm-services: $(VENV)/.tests for-vm
	$(PYTEST) -n 0 -v -m "not alone and not long" tests/vm

test-vm-times: $(VENV)/.tests for-vm
	$(PYTEST) -n 0 -v -m "alone and not long" tests/vm

test-vm-long: $(VENV)/.tests for-vm ## run the same with 50 power cuts, 20 kills of the console and three minutes of flight
	$(PYTEST) -n 0 -v tests/vm

test-arm64: $(VENV)/.tests ## compare decoders, log and points with an emulated ARM64, which it installs (root, apt)
	@bash tests/arm64/setup.sh $(VENV)
	$(PYTEST) -n 0 -v tests/arm64
	tests/arm64/.cache/venv/bin/python -m tests.arm64 -n $(JOBS) $(SHARED)

test-long: $(VENV)/.tests $(VENV)/.tools ## run the tests that take minutes each
	$(PYTEST) -n 0 -m long

soak: $(VENV)/.tests ## record all kinds of sensors at full rate for two hours (root, for the buffers; alone)
	$(BIN)/python -m benchmarks.soak --minutes 120 --rate 1

soak-short: $(VENV)/.tests ## record all kinds of sensors at a tenth of their rate for an hour (MINUTES=, RATE=)
	$(BIN)/python -m benchmarks.soak --minutes $(MINUTES) --rate $(RATE)

fuzz: $(VENV)/.tests ## fuzz every parser and reader (SECONDS=600 each, TARGETS=… for some, GUIDED=1 by coverage)
	@if [ -n "$(GUIDED)" ]; then $(BIN)/python -m pip install -q 'atheris>=2.3'; fi
	@$(BIN)/python -m tests.fuzz --seconds $(SECONDS) $(if $(GUIDED),--guided) $(TARGETS)

lint: $(VENV)/.tests ## check style, import rules and types only
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports --no-cache
	MYPY_NUM_WORKERS=2 $(BIN)/mypy

# what each worker would do for itself: loops compiled by numba, tests by Python
ready: $(VENV)/.tests
	$(BIN)/python -m swath.daemon.cli.main warm-up
	@folder=$$(mktemp -d) && $(BIN)/python -m swath.daemon.cli.main sim fly small --seconds 14 -o $$folder >/dev/null; rm -r $$folder
	@$(BIN)/python -m pytest -p no:cacheprovider -n 0 -q --collect-only >/dev/null || true

# what all tiers need; apt and pip install beside each other
programs: $(VENV)/.tests for-tiers
	@$(BIN)/python -m tests.vm.installed

for-tiers: $(VENV)/.tools
	@$(MAKE) for-peers && $(MAKE) for-vm

for-peers:
	@for program in gpsd npm chromium; do command -v $$program >/dev/null || \
		{ apt-get -qq update && apt-get -qq install -y --no-install-recommends $$program >/dev/null; } || exit; done
	npm ci --silent --no-audit --no-fund --prefix tests/peers

for-vm:
	@bash tests/vm/setup.sh

bench: $(VENV)/.tests ## measure speed, and compare each figure with the limit of this computer
	$(BIN)/python -m benchmarks

bench-calibration: $(VENV)/.tests ## calibrate five simulated flights and compare with the truth, about 40 min (SEEDS=)
	$(BIN)/python -m benchmarks.calibration.accuracy --seeds $(SEEDS)

install: ## install the service (root; DESTDIR=, PREFIX=)
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
	@sh systemd/setup.sh pip "$(VENV)" '.[sim,process,live,console]'
	@touch $@

$(VENV)/.tests: pyproject.toml | $(VENV)/bin/python
	@sh systemd/setup.sh pip "$(VENV)" '.[test]'
	@touch $@ $(VENV)/.flies

# the units and rules are tested with systemd's own tools, PDF with Pango
$(VENV)/.tools: | $(VENV)/bin/python
	@sh systemd/setup.sh tools
	@touch $@
