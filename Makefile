# Two commands do all the set-up: `make demo` runs the main job, `make test` passes the tests.
PYTHON ?= python3
VENV   ?= .venv
BIN    := $(VENV)/bin
STAMP  := $(VENV)/.installed
# what is installed, with hashes; `make LOCK= setup` takes the newest that pyproject.toml allows
LOCK   ?= packaging/lock/development.txt
export OPENBLAS_NUM_THREADS ?= 1
# tests start hundreds of processes: none of them compiles what another one has compiled
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help setup demo test quick golden lint test-slow test-lowest bench hil docs pictures lock deb release clean

help: ## this list
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*##/\t/' | expand -t 14

setup: $(STAMP) ## the virtual environment in .venv

$(STAMP): pyproject.toml $(LOCK)
	@echo "== setting up $(VENV)"
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 14))' \
	  || { echo "Python 3.11 to 3.13 is needed; set PYTHON=python3.12 or the like" >&2; exit 2; }
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV) \
	  || { echo "the venv module is missing: sudo apt-get install python3-venv" >&2; exit 2; }
	$(if $(LOCK),$(BIN)/python -m pip install --quiet --require-hashes --requirement $(LOCK))
	$(BIN)/python -m pip install --quiet --editable '.[dev]'
	@touch $@

demo: $(STAMP) ## the main job on a rendered camera, ending with a hidden effect found
	rm -rf build/demo
	$(BIN)/thermocald demo --out build/demo

lint: $(STAMP) ## ruff, mypy --strict, layers
	@echo "== ruff"
	$(BIN)/ruff check .
	@echo "== layers"
	$(BIN)/lint-imports
	@echo "== mypy --strict"
	$(BIN)/mypy

# Two cores and one process more: tests of the daemon wait for it more than they work. Files in the order of
# tests/conftest.py.
WORKERS := -n 3 --dist loadfile --no-loadscope-reorder
test: $(STAMP) ## lint and the quick tests, at the same time
	@$(MAKE) --no-print-directory --jobs=2 lint quick

quick: $(STAMP)
	@echo "== pytest"
	$(BIN)/python -m pytest -q $(WORKERS)

golden: $(STAMP) ## what users see: every command's text and numbers as they were
	$(BIN)/python -m tests.golden

test-slow: $(STAMP) ## long statistics and browser tests
	$(BIN)/python -m pytest -q -m slow $(WORKERS)

test-lowest: ## the quick tests with the lowest versions that pyproject.toml allows
	.ci/lowest

# audit, daemon, discovery, fleet and scale take longer: each is run by itself
BENCHMARKS := adjustment frame front_door gauge montecarlo object_space "prediction --seeds 1" simulation \
  store study thermal_model
bench: $(STAMP) ## ratios to peers, in one run on one thread, within five minutes
	@failed=; for b in $(BENCHMARKS); do echo "== $$b"; \
	  $(BIN)/python -m benchmarks.$$b || failed="$$failed $$b"; done; \
	  test -z "$$failed" || { echo "a bound is missed:$$failed" >&2; exit 1; }

hil: $(STAMP) ## the laboratory: real kernel drivers without hardware (needs root, apt)
	tests/hil/run

docs: $(if $(wildcard $(BIN)/mkdocs),,$(STAMP)) ## the documentation as a site in build/site
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet
	@echo "build/site/index.html"

pictures: $(STAMP) ## the README's two pictures, in docs/pictures
	$(BIN)/python docs/_site/pictures.py

lock: $(STAMP) ## resolve the locks again: CI's, the Debian packages', the lowest
	$(BIN)/python -m pip install --quiet uv
	packaging/lock.sh

deb: $(STAMP) ## the Debian package in dist: RELEASE=bookworm or trixie, ARCH=amd64 or arm64
	packaging/deb.sh $(RELEASE) $(ARCH)

release: $(STAMP) ## all that is published in dist, and tests of it
	packaging/release.sh

clean: ## remove what was made
	rm -rf build .venv
