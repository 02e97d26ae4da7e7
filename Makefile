# Everything from a bare checkout: `make demo` and `make test` build .venv first, once.
# PYTHON chooses the interpreter (3.11 or newer), VENV the environment's folder.

VENV ?= .venv
PYTHON ?= $(shell for p in python3 python3.12 python3.13 python3.11 python; do \
	$$p -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && { echo $$p; break; }; \
	done)
BIN := $(VENV)/bin
# Of what is installed: everything; what the demo, the quick core and the study of whole fingers need.
STAMP := $(VENV)/.installed
DEMO := $(VENV)/.demo
QUICK := $(VENV)/.quick
FINGER3D := $(VENV)/.finger3d
EXTRAS := notebooks,report,test,docs,dev
SHOWN := report,export
CHECKED := codesign_jax scripts tests notebooks

# What is imported is compiled once: without its bytecode every process compiles it again, for 7 s.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo docs release interpreter test quick test-browser test-ptx test-gpu test-slow stability faults notebooks benchmark effects accuracy reality finger3d lint format types clean help

help:
	@echo "make demo        co-design a gripper, 23 parameters, on the CPU, with figures and a film"
	@echo "make test        quick tests          make test-slow   whole optimisations"
	@echo "make quick       a minute of them, for another Python: PYTHON=python3.13 VENV=.venv-other MUJOCO='mujoco<4'"
	@echo "make test-gpu    the tests that need an NVIDIA GPU, GPU=file.json"
	@echo "make test-ptx    kernels for GPUs, assembled without one"
	@echo "make test-browser  report and studio in a headless Chromium"
	@echo "make stability   the hard cases and their margins, docs/notes/stability.md"
	@echo "make faults      kills, full disks, damage, hostile input: FAULTS=100"
	@echo "make notebooks   execute them         make lint types  ruff, pyright"
	@echo "make benchmark   measure rates: BENCHMARK=docs/data/rates_cpu.json"
	@echo "make effects     what each effect costs and decides: docs/effects.md"
	@echo "make reality     the simulation beside published measurements: docs/reality.md"
	@echo "make finger3d    whole fingers by finite elements in 3D, with NGSolve: docs/notes/section.md"
	@echo "make accuracy    what accuracy costs in time, and what moves a verdict"
	@echo "make docs        the documentation as a site without a network: site/index.html"
	@echo "make release     everything but the upload: wheel, sdist, an empty environment; dist/"
	@echo "make format      ruff format          make clean       remove what make built"

interpreter:
	@echo $(PYTHON)

demo: $(DEMO)
	$(BIN)/python -m scripts.demo

# Programs and kernels of the tests stay for the next run: each belongs to the code that made it.
# Their folder has no limit of size, which JAX keeps by reading a file of each program whenever it
# writes another, for a fifth of the tests' time; what is a week old goes before the tests.
TESTS_CACHE := $(abspath $(VENV))/tests-cache
JAX_COMPILATION_CACHE_DIR ?= $(TESTS_CACHE)
test: export JAX_COMPILATION_CACHE_DIR := $(JAX_COMPILATION_CACHE_DIR)
test: $(STAMP)
	@mkdir -p $(TESTS_CACHE) && find $(TESTS_CACHE) -type f -mtime +7 -delete
	$(BIN)/python -m pytest -q -n 2 --dist loadfile --no-loadscope-reorder --durations=10

# The quick core: a minute for another Python and MuJoCo, in an environment of its own.
CORE := scene parameters optimizers compiler planted_faults codesign runs
WORKERS ?= 2
quick: $(QUICK)
	$(BIN)/python -m pytest -q -n $(WORKERS) --dist loadfile $(CORE:%=tests/test_%.py)

# What needs a browser: the report, its 3D replay, the studio and the documentation's site.
test-browser: docs
	$(BIN)/python -m pytest -q -m browser -rs $$(grep -l mark.browser tests/test_*.py)

# Kernels of the default scene for GPUs by NVIDIA's assembler, without a GPU: a minute of one core.
test-ptx: $(STAMP)
	$(BIN)/python -m pytest -q -rs -m slow tests/test_reverse.py -k "assembler and paper and not spheres"

