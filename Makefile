# make demo   build everything and open the page      make test   the quick tests (minutes)
# make test-all   every test, browser included      make coverage   lines that the quick tests reach
# make docs   the site of documents, in build/docs
# make test-pythons   that the library installs and runs on later Pythons, where there is no PyBullet
# make check-wheels   that all packages are to be had for macOS, Windows and ARM
# make test-lowest   the quick tests with the lowest versions that pyproject.toml allows
# Variables: PYTHON=python3.11   TORCH_INDEX=<CPU-only wheel index>   PORT=8000   OSF_DATA_DIR=<where objects and runs live>

PYTHON ?= $(shell command -v python3.11 || command -v python3 || echo python3)
TORCH_INDEX ?=
PORT ?= 8000

VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check
OFFLINE := echo "make: the packages could not be installed; see the lines above (is there a network connection?)" >&2

LATER := 3.12 3.13
# What is checked for other systems, too; the rest asks nothing of the system, and all of it would take minutes.
ASKS_THE_SYSTEM := app osfcore/io

.PHONY: demo install dev test test-all test-pythons test-lowest check-wheels coverage lint docs soak bench clean

demo: install
	@$(BIN)/osf demo --port $(PORT)

install: $(VENV)/.installed
dev: $(VENV)/.dev-installed

$(BIN)/python:
	@$(PYTHON) .ci/check_python.py
	@$(PYTHON) -m venv $(VENV) || { rm -rf $(VENV); \
	  echo "make: the virtual environment could not be made; on Debian and Ubuntu 'apt install python3-venv' brings what is missing" >&2; exit 1; }

$(VENV)/.installed: $(BIN)/python pyproject.toml requirements.lock
	@echo "Installing packages into $(VENV) (a few minutes the first time)"
	@$(if $(TORCH_INDEX),$(PIP) install -q -c requirements.lock --index-url $(TORCH_INDEX) torch || { $(OFFLINE); exit 1; },:)
	@$(PIP) install -q -c requirements.lock -e '.[serve,heic,video]' || { $(OFFLINE); exit 1; }
	@touch $@

$(VENV)/.dev-installed: $(VENV)/.installed
	@$(PIP) install -q -c requirements.lock -e '.[dev]' || { $(OFFLINE); exit 1; }
	@$(PIP) install -q -c requirements.lock --no-deps gym-pusht || { $(OFFLINE); exit 1; }
	@touch $@

# Two processes; one that runs several tests at a time would upset those that watch a browser.
test: dev
	$(BIN)/pytest -n 2 --dist loadfile

# Shapes and types of arrays are checked on the way. The files with the slowest tests come first.
test-all: dev
	$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder -p tests.typecheck -m 'not soak and not e2e'
	$(BIN)/pytest -m e2e

# Their packages stay in .cache, five gigabytes each where torch comes with CUDA; from then on 'make test-all' has the test, too.
test-pythons: dev $(LATER:%=.cache/python%/.installed)
	$(BIN)/pytest -m slow tests/test_wheel.py -k later

.cache/python%/.installed: pyproject.toml requirements.lock
	python$* -m venv .cache/python$*
	$(if $(TORCH_INDEX),.cache/python$*/bin/pip install -q -c requirements.lock --index-url $(TORCH_INDEX) torch,:)
	.cache/python$*/bin/pip install -q -c requirements.lock '.[serve,heic,gym,mcap,lerobot,ros,usd]'
	.cache/python$*/bin/pip uninstall -q -y osf-manipulation
	@touch $@

# Whether all that is needed is to be had as wheels for each system and Python; asks PyPI for minutes.
check-wheels: dev
	$(PIP) install -q uv
	PATH=$(BIN):$$PATH $(BIN)/python .ci/check_wheels.py

# With uv, which alone can choose the lowest versions; of what tests need, any will do. Torch comes with CUDA unless
# TORCH_INDEX names another index.
LOWEST := serve heic video experiments cluster slurm gym lerobot mcap mcp ros usd pusht
test-lowest: .cache/lowest/.installed
	.cache/lowest/bin/python -m pytest

.cache/lowest/.installed: pyproject.toml
	$(PYTHON) -m venv .cache/lowest
	.cache/lowest/bin/pip install -q uv
	.cache/lowest/bin/uv pip compile -q --resolution lowest-direct $(if $(TORCH_INDEX),--index $(TORCH_INDEX),) $(LOWEST:%=--extra %) pyproject.toml -o .cache/lowest/versions.txt
	.cache/lowest/bin/pip install -q $(if $(TORCH_INDEX),--extra-index-url $(TORCH_INDEX),) -r .cache/lowest/versions.txt
	.cache/lowest/bin/pip install -q -c .cache/lowest/versions.txt -e '.[dev]'
	.cache/lowest/bin/pip install -q --no-deps gym-pusht==0.1.8
	@touch $@

coverage: dev
	$(BIN)/pytest -n 2 --dist loadfile --cov=osfcore --cov=app --cov-report=term:skip-covered

lint: dev
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/pyright
	$(BIN)/pyright --pythonplatform Darwin $(ASKS_THE_SYSTEM)
	$(BIN)/pyright --pythonplatform Windows $(ASKS_THE_SYSTEM)

# From the beginning each time: pages are made from code, which Sphinx does not watch.
docs: dev
	$(BIN)/sphinx-build --fresh-env --quiet --fail-on-warning --keep-going docs build/docs
	@echo "The site begins at build/docs/index.html"

# Half an hour: ten thousand malformed requests, a hundred kills, full disks, a quarter of an hour of episodes.
# OSF_SOAK_HOURS=8 makes a night of it.
soak: dev
	$(BIN)/pytest -m soak -s

bench: dev
	$(BIN)/python -m tests.bench.bench_world
	$(BIN)/python -m tests.bench.bench_service
	$(BIN)/python -m tests.bench.bench_episode
	$(BIN)/python -m tests.bench.bench_page

clean:
	rm -rf $(VENV) build .cache .pytest_cache .ruff_cache .hypothesis test-artifacts
