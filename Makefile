# Every target sets up what it needs; a second call does only the work itself.
PYTHON ?= python3
VENV := .venv
PRODUCT := $(VENV)/.product
STAMP := $(VENV)/.installed
# Without its bytecode each test process would compile every module anew.
unexport PYTHONDONTWRITEBYTECODE
# Slow files begin first (tests/conftest.py), which a worker alone would else have at the end.
PYTEST := $(VENV)/bin/python -m pytest -n auto --dist loadfile --no-loadscope-reorder

.PHONY: dry-run test test-quick test-browser thresholds coverage mutation lint hooks docs blind-trial release release-matrix clean

# The program alone; every other target adds the tools of tests and of development to the same environment.
dry-run: $(PRODUCT)
	$(VENV)/bin/bench run paper --dry-run

test: $(STAMP)
	$(PYTEST)

# Without the tests that are marked slow: what to run between two edits.
test-quick: $(STAMP)
	$(PYTEST) -m "not slow and not browser"

# After a change of diagnosis or effects: simulates anew what the tests' designs need, which each `make test` would do else.
thresholds: $(VENV)/.driving
	rm -f tests/data/thresholds.json
	BENCH_KEEP_THRESHOLDS=1 $(PYTEST)
	BENCH_KEEP_THRESHOLDS=1 $(PYTEST) -m browser tests/browser

# The panel in the system's Chromium; without one it says so, and fails.
test-browser: $(VENV)/.driving
	$(VENV)/bin/python -m tests.support.browsers
	$(PYTEST) -m browser tests/browser

$(VENV)/.driving: $(STAMP)
	PIP_CONSTRAINT=constraints.txt $(VENV)/bin/python -m pip install --quiet --editable '.[browser]'
	touch $@

coverage: $(STAMP)
	$(PYTEST) --cov --cov-report=term:skip-covered

# A few minutes; `make mutation MUTANTS=2000` takes hours.
MUTANTS ?= 30
mutation: $(STAMP)
	PIP_CONSTRAINT=constraints.txt $(VENV)/bin/python -m pip install --quiet --editable '.[mutation]'
	OPENBLAS_NUM_THREADS=1 $(VENV)/bin/python -m benchmarks.mutation --mutants $(MUTANTS)

lint: $(STAMP)
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/mypy
	$(VENV)/bin/lint-imports
	$(VENV)/bin/python -m benchmarks.translations
	$(VENV)/bin/codespell bench drivers sim benchmarks docs procedures config README.md CONTRIBUTING.md CHANGELOG.md
	$(VENV)/bin/python -m benchmarks.prose --check

hooks: $(STAMP)
	$(VENV)/bin/pre-commit install

# PIP_CONSTRAINT reaches the isolated environment in which the package itself is built, too.
$(PRODUCT): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	PIP_CONSTRAINT=constraints.txt $(VENV)/bin/python -m pip install --quiet --editable .
	touch $@

$(STAMP): $(PRODUCT)
	PIP_CONSTRAINT=constraints.txt $(VENV)/bin/python -m pip install --quiet --editable '.[test,dev]'
	touch $@

# A site of the pages under docs, with references, pictures and the gallery made by the program; a broken link is an error.
# Then a look at it in the system's Chromium; without one it has no screenshots, and says so.
docs: $(VENV)/.documented
	OPENBLAS_NUM_THREADS=1 $(VENV)/bin/sphinx-build -q -W --keep-going -b html docs docs/_build/html
	$(VENV)/bin/python -m docs.generators.accessible docs/_build/html

$(VENV)/.documented: $(STAMP)
	PIP_CONSTRAINT=constraints.txt $(VENV)/bin/python -m pip install --quiet --editable '.[docs,browser]'
	touch $@

# About three hours on two cores, after which the site has its tables; a tenth (TRIAL="--page --seed 7 --share 0.1") takes 20 minutes.
TRIAL ?= --page --seed 7
blind-trial: $(STAMP)
	OPENBLAS_NUM_THREADS=1 $(VENV)/bin/python -m benchmarks.blind_trial $(TRIAL)

# Wheel and sdist (twice, equal), bill of materials, licences, container file, offline bundle, manifest, in dist.
# `make release KEY=FILE` signs the manifest, OUT=DIR is another folder; `make release-matrix` tries Pythons and versions, an hour.
OUT ?= dist
release: $(VENV)/.releasing
	$(VENV)/bin/python -m release.build --out $(OUT) --bundle $(if $(KEY),--key $(KEY))

release-matrix: $(VENV)/.releasing
	$(VENV)/bin/python -m release.matrix

$(VENV)/.releasing: $(STAMP)
	PIP_CONSTRAINT=constraints.txt $(VENV)/bin/python -m pip install --quiet --editable '.[test,dev,release]'
	touch $@

clean:
	rm -rf $(VENV) docs/_build docs/reference .mypy_cache .ruff_cache .pytest_cache .hypothesis \
		.import_linter_cache .coverage .coverage.* mutants
