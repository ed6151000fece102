# Everything from a fresh checkout: CPython 3.11 and make are all that is needed.
PYTHON ?= python3.11
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

# Where this is set, each of the many processes that tests and runs start would compile our source anew.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: wheel-test browser-test clean-kernels lock demo test campaign seeded-faults lint check bench paper \
    install clean

install: $(STAMP)

# The stamp is newer than the lock file and the project file once all is installed, so a second call does nothing.
$(STAMP): requirements.lock pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
	touch $@

demo: $(STAMP)
	$(BIN)/mapfusion run scenarios/quick.yaml

# Two tests at a time, a file's tests one after another: they share what they need. Kernels come first
# (`tests/conftest.py`), all others as they stand.
test: $(STAMP)
	$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder

# Thousands of broken inputs, and kills; up to an hour. ONLY=PART for one part.
SEED ?= 0
campaign: $(STAMP)
	$(BIN)/python -m tests.campaign --seed $(SEED) $(if $(ONLY),--only $(ONLY))

# The wheel in a fresh environment, which takes minutes to install.
wheel-test: $(STAMP)
	$(BIN)/python -m pytest tests/installed_wheel.py -s

# One fault of the source at a time: does a test notice? Hours; `--only NAME` for some.
seeded-faults: $(STAMP)
	$(BIN)/python -m tests.seeded_faults

# Installs Debian's chromium where it is missing (needs root for that).
browser-test: $(STAMP)
	PYTHON=$(BIN)/python tests/experiments/reports/report/report_in_browser.sh $(RESULT)

lint: $(STAMP)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/pyright
	$(BIN)/lint-imports

check: $(STAMP)
	$(BIN)/mapfusion check scenarios/quick.yaml --seeds 0 --junit results/junit.xml

bench: $(STAMP)
	$(BIN)/python -m pytest tests/benchmarks --benchmark-only --benchmark-columns=min,median,max,rounds

paper: $(STAMP)
	$(BIN)/mapfusion run scenarios/paper.yaml

# Compiled kernels of an earlier state of the source, where the command did not keep them apart.
clean-kernels:
	find mapfusion experiments -name '*.nbi' -delete -o -name '*.nbc' -delete

clean:
	rm -rf $(VENV) *.egg-info .pytest_cache .ruff_cache

# Renew the pins (hashes, no host names). Needs network.
lock:
	$(PYTHON) -m venv $(VENV)-lock
	$(VENV)-lock/bin/python -m pip install --quiet pip-tools
	$(VENV)-lock/bin/pip-compile --quiet --upgrade --generate-hashes --strip-extras --allow-unsafe --all-extras \
	    --no-header --no-emit-index-url --no-emit-trusted-host --no-emit-find-links --no-emit-options \
	    -o requirements.lock pyproject.toml
	rm -rf $(VENV)-lock
