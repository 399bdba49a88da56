# `make demo` draws a first landscape, `make test` runs the tests of a few minutes, `make test-all` all but nightly ones;
# each sets up .venv by itself.
# Needs CPython 3.11 to 3.14; name an interpreter with PYTHON=..., and with VENV=... where its environment goes:
# `make test PYTHON=python3.13 VENV=.venv-3.13`. The engine Taichi has no wheels past 3.12.
PYTHON ?= $(firstword $(foreach p,python3.11 python3.12 python3.13 python3.14 python3,$(if $(shell $(p) -c 'import sys; print((3, 11) <= sys.version_info < (3, 15) or "")' 2>/dev/null | grep True),$(p))))
VENV ?= .venv
BIN := $(VENV)/bin
INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt

# An environment that is there already is of the Python that it was made with.
ifeq ($(origin PYTHON),command line)
ifneq ($(wildcard $(BIN)/python),)
ifneq ($(shell $(BIN)/python -V),$(shell $(PYTHON) -V))
$(error $(VENV) is of $(shell $(BIN)/python -V), not of $(shell $(PYTHON) -V); name another folder, as VENV=.venv-other)
endif
endif
endif

# A gallery that was built (`landscape gallery build`) becomes a part of the documentation.
GALLERY ?= out/gallery

.PHONY: demo test test-all test-nightly wheel archive docs setup setup-test setup-docs check clean

demo: setup
	$(BIN)/landscape slice fluid --dims 6 8 --resolution 14

# Two workers have two cores: a second thread of each would only wait for the other worker's. Each takes tests that are
# next to one another, which share what they make. The many processes that tests start compile the sources once.
# Kernels that were compiled stay in the caches of Warp, Taichi and JAX for the next run.
unexport PYTHONDONTWRITEBYTECODE
PYTEST := OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist worksteal
TESTS ?=

test: setup-test
	$(PYTEST) -m "not (slow or e2e or browser or docs or nightly)" $(TESTS)

test-all: setup-test
	$(PYTEST) $(TESTS)

test-nightly: setup-test
	$(PYTEST) -m nightly $(TESTS)

# Builds the wheel, installs it with all it needs into an empty environment, and tries it there; tests borrow the rest.
wheel: setup-test
	INSTALL_DEPENDENCIES=1 $(BIN)/python -m pytest tests/test_wheel.py

# The gallery's data as one file with its checksum, for an archive such as Zenodo. One commit always makes the same bytes.
VERSION := $(shell sed -n 's/^__version__ = "\(.*\)"/\1/p' src/gradscape/__init__.py)
DIST ?= dist
DATA := gradscape-data-$(VERSION)
archive:
	mkdir -p "$(DIST)"
	git archive --format=zip --prefix=$(DATA)/ --output="$(DIST)/$(DATA).zip" HEAD gallery/data LICENSE CITATION.cff
	cd "$(DIST)" && sha256sum $(DATA).zip > $(DATA).zip.sha256

check: setup-test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

# Tutorials are run, warnings are errors, and every page that was built is read for links that lead nowhere.
docs: setup-docs
	$(BIN)/python -m sphinx --fail-on-warning --keep-going --quiet -D gallery_site="$(GALLERY)" -d build/doctrees docs build/docs
	$(BIN)/python -m docs.pages.check build/docs

setup: $(VENV)/.installed
setup-test: $(VENV)/.installed-test
setup-docs: $(VENV)/.installed-docs

$(BIN)/python:
	@test -n "$(PYTHON)" || { echo "gradscape needs CPython 3.11 to 3.14; none was found. Install one, or name it: make PYTHON=/path/to/python3.12" >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)

# torch comes first and by itself: named exactly, it is the build the constraints ask for.
$(VENV)/.installed: pyproject.toml constraints.txt | $(BIN)/python
	$(INSTALL) torch==$(shell sed -n 's/^torch==//p' constraints.txt)
	$(INSTALL) --editable .
	@touch $@

$(VENV)/.installed-test: $(VENV)/.installed
	$(INSTALL) --editable '.[test,dev]'
	@touch $@

$(VENV)/.installed-docs: $(VENV)/.installed
	$(INSTALL) --editable '.[docs]'
	@touch $@

clean:
	rm -rf $(VENV) build dist docs/generated
