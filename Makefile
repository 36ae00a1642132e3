# `make` finds a Python >= 3.12 by itself; name one with `make PYTHON=/path/to/python3.12 ...`.
SHELL := /bin/bash
.DEFAULT_GOAL := help
.PHONY: help setup demo demo-train test test-long test-cuda judges neighbours test-lerobot mutants check build \
	reference docs npm play clean

BIN := .venv/bin
STAMP := .venv/.installed
EXTRAS := pusht,libero,sapien,so101
NPM_FLAGS ?= --omit=dev  # --include=dev: also what tests of the page in a browser need
# two torch threads beside another job are many times slower than one
export OMP_NUM_THREADS ?= 1
# LeRobot imports 4000 files; where this is set, as in many images, every process compiles them anew
unexport PYTHONDONTWRITEBYTECODE
# tests of a file share what is recorded and trained for them, so a file is run by one process;
# tests/conftest.py says which files are begun first
PYTEST := $(BIN)/pytest -n auto --maxprocesses=4 --dist=loadfile --no-loadscope-reorder

help:
	@echo "make demo       set up, evaluate a shipped policy, print its rates and pictures"
	@echo "make demo-train set up, record, train a policy that places stones, evaluate it"
	@echo "make test       set up and run the tests"
	@echo "make test-long  the heavy tests as well"
	@echo "make test-cuda  checks that need a CUDA device"
	@echo "make judges     LeRobot's own tests on our types: LEROBOT_SRC=checkout of its tag"
	@echo "make neighbours LeRobot's own tests with the plugin and without: LEROBOT_SRC=the same"
	@echo "make test-lerobot  tests and judges with another LeRobot: LEROBOT_SRC=a checkout of it;"
	@echo "                and with another Python or plugins: PYTHON=python3.13 PLUGINS='PACKAGE ...'"
	@echo "make mutants    changes of the statistics, actions and losses that no test notices: MUTANTS=400"
	@echo "make check      ruff, format, pyright"
	@echo "make build      sdist and wheel into dist/, tried in an environment of their own"
	@echo "make reference  docs/reference/, from the code"
	@echo "make docs       the documentation as a site, into site/"
	@echo "make play       the page on which BOMB plays in a browser, into site/play/; needs npm"
	@echo "make setup      only set up .venv"

setup: $(STAMP)
	@$(BIN)/python -c "from lerobot_env_bomb.shared.backend import ensure_gl_backend; ensure_gl_backend()" \
		|| { echo "Set-up is done, but rendering does not work, see above." >&2; exit 1; }
	@echo "Set up: source $(BIN)/activate, then lerobot-bomb doctor checks it and make demo shows it"

$(STAMP): pyproject.toml constraints.txt lerobot_bomb/__init__.py
	@python="$$(bash .ci/find-python $(PYTHON))" || exit 1; \
	$(BIN)/python -c 'import sys; sys.exit(sys.version_info < (3, 12))' 2>/dev/null || \
		{ echo "Creating .venv with $$python"; "$$python" -m venv --clear .venv || exit 1; }
	@if [ ! -x $(BIN)/uv ]; then echo "Installing uv into .venv"; $(BIN)/python -m pip install -q uv || exit 1; fi
	@echo "Installing packages under constraints.txt"
	@$(BIN)/uv pip install -q -p $(BIN)/python -c constraints.txt -e '.[$(EXTRAS)]' --group dev
	@touch $@

demo: setup
	@$(BIN)/lerobot-bomb demo

# a folder that is kept: what was finished when it was stopped is not done again
demo-train: setup
	@$(BIN)/python benchmarks/learn.py one_target --policy.type=vla0_smol --checkpoints=2 --force \
		--output_dir=outputs/demo_train --plot=outputs/demo_train/learning_curve.png

test: setup
	@$(PYTEST) -m "not long"

test-long: setup
	@$(PYTEST)

test-cuda: setup
	@$(BIN)/pytest tests/outside/check_cuda.py

judges: setup
	@$(BIN)/python tests/outside/run_judges.py "$(LEROBOT_SRC)"

neighbours: setup
	@$(BIN)/python tests/outside/run_neighbours.py "$(LEROBOT_SRC)"

# versions are those of constraints.txt where that LeRobot allows them
test-lerobot: setup
	@$(BIN)/python tests/outside/try_lerobot.py "$(LEROBOT_SRC)" \
		--extras=$(EXTRAS) $(if $(PYTHON),--python="$(PYTHON)") --plugins $(PLUGINS)

mutants: setup
	@$(BIN)/uv pip install -q -p $(BIN)/python -c constraints.txt --group mutants
	@$(BIN)/python tests/outside/mutants.py $(MUTANTS)

check: $(STAMP)
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/pyright

build: setup
	@$(BIN)/pytest tests/test_packaging.py
	@$(BIN)/python tests/outside/check_build.py

reference: $(STAMP)
	@$(BIN)/python docs/make_reference.py

# built strictly: a link to no page or to no heading is an error
docs: $(STAMP)
	@$(BIN)/uv pip install -q -p $(BIN)/python -c constraints.txt --group docs
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict
	@echo "Built: site/index.html"
	@$(MAKE) --no-print-directory play

# MuJoCo's WASM and what else a page of JavaScript needs
npm: $(STAMP)
	@mkdir -p .venv/npm && cp docs/play/package.json .venv/npm
	@npm install --silent $(NPM_FLAGS) --no-package-lock --no-audit --no-fund --prefix .venv/npm

play: $(STAMP) npm
	@$(BIN)/uv pip install -q -p $(BIN)/python -c constraints.txt --group docs
	@$(BIN)/python docs/make_play.py site/play

clean:
	rm -rf .venv
