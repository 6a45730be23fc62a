# Needs Python 3.11 or newer with pip, make, and PyPI (the first time only).
# Another Python: make demo PYTHON=/path/to/python3.12
# What an older version left in runs/demo is only replaced if you say so: make demo ARGS=--overwrite

# The first interpreter that is new enough; else whichever python3 there is, so that the error names its version.
PYTHON ?= $(shell for p in python3 python3.13 python3.12 python3.11; do \
	$$p -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && echo $$p && exit; done; echo python3)
BIN := .venv/bin
STAMP := .venv/.stamp

export PIP_DISABLE_PIP_VERSION_CHECK := 1
export PYRIGHT_PYTHON_IGNORE_WARNINGS := 1

.DEFAULT_GOAL := help
.PHONY: help demo fast test check bench lock clean

help:  ## Show this list
	@sed -n 's/^\([a-z]*\):.*## \(.*\)/  make \1\t\2/p' Makefile

demo: $(STAMP)  ## Plan, simulate and draw both robots' walks; results in runs/demo
	$(BIN)/jaxbiped demo --out runs/demo $(ARGS)

# Rooms and files whose tests compile no whole walk.
FAST := tests/robot tests/kinematics tests/planner tests/score tests/batch tests/report tests/test_architecture.py tests/test_checked.py \
	tests/test_cli.py tests/test_runtime.py tests/test_variant_files.py tests/test_versions.py tests/adapt/test_controller.py \
	tests/adapt/test_parameters.py tests/adapt/test_quick_step.py tests/adapt/test_tunables.py \
	--ignore tests/batch/test_backends.py --ignore tests/batch/test_kills.py --ignore tests/batch/test_run.py

fast: $(STAMP)  ## Run the tests that compile no whole walk (three to five minutes on two cores)
	NPROC=1 $(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder --max-worker-restart 0 $(FAST)

test: $(STAMP)  ## Run the test suite (without the tests marked slow or gpu)
	NPROC=1 $(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder --max-worker-restart 0

check: $(STAMP)  ## Lint, check the format, check the types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright --pythonpath $(BIN)/python

bench: $(STAMP)  ## Time the kernels against their peers on this machine
	$(BIN)/python benchmarks/kernels.py

lock: .venv-lock/bin/uv  ## Write requirements.lock anew from pyproject.toml
	$< pip compile --quiet --universal --python-version 3.11 --upgrade --no-config \
		--extra viz --extra cluster --extra tune --extra dev --no-emit-index-url --no-emit-find-links \
		--custom-compile-command "make lock" pyproject.toml --output-file requirements.lock

clean:  ## Remove the environments and caches; runs/ stays
	rm -rf .venv .venv-lock build dist .pytest_cache .ruff_cache .hypothesis .jax_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(STAMP): requirements.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || { \
		echo "jaxbiped needs Python 3.11 or newer; '$(PYTHON)' is $$($(PYTHON) --version 2>&1)." >&2; \
		echo "Name another one: make PYTHON=/path/to/python3.12 $(MAKECMDGOALS)" >&2; exit 1; }
	@echo "Installing the locked packages into .venv (once; a few minutes)"
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --requirement requirements.lock
	$(BIN)/python -m pip install --quiet --no-deps --editable .
	@touch $@

.venv-lock/bin/uv:
	@$(PYTHON) -m venv .venv-lock
	@.venv-lock/bin/python -m pip install --quiet uv
