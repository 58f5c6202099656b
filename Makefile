# `make run` and `make test` are all that a fresh machine needs: each makes the virtual environment it uses.
PYTHON ?= python3
VENV := .venv
# The matrices are small: threads of linear algebra cost more than they give.
export OMP_NUM_THREADS ?= 1
export MKL_NUM_THREADS ?= 1
export OPENBLAS_NUM_THREADS ?= 1

.PHONY: run test docs
run: $(VENV)/.installed
	$(VENV)/bin/bayeskin run runs/demo.toml

test: $(VENV)/.installed-dev
	$(VENV)/bin/ruff check
	$(VENV)/bin/ruff format --check
	$(VENV)/bin/mypy
	$(VENV)/bin/python -m pytest -n 2 --dist loadfile

# Editable, so that what stands in the checkout is what runs; made again when the dependencies change.
$(VENV)/.installed: pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit("bayeskin needs Python 3.11 or newer: make PYTHON=python3.11 ..." if sys.version_info < (3, 11) else 0)'
	test -x $(VENV)/bin/python || $(PYTHON) -m venv $(VENV)
	$(VENV)/bin/python -m pip install --quiet --editable .
	touch $@

$(VENV)/.installed-dev: $(VENV)/.installed
	$(VENV)/bin/python -m pip install --quiet --editable '.[dev]'
	touch $@

# The site in docs/_build; a warning is an error.
docs: $(VENV)/.installed-dev
	$(VENV)/bin/python -m sphinx -q -W --keep-going -b html docs docs/_build
