# `make demo`, `make test`, `make lint` and `make notebooks` each work from nothing: the first one to run creates .venv.
# Another interpreter: make test PYTHON=python3.12. Other pytest arguments: make test PYTEST_ARGS="-x tests/solvers".
PYTHON ?= python3
PYTEST_ARGS ?= -n 2
BIN := .venv/bin

# One thread each: matrices are small, and the workers share the cores.
export OMP_NUM_THREADS ?= 1

.PHONY: demo test fuzz lint format notebooks clean

demo: .venv/.installed
	$(BIN)/pbfd demo --out demo

test: .venv/.installed
	$(BIN)/python -m pytest $(PYTEST_ARGS)

# Damaged and extreme inputs, thousands of each kind; `make test` tries a few of them.
fuzz: .venv/.installed
	$(BIN)/python -m pytest $(PYTEST_ARGS) tests/fuzz --hypothesis-profile=long

lint: .venv/.installed
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy

format: .venv/.installed
	$(BIN)/ruff check --fix
	$(BIN)/ruff format

.venv/.installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(BIN)/pip install -c constraints.txt -e '.[dev]'
	touch $@

notebooks: .venv/.installed
	$(BIN)/jupytext --to ipynb notebooks/*.py

clean:
	rm -rf .venv build dist demo *.egg-info .mypy_cache .pytest_cache .ruff_cache
