# One word each. `make check` before a commit, `make test` before a push; `.ci/run` runs test-all, lint, cover, docs.

PYTHON ?= python
# Tests that take seconds, compiled or not: the lower rooms, without the fits of whole recordings.
QUICK = $(filter-out tests/test_bench.py, $(wildcard tests/test_*.py)) \
        tests/model tests/control tests/safety
# Tests of the modules in which every branch has to be tested: [tool.coverage.run] names these.
COVERING = $(patsubst %,tests/safety/test_%.py,rules trial monitors stop) \
           tests/test_outcomes.py tests/rig/test_release.py \
           tests/robots/kst/test_codec.py tests/robots/encoder/test_codec.py

# Tests of the packages beside the core.
PLUGINS = $(wildcard plugins/*/tests)

.DEFAULT_GOAL := help
.PHONY: help install check lint quick portable plain cover test full test-all slow docs hardware pictures screenshots results demo bench

help:  ## list these words
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  %-11s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

install:  ## install for development, in the active virtual environment
	$(PYTHON) -m pip install --editable '.[dev]' --editable './plugins/equipoise-franka[test]'

check: lint quick  ## format, lint, types, imports and the quick tests, in a minute

lint:  ## format, lint, types and imports
	ruff format --check .
	ruff check .
	pyright
	lint-imports

quick:  ## the tests of the lower rooms
	$(PYTHON) -m pytest -q $(QUICK)

portable:  ## the tests that macOS and Windows run: simulation and learning, without a rig, from Python
	$(PYTHON) -m pytest -q tests/model tests/control tests/learning tests/simulation

plain:  ## tests of model and control without compilation: the kernels as the Python that one reads
	NUMBA_DISABLE_JIT=1 $(PYTHON) -m pytest -q -m 'not slow and not compiled_only' tests/model \
	  tests/control $(addprefix --ignore=,$(COVERING))

cover:  ## every branch of safety rules, release, codecs and outcomes is tested; half a minute
	NUMBA_DISABLE_JIT=1 $(PYTHON) -m pytest -q --cov --cov-report=term-missing:skip-covered \
	  -m 'not slow and not compiled_only' $(COVERING)

test:  ## the tests of every day, in three minutes
	$(PYTHON) -m pytest -n 2

full:  ## the rest of them: peers, notebooks, long runs, the package of the FR3
	$(PYTHON) -m pytest -n 2 -m 'full and not slow and not real_time'
	$(PYTHON) -m pytest -n 2 -m 'not slow' $(PLUGINS)
	$(PYTHON) -m pytest -m real_time tests/faults

test-all: test full  ## every test but the full statistics

slow:  ## the full statistics
	$(PYTHON) -m pytest -m slow
	$(PYTHON) -m pytest -m slow $(PLUGINS)

docs:  ## the site and the notebooks, in build/site; a warning or a broken link is an error
	rm -rf build/site
	sphinx-build --quiet --fail-on-warning --keep-going -c docs . build/site
	$(PYTHON) course/notebooks.py build/site/course
	$(PYTHON) docs/check_site.py build/site

hardware:  ## write the mechanism's solids, prints and numbers; needs hardware/requirements.txt
	$(PYTHON) hardware/make.py

pictures:  ## make the pictures of README and documents again, in a minute
	$(PYTHON) docs/figures/make.py

screenshots:  ## take the pictures of playground, console and replay; needs Chromium
	$(PYTHON) docs/figures/screenshots.py

results:  ## measure the numbers of the pages again, in hours; one section: make results ONLY=map
	$(PYTHON) docs/results.py run $(ONLY)

demo:  ## a first look at the whole paper, in a minute
	$(PYTHON) -m equipoise reproduce

bench:  ## steps per second beside Pinocchio and Gymnasium
	$(PYTHON) benchmarks/bench.py
