# `make demo`, `make test`, `make lint` and `make notebooks` each work from nothing: the first one to run creates .venv.
# Another interpreter: make test PYTHON=python3.12. Other pytest arguments: make test PYTEST_ARGS="-x tests/solvers".
PYTHON ?= python3
PYTEST_ARGS ?= -n 2 --dist worksteal
BIN := .venv/bin
NATIVE := $(wildcard pbfd_torch/native/src/*)

# One thread each: matrices are small, and the workers share the cores.
export OMP_NUM_THREADS ?= 1

.PHONY: demo test fuzz sanitize lint format notebooks clean

demo: .venv/.installed
	$(BIN)/pbfd demo --out demo

test: .venv/.installed
	$(BIN)/python -m pytest $(PYTEST_ARGS)

# Damaged and extreme inputs, thousands of each kind; `make test` tries a few of them.
fuzz: .venv/.installed
	$(BIN)/python -m pytest $(PYTEST_ARGS) tests/fuzz --hypothesis-profile=long

# The native core's own tests, in C++, under AddressSanitizer and UndefinedBehaviorSanitizer.
sanitize: $(patsubst tests/native/%.cpp,build/sanitized/%,$(wildcard tests/native/*.cpp))
	set -e; for test in $^; do echo $$test; $$test; done

SANITIZED := $(CXX) -std=c++17 -O0 -g1 -march=native -fno-math-errno -ffp-contract=off -fno-exceptions -fno-rtti -Wall -Wextra \
	-Wno-bitwise-instead-of-logical -Werror -fsanitize=address,undefined -fno-sanitize-recover=all -I pbfd_torch/native/src

UNITS := build/sanitized/library.o build/sanitized/descent.o

build/sanitized/%: tests/native/%.cpp $(UNITS) $(wildcard tests/native/*.h)
	$(SANITIZED) -o $@ $< $(UNITS)

$(UNITS): build/sanitized/%.o: pbfd_torch/native/src/%.cpp $(NATIVE)
	mkdir -p $(@D)
	$(SANITIZED) -c -o $@ $<

lint: .venv/.installed
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy

format: .venv/.installed
	$(BIN)/ruff check --fix
	$(BIN)/ruff format

.venv/.installed: pyproject.toml constraints.txt setup.py $(NATIVE)
	$(PYTHON) -m venv .venv
	$(BIN)/pip install -c constraints.txt -e '.[dev]'
	@cat pbfd_torch/native/lib/none.txt 2>/dev/null || true # pip does not say it
	touch $@

notebooks: .venv/.installed
	$(BIN)/jupytext --to ipynb notebooks/*.py

clean:
	rm -rf .venv build dist demo pbfd_torch/native/lib *.egg-info .mypy_cache .pytest_cache .ruff_cache
