# `make demo` and `make test` set everything up; the first runs the main job, the second the tests
PYTHON ?= python3
VENV   ?= .venv
BIN    := $(VENV)/bin
STAMP  := $(VENV)/.installed
# locked versions with hashes; `make LOCK= setup` installs the newest that pyproject.toml allows
LOCK   ?= packaging/lock/development.txt
export OPENBLAS_NUM_THREADS ?= 1
# tests start hundreds of processes, which share compiled bytecode
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help setup demo test quick golden lint test-slow test-lowest bench hil docs pictures lock deb release clean

help: ## print this list
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*##/\t/' | expand -t 14

setup: $(STAMP) ## make the virtual environment .venv

$(STAMP): pyproject.toml $(LOCK)
	@echo "== setting up $(VENV)"
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 14))' \
	  || { echo "Python 3.11 to 3.13 is needed; set PYTHON=python3.12 or the like" >&2; exit 2; }
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV) \
	  || { echo "the venv module is missing: sudo apt-get install python3-venv" >&2; exit 2; }
	$(if $(LOCK),$(BIN)/python -m pip install --quiet --require-hashes --requirement $(LOCK))
	$(BIN)/python -m pip install --quiet --editable '.[dev]'
	@touch $@

demo: $(STAMP) ## the whole program on a rendered camera, until it has found a hidden effect
	rm -rf build/demo
	$(BIN)/thermocald demo --out build/demo

lint: $(STAMP) ## run ruff, mypy --strict, and check the layers
	@echo "== ruff"
	$(BIN)/ruff check .
	@echo "== layers"
	$(BIN)/lint-imports
	@echo "== mypy --strict"
	$(BIN)/mypy

# One process more than two cores, because tests of the daemon mostly wait; tests/conftest.py orders the files
WORKERS := -n 3 --dist loadfile --no-loadscope-reorder
test: $(STAMP) ## run lint and the quick tests in parallel
	@$(MAKE) --no-print-directory --jobs=2 lint quick

quick: $(STAMP)
	@echo "== pytest"
	$(BIN)/python -m pytest -q $(WORKERS)

golden: $(STAMP) ## compare every command's text and numbers with the stored ones
	$(BIN)/python -m tests.golden

test-slow: $(STAMP) ## run the long statistics and browser tests
	$(BIN)/python -m pytest -q -m slow $(WORKERS)

test-lowest: ## run the quick tests with the lowest versions that pyproject.toml allows
	.ci/lowest

# audit, daemon, discovery, fleet and scale take longer and are run separately
BENCHMARKS := adjustment frame front_door gauge montecarlo object_space "prediction --seeds 1" simulation \
  store study thermal_model
bench: $(STAMP) ## measure speed, mostly against peers, on one thread within five minutes
	@failed=; for b in $(BENCHMARKS); do echo "== $$b"; \
	  $(BIN)/python -m benchmarks.$$b || failed="$$failed $$b"; done; \
	  test -z "$$failed" || { echo "a bound is missed:$$failed" >&2; exit 1; }

hil: $(STAMP) ## run the laboratory: real kernel drivers without hardware (needs root, apt)
	tests/hil/run

docs: $(if $(wildcard $(BIN)/mkdocs),,$(STAMP)) ## build the documentation as a site in build/site
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet
	@echo "build/site/index.html"

pictures: $(STAMP) ## render the README's two pictures in docs/pictures
	$(BIN)/python docs/_site/pictures.py

lock: $(STAMP) ## resolve the locks of CI, the Debian packages, and the lowest versions
	$(BIN)/python -m pip install --quiet uv
	packaging/lock.sh

deb: $(STAMP) ## build the Debian package in dist: RELEASE=bookworm or trixie, ARCH=amd64 or arm64
	packaging/deb.sh $(RELEASE) $(ARCH)

release: $(STAMP) ## build and test everything that is published, in dist
	packaging/release.sh

clean: ## remove build and .venv
	rm -rf build .venv
