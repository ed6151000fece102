# Everything from a fresh checkout: CPython 3.11, 3.12 or 3.13 and make are all that is needed.

# The first of these that starts. 3.11 comes first because PyBullet has wheels for it: pip compiles PyBullet
# for the others, which takes a C++ compiler and minutes. `make demo PYTHON=python3.13` chooses another.
PYTHON ?= $(shell for each in python3.11 python3.12 python3.13; do \
    $$each -c "" 2>/dev/null && { echo $$each; exit; }; done; echo python3)
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check
PINNED := $(PIP) --require-hashes --no-build-isolation
# What a user has, and with the tools for work on the source.
INSTALLED := $(VENV)/.installed
DEVELOPING := $(VENV)/.developing

# Where this is set, each of the many processes that tests and runs start would compile our source anew.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: docs wheel-test browser-test clean-kernels lock demo test campaign seeded-faults lint check check-fresh bench paper \
    install clean

install: $(DEVELOPING)

# A stamp is newer than the lock files and the project file once all is installed, so a second call does
# nothing. NumPy comes first: PyBullet is compiled with it, and would else draw pictures at half the speed.
$(INSTALLED): requirements-build.lock requirements.lock pyproject.toml
	@$(PYTHON) -c "import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 14))" || \
	    { echo "CPython 3.11, 3.12 or 3.13 is needed: make PYTHON=FILE names one" >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(PINNED) -r requirements-build.lock
	$(PINNED) -r requirements.lock
	$(PIP) --no-deps --no-build-isolation -e .
	touch $@

$(DEVELOPING): $(INSTALLED) requirements-dev.lock
	$(PINNED) -r requirements-dev.lock
	touch $@

# Our ray caster draws this run's images, several times as fast as PyBullet's TinyRenderer, which draws those
# of `mapfusion run quick` and of the CI.
demo: $(INSTALLED)
	$(BIN)/mapfusion run quick --set render.renderer=raycast -o results/demo
	$(BIN)/mapfusion report results/demo

# Two tests at a time, a file's tests one after another: they share what they need. Kernels come first
# (`tests/conftest.py`), all others as they stand.
test: $(DEVELOPING)
	$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder

# The documentation site, in docs/_build/html; a warning is an error.
docs: $(DEVELOPING)
	$(BIN)/python -m sphinx --fail-on-warning --keep-going --quiet -b html docs docs/_build/html

# Thousands of broken inputs, and kills; up to an hour. ONLY=PART for one part.
SEED ?= 0
campaign: $(DEVELOPING)
	$(BIN)/python -m tests.campaign --seed $(SEED) $(if $(ONLY),--only $(ONLY))

# The wheel in a fresh environment of each version of Python that is here; minutes. COMPILE=1: PyBullet, too,
# where pip compiles it.
wheel-test: $(DEVELOPING)
	$(BIN)/python -m pytest tests/installed_wheel.py -s

# One fault of the source at a time: does a test notice? Hours; `--only NAME` for some.
seeded-faults: $(DEVELOPING)
	$(BIN)/python -m tests.seeded_faults

# Installs Debian's chromium where it is missing (needs root for that).
browser-test: $(DEVELOPING)
	PYTHON=$(BIN)/python tests/experiments/reports/report/report_in_browser.sh $(RESULT)

lint: $(DEVELOPING)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/pyright
	$(BIN)/lint-imports

check: $(INSTALLED)
	$(BIN)/mapfusion check scenarios/quick.yaml --seeds 0 --junit results/junit.xml

# Two runs without common ground, on scenarios and seeds of today.
check-fresh: $(INSTALLED)
	$(BIN)/python -m tests.fresh_seeds

bench: $(DEVELOPING)
	$(BIN)/python -m pytest tests/benchmarks --benchmark-only --benchmark-columns=min,median,max,rounds

paper: $(INSTALLED)
	$(BIN)/mapfusion run scenarios/paper.yaml

# Compiled kernels of an earlier state of the source, where the command did not keep them apart.
clean-kernels:
	find mapfusion experiments -name '*.nbi' -delete -o -name '*.nbc' -delete

clean:
	rm -rf $(VENV) *.egg-info .pytest_cache .ruff_cache

# Renew the pins (hashes, no host names) for all versions of Python at once. Needs network.
LOCK := $(VENV)-lock/bin/uv pip compile --quiet --universal --generate-hashes --no-header --no-annotate
lock:
	$(PYTHON) -m venv $(VENV)-lock
	$(VENV)-lock/bin/python -m pip install --quiet uv
	$(LOCK) --upgrade --extra sim --extra peers pyproject.toml -o requirements.lock
	$(LOCK) --upgrade --group build -c requirements.lock -o requirements-build.lock
	$(LOCK) --upgrade --group dev -c requirements.lock -c requirements-build.lock -o requirements-dev.lock
	rm -rf $(VENV)-lock
