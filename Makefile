# Everything runs in .venv, which is made on the first call: `make demo`, `make test`. `make help` lists the rest.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
EXTRAS ?= dev,rl,ipopt
PYTHONS ?= python3.11 python3.12 python3.13
PYTEST_ARGS ?=

# A stamp is as new as the last install that succeeded, so an install is repeated only when what it reads has changed.
CORE_STAMP := $(VENV)/.core-installed
DEV_STAMP := $(VENV)/.dev-installed
# Python compiles what is imported, when it is: a small part of what would take half of the time of an install.
INSTALL := $(BIN)/python -m pip install --quiet --no-compile --constraint constraints.txt

export PIP_ROOT_USER_ACTION ?= ignore
export PIP_DISABLE_PIP_VERSION_CHECK ?= 1
# A process that may not keep what it compiled compiles Python's modules too: it starts three times as slowly.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help demo test test-all integrations portability wheel warm-wheel wheel-test lint docs bench bench-compare reproduce format clean

help: ## List the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-13s %s\n", $$1, $$2 }' $(firstword $(MAKEFILE_LIST))

demo: $(CORE_STAMP) ## Plan 16 robots across a warehouse, execute the plan, write pictures to demo/
	$(BIN)/d4orm demo --out demo

test: SELECTED = -m 'not (slow or cluster or browser or studies)'
test: test-all ## Run the quick tests; make test PYTEST_ARGS='-k reward' for some of them

test-all: $(DEV_STAMP) ## Run all tests
	$(BIN)/d4orm warmup # once; processes that find nothing in the cache all compile the same kernels
	$(BIN)/python -m pytest --numprocesses auto --maxprocesses 8 --dist worksteal --durations 40 $(SELECTED) $(PYTEST_ARGS)

# RLlib and JaxMARL pin an older Gymnasium, BenchMARL an older TorchRL, crazyflow another JAX than the rest is tested with.
test-apart = $(PYTHON) -m venv $(VENV)-$(1) && \
  $(VENV)-$(1)/bin/python -m pip install --quiet --editable . pytest $(2) && \
  $(VENV)-$(1)/bin/python -m pytest --noconftest -W default tests/env/test_$(1).py
integrations: ## Test the integrations whose libraries need an environment of their own: RLlib, BenchMARL, JaxMARL, crazyflow
	$(call test-apart,rllib,'ray[rllib]==2.60.0' torch==2.13.0)
	$(call test-apart,benchmarl,benchmarl==1.5.2)
	$(call test-apart,jaxmarl,jaxmarl==0.2.0 six)
	$(call test-apart,crazyflow,crazyflow==0.4.0)

portability: $(DEV_STAMP) ## Plan under the instruction sets of other processors and compare to the bit
	$(BIN)/python tests/portability/processors.py --quick

wheel: $(VENV)/.created ## Build source distribution and wheel into dist/
	rm -rf dist
	$(INSTALL) build
	$(BIN)/python -m build --outdir dist .

warm-wheel: wheel $(DEV_STAMP) ## Add compiled kernels to the wheel, for this Python, this system and every level of x86-64
	$(INSTALL) wheel
	$(BIN)/python tests/release/warm_wheel.py dist/*.whl

wheel-test: wheel ## Install the wheel into a fresh environment of each of PYTHONS that is here, and try it
	$(BIN)/python tests/release/fresh_environment.py dist/*.whl $(PYTHONS)

lint: $(DEV_STAMP) ## Check style, formatting, types and the layers
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

docs: $(DEV_STAMP) ## Build the documentation into docs/_build/html
	$(BIN)/sphinx-build -W --keep-going -j auto -b html docs docs/_build/html

bench: $(CORE_STAMP) ## Measure the engines on this machine, write bench/
	$(BIN)/d4orm bench --out bench

bench-compare: $(CORE_STAMP) ## Print what got slower since a commit: make bench-compare BASE=main BENCH_ARGS='--quick'
	$(BIN)/python tests/release/bench_compare.py $(BASE) $(BENCH_ARGS)

reproduce: $(DEV_STAMP) ## Make the tables of docs/tables from examples/studies/data; make reproduce FIGURE=noise SEEDS=3 runs one anew
	$(if $(SEEDS),$(if $(FIGURE),,$(error SEEDS is of one figure; give FIGURE, as FIGURE=noise)))
	$(BIN)/python -m examples.studies $(if $(FIGURE),paper $(FIGURE) $(if $(SEEDS),--seeds $(SEEDS)),all --out docs/tables)

format: $(DEV_STAMP) ## Format the code and mend what ruff can
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean: ## Remove what the targets above made, .venv included
	rm -rf $(VENV)* demo bench docs/_build docs/_extra docs/reference/settings.md docs/reference/d4orm_* build dist \
	  .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis

# Debian's Python may come without ensurepip; its own pip then puts one into the environment.
$(VENV)/.created:
	$(PYTHON) -m venv $(VENV) || { \
	  $(PYTHON) -m venv --without-pip $(VENV) && \
	  $(PYTHON) -m pip --python $(BIN)/python install --quiet pip; }
	touch $@

$(CORE_STAMP): pyproject.toml constraints.txt | $(VENV)/.created
	@echo "Installing d4orm-env into $(VENV) ..."
	$(INSTALL) --editable .
	touch $@

$(DEV_STAMP): pyproject.toml constraints.txt | $(VENV)/.created
	@echo "Installing d4orm-env with [$(EXTRAS)] into $(VENV); the first time this takes some minutes ..."
	$(INSTALL) --editable '.[$(EXTRAS)]'
	touch $(CORE_STAMP) $@
