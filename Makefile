# Two commands for a bare checkout with Python 3.10 to 3.13, make and git: `make demo` and `make test`.
PYTHON ?= python3
VENV ?= .venv
# The version the demo and the tests are known to run with. On Linux the package index's own build brings several
# gigabytes of CUDA along; `make demo PIP_FLAGS='--index-url https://download.pytorch.org/whl/cpu --extra-index-url
# https://pypi.org/simple'` takes the small CPU build instead.
TORCH ?= torch==2.13.0
PIP_FLAGS ?=
DEMO_FLAGS ?=
PIP = $(VENV)/bin/python -m pip install --quiet --disable-pip-version-check $(PIP_FLAGS)
SOURCES = setup.py setup.cfg pyproject.toml package.xml

.PHONY: demo test test-all lint clean

demo: $(VENV)/.installed-embedded
	$(VENV)/bin/octn demo $(DEMO_FLAGS)

test: $(VENV)/.installed-test
	$(VENV)/bin/python -m pytest -m "not slow" -n 2 --dist loadfile

test-all: $(VENV)/.installed-test
	$(VENV)/bin/python -m pytest

lint: $(VENV)/.installed-test
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/mypy

clean:
	rm -rf $(VENV) build install log demo_output

# One rule for both sets of packages: the stamp's suffix is the name of the extra in setup.py.
$(VENV)/.installed-%: $(SOURCES) | $(VENV)/bin/python
	$(PIP) '$(TORCH)'
	$(PIP) --editable '.[$*]'
	touch $@

$(VENV)/bin/python:
	$(PYTHON) -m venv $(VENV)
