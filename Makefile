# Two commands do everything on a fresh machine with Python 3.11, make and git: `make hold` and `make test`.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
# A test starts hundreds of processes: without bytecode each would compile every module again.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: hold test paper board board-fuzz board-hold rest lint types kernels fast real_time unit shake docs notebooks pictures bench benches campaign fuzz mutants generate container release-check clean
.DEFAULT_GOAL := test

$(STAMP): pyproject.toml requirements.lock
	$(PYTHON) -c 'import sys; sys.exit(0 if sys.version_info >= (3, 11) else "Python 3.11 or newer is needed: make PYTHON=python3.11 ...")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check --constraint requirements.lock --editable '.[dev]'
	touch $@

hold: $(STAMP)  ## hold the simulated mirror for two minutes, with the console
	$(BIN)/membrane-ctrl hold --twin --duration 2m --name demo

test: $(STAMP)  ## everything CI runs
	$(MAKE) --jobs 2 --output-sync lint kernels
	$(MAKE) --jobs 3 --output-sync real_time rest

rest: $(STAMP)  # beside the real-time tests, which wait half of the time: uses the CPU time that they leave
	nice -n 19 $(MAKE) types fast

lint: $(STAMP)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/vulture
	$(BIN)/python -m tests.lint.package_order
	$(BIN)/python -m tests.lint.text_decisions
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet --strict

docs: $(STAMP)  ## the documentation as a site, on http://127.0.0.1:8000
	$(BIN)/mkdocs serve

types: $(STAMP)
	$(BIN)/mypy

kernels: $(STAMP)  # compiled first, so that real-time tests do not wait for it
	rm -rf build/kernels
	$(BIN)/membrane-ctrl simulate build/kernels --shrink 12
	$(BIN)/membrane-ctrl measure build/kernels --no-pictures

# a worker takes whole files, the longest first (tests/support/file_order.py)
BY_FILE := --dist loadfile --no-loadscope-reorder
# per worker: more threads would only wait for each other
fast real_time: export OPENBLAS_NUM_THREADS = 1
fast: $(STAMP)
	$(BIN)/pytest -m "not campaign and not real_time" -n 2 $(BY_FILE)

real_time: $(STAMP)  # named, because collecting the other files takes each worker 15 s
	$(BIN)/pytest -m "real_time and not campaign" -n 2 $(BY_FILE) $$(grep -rlw real_time tests --include='test_*.py')

unit: fast real_time

shake: $(STAMP)  ## the same tests on a machine that pauses for a second, again and again; SEED=2 for other moments
	$(BIN)/python tests/shake.py --seed $(or $(SEED),1) $(MAKE) unit

paper: $(STAMP)  ## each figure and table of the paper, computed again: build/paper/paper.html and .pdf
	$(BIN)/membrane-ctrl paper --out build/paper

pictures: $(STAMP)  ## takes the pictures of README and documentation; ONLY='run-*' for some of them
	$(BIN)/python -m tests.support.pictures $(ONLY)

bench: $(STAMP)  ## measured figures, each against a reference of the same run
	$(BIN)/python -m benchmarks

benches: $(STAMP)  ## 500 random benches of the second world, resumable: docs/measurements/second-world.md; COUNT=50 for fewer
	OPENBLAS_NUM_THREADS=1 nice -n 15 $(BIN)/python -m benchmarks.metrology.second_world $(or $(COUNT),500)

campaign: $(STAMP)  ## all faults, in virtual time and with real processes; docs/measurements/fault-matrix.md, sensor-faults.md
	$(BIN)/pytest -m campaign
	rm -f build/sensor-faults.jsonl
	$(BIN)/python tests/campaign/sensor_faults_page.py

mutants: $(STAMP)  ## code made wrong on purpose: what the fast tests notice, and what the campaign alone; under an hour
	$(BIN)/python tests/mutants/mutants.py
	$(BIN)/python tests/mutants/numerics.py

BOARD := $(MAKE) --no-print-directory -C firmware_iface/board PYTHON=$(CURDIR)/$(BIN)/python OUT=$(CURDIR)/build/board

board: $(STAMP)  ## the pump board's firmware: analysed, built, tested on the host and in QEMU, fuzzed; installs its tools
	$(BOARD) tools
	$(BOARD) check all
	rm -rf build/board/covered
	BOARD_BUILD=$(CURDIR)/build/board/covered EXTRA=--coverage $(BIN)/pytest tests/board -m "campaign or not campaign"
	gcovr --root firmware_iface/board --filter firmware_iface/board/core --fail-under-line 95 build/board/covered
	$(BOARD) fuzz RUNS=20000

board-fuzz: $(STAMP)  ## ten million mutated frames into the firmware; some minutes
	$(BOARD) tools fuzz RUNS=1000000

board-hold: $(STAMP)  ## the twin's film held for ten minutes by the firmware in QEMU, then by the Python board
	$(BOARD) tools
	BOARD_HOLD_S=600 $(BIN)/pytest -rP tests/board/test_board_hold.py

fuzz: $(STAMP)  ## mutated run folders and capture sets through every command that reads them (20 minutes)
	$(BIN)/python tests/fuzz/fuzz_folders.py

generate: $(STAMP)  ## the files made from registers.toml, the tables of safety, events and telemetry, and the configuration's schema
	$(BIN)/python -m firmware_iface.generate
	$(BIN)/python -m tests.support.faults_page
	$(BIN)/python -m tests.support.events_page
	$(BIN)/python -m tests.support.telemetry_pages
	$(BIN)/membrane-ctrl config reference > docs/reference/configuration.md

notebooks: $(STAMP)  ## runs docs/notebooks and stores what they print and draw
	$(BIN)/python -m tests.support.notebooks

container: $(STAMP)  ## the image of the Containerfile; WAY=chroot where containers cannot be built
	packaging/container.sh $(or $(WAY),image)

release-check: $(STAMP)  ## the release checklist: tests, campaign, mutants, licences, vulnerabilities, build; hours
	$(BIN)/python -m tests.support.release_check

clean:
	rm -rf $(VENV) .mypy_cache .ruff_cache