# Tests that need a GPU; GPU is the file that says how each ended.
GPU ?= runs/gpu_suite.json
test-gpu: $(STAMP)
	mkdir -p $(dir $(GPU))
	$(BIN)/python -m scripts.gpu_suite --json $(GPU) $(ARGS)

# About 22 minutes on two idle cores.
test-slow: $(STAMP)
	$(BIN)/python -m pytest -q -m "slow and not gpu" -n 2 --dist loadfile --durations=10

# All hard cases; their margins go to docs/notes/stability.md.
stability: $(STAMP)
	$(BIN)/python -m pytest -q tests/stability -m stability --stability-table docs $(ARGS)

# Needs Linux and a C compiler. FAULTS is about the number of cases of each kind.
FAULTS ?= 10
faults: $(STAMP)
	FAULTS=$(FAULTS) nice -n 5 $(BIN)/python -m pytest -q scripts/faults.py $(ARGS)

notebooks: $(STAMP)
	$(BIN)/python -m scripts.run_notebooks --workers $(WORKERS)

# Whole grasps of all engines; a file that exists is extended.
BENCHMARK ?= runs/rates.json
benchmark: $(STAMP)
	$(BIN)/python -m scripts.benchmark --json $(BENCHMARK) $(ARGS)

# About 15 minutes on two idle cores.
effects: $(STAMP)
	$(BIN)/python -m scripts.effects $(ARGS)

# Tables and figures of docs/reality.md, and the silicones of docs/measurements.md.
reality: $(STAMP)
	$(BIN)/python -m scripts.reality --pages $(ARGS)

# About 20 minutes on two idle cores; goes on where it stopped. No other target needs NGSolve.
finger3d: export OPENBLAS_NUM_THREADS := 1
finger3d: $(FINGER3D)
	printf '1/2\n2/2\n' | xargs -P 2 -I{} $(BIN)/python -m scripts.section.finger3d --share {}
	$(BIN)/python -m scripts.section.finger3d --merge --report

# Hours of a GPU and its host; goes on where it stopped. Then ARGS="--merge FILE", "--merge FILE --report".
accuracy: $(STAMP)
	$(BIN)/python -m scripts.accuracy $(ARGS)

# With --quiet a broken link would not be an error.  NO_MKDOCS_2_WARNING: a notice of mkdocs-material.
docs: $(STAMP)
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict
	@echo "site/index.html opens in a browser as it is"

# Downloads all dependencies once more, for the empty environment.
release: $(STAMP)
	$(BIN)/python -m scripts.release

lint: $(STAMP)
	$(BIN)/ruff check $(CHECKED)
	$(BIN)/ruff format --check $(CHECKED)

format: $(STAMP)
	$(BIN)/ruff check --fix $(CHECKED)
	$(BIN)/ruff format $(CHECKED)

# Two threads are sooner done, one takes three quarters of their work.
THREADS ?= 2
types: $(STAMP)
	$(BIN)/pyright --threads $(THREADS) --pythonpath $(BIN)/python

# Installed again only when the dependencies change. Python compiles what is imported; pip would compile everything, for 40 s.
define install
	@test -n "$(PYTHON)" || { echo "No Python 3.11 or newer found: apt-get install python3 python3-venv" >&2; exit 1; }
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV) || \
		{ echo "No venv module: apt-get install python3-venv" >&2; rm -rf $(VENV); exit 1; }
	$(BIN)/python -m pip install --no-compile --quiet --disable-pip-version-check -e '.[$(1)]' $(MUJOCO:%='%')
endef

$(STAMP): pyproject.toml
	$(call install,$(EXTRAS))
	@touch $@ $(DEMO) $(QUICK)

# What README and quickstart then use: who asks for the demo does not wait for the others.
$(DEMO): pyproject.toml
	$(call install,$(SHOWN))
	@touch $@

$(QUICK): pyproject.toml
	$(call install,quick)
	@touch $@

$(FINGER3D): pyproject.toml
	$(call install,finger3d)
	@touch $@

clean:
	rm -rf $(VENV) build dist site .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
