# Everything from nothing but make and Python 3.11 or newer: each target builds the
# environment it needs in .venv and keeps it. `make help` lists the targets.

PYTHON ?= python3
VENV ?= .venv
TORCH ?= torch==2.13.0
JOBS ?= 2
CPU_BACKENDS ?= numpy,numpy:readonly,strict,strict:device1,torch:cpu
GPU_BACKENDS ?= torch:cuda
# JAX compiles every operation for every shape: its run takes the kernels, and the public
# functions against NumPy, not every shape of every test.
JAX_TESTS := $(addprefix tests/test_,arrays.py shear.py grid.py transform.py interpolation.py \
  psf.py forms.py weights.py nulltests.py deviates.py measure.py::test_libraries_agree \
  population.py::test_a_ring_gives_its_shear round_noise.py::test_the_libraries_agree \
  responses.py::test_the_libraries_agree)

BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install --quiet --quiet --disable-pip-version-check
PYTEST := $(BIN)/python -m pytest --quiet

# One thread for each library: the test processes share the cores themselves.
export OMP_NUM_THREADS ?= 1

.DEFAULT_GOAL := help
.PHONY: help demo test test-jax test-gpu bench lint docs clean

help: ## this list
	@sed -n 's/^\([a-z-]*\):.*## /\1\t/p' $(MAKEFILE_LIST)

demo: $(VENV)/.demo ## draw an image of known shear, measure it, write demo/
	@$(BIN)/fdnt-xp demo -o demo --overwrite

test: $(VENV)/.dev ## the test suite on the CPU, all libraries but JAX
	@FDNT_XP_TEST_BACKENDS=$(CPU_BACKENDS) $(PYTEST) -n $(JOBS)

test-jax: $(VENV)/.jax ## the kernels and the public functions on JAX
	@FDNT_XP_TEST_BACKENDS=jax $(PYTEST) -n $(JOBS) $(JAX_TESTS)

test-gpu: $(VENV)/.dev ## the test suite on the GPU (GPU_BACKENDS=torch:cuda,cupy)
	@FDNT_XP_TEST_BACKENDS=$(GPU_BACKENDS) $(PYTEST)

bench: $(VENV)/.dev ## the benchmarks, and tables of them in units of an FFT
	@mkdir -p .benchmarks
	@$(PYTEST) benchmarks --benchmark-only --benchmark-timer=time.process_time \
	  --benchmark-columns=min,median,rounds --benchmark-json=.benchmarks/bench.json
	@$(BIN)/python benchmarks/tables.py .benchmarks/bench.json

lint: $(VENV)/.dev ## style, types, import floors, devices
	@$(BIN)/ruff check --quiet
	@$(BIN)/ruff format --check --quiet
	@$(BIN)/mypy --no-error-summary
	@$(BIN)/lint-imports --no-logo
	@$(BIN)/python tools/check_devices.py fdnt_xp

docs: $(VENV)/.docs ## the documentation, into docs/_build
	@rm -rf docs/api/generated
	@$(BIN)/sphinx-build --quiet --fail-on-warning --fresh-env docs docs/_build

clean: ## remove what the targets above made
	@rm -rf $(VENV) demo docs/_build docs/api/generated build dist

# --- the environment, in layers ---------------------------------------------------------

# torch first and pinned, so that no later step resolves to another build of it.
$(VENV)/.torch:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "fdnt_xp needs Python 3.11 or newer: make PYTHON=...")'
	@$(PYTHON) -m venv $(VENV)
	@$(PIP) '$(TORCH)'
	@touch $@

$(VENV)/.demo: $(VENV)/.torch pyproject.toml
	@$(PIP) --editable '.[all]'
	@touch $@

$(VENV)/.dev: $(VENV)/.demo
	@$(PIP) --editable '.[dev]'
	@touch $@

$(VENV)/.docs: $(VENV)/.dev
	@$(PIP) --editable '.[docs]'
	@touch $@

$(VENV)/.jax: $(VENV)/.dev
	@$(PIP) --editable '.[jax]'
	@touch $@
