# `make run` and `make test` are all that a fresh machine needs: each makes the virtual environment it uses.
PYTHON ?= python3
VENV := .venv
# The matrices are small: threads of linear algebra cost more than they give.
export OMP_NUM_THREADS ?= 1
export MKL_NUM_THREADS ?= 1
export OPENBLAS_NUM_THREADS ?= 1
# Commands and tests start many processes, each of which would compile all modules again.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: run test docs test-oldest test-wheel
run: $(VENV)/.installed
	$(VENV)/bin/bayeskin run runs/demo.toml
	$(VENV)/bin/bayeskin diagnose runs/demo.toml

test: $(VENV)/.installed-dev
	$(VENV)/bin/ruff check
	$(VENV)/bin/ruff format --check
	$(VENV)/bin/mypy
	$(VENV)/bin/python -m pytest -n 2 --dist loadfile

# Editable, so that what stands in the checkout is what runs; made again when the dependencies change. `doctor`
# compiles the models, so that no later command has to.
$(VENV)/.installed: pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit("bayeskin needs Python 3.11 or newer: make PYTHON=python3.11 ..." if sys.version_info < (3, 11) else 0)'
	test -x $(VENV)/bin/python || $(PYTHON) -m venv $(VENV)
	$(VENV)/bin/python -m pip install --quiet --editable .
	$(VENV)/bin/bayeskin doctor
	touch $@

$(VENV)/.installed-dev: $(VENV)/.installed
	$(VENV)/bin/python -m pip install --quiet --editable '.[dev]'
	touch $@

# The site in docs/_build; a warning is an error.
docs: $(VENV)/.installed-dev
	$(VENV)/bin/python -m sphinx -q -W --keep-going -b html docs docs/_build

# The tests with the oldest version of every package that pyproject.toml allows, in an environment of their own.
test-oldest:
	$(PYTHON) -m venv .venv-oldest
	$(PYTHON) tests/toys/oldest_versions.py > .venv-oldest/constraints.txt
	.venv-oldest/bin/python -m pip install --quiet -c .venv-oldest/constraints.txt --editable '.[dev]'
	.venv-oldest/bin/python -m pytest -n 2 --dist loadfile

# What a wheel installs by itself, without the checkout: the parts and the demo that it ships.
test-wheel:
	rm -rf .venv-wheel && $(PYTHON) -m venv .venv-wheel
	.venv-wheel/bin/python -m pip wheel --quiet --no-deps --wheel-dir .venv-wheel/dist .
	.venv-wheel/bin/python -m pip install --quiet .venv-wheel/dist/*.whl
	cd .venv-wheel && bin/bayeskin doctor && bin/bayeskin new && bin/bayeskin run demo.toml
	cd .venv-wheel && bin/bayeskin diagnose demo.toml
