# Two commands set everything up: `make demo` and `make test`.
# On a machine where PyPI's torch is a CUDA build and that is not wanted, name an index
# of CPU wheels:  make demo TORCH_INDEX=<url>
# The first of these that runs here; a name that is only a shim does not.
PYTHONS := 3.11 3.12 3.13
ifndef PYTHON
PYTHON := $(shell for v in $(PYTHONS); do python$$v -c "" 2>/dev/null && echo python$$v && break; done)
endif
VENV := .venv
BIN := $(VENV)/bin
TORCH ?= torch==2.13.0
TORCH_INDEX ?=
EXTRAS ?= dev,experiments,docs,viewer,formats,export,peers
STAMP := $(VENV)/.installed

.PHONY: demo test test-all lint types docs bench clean
COMMA := ,

demo: $(STAMP)
	$(BIN)/vprism-plan demo --output out/demo

# A worker keeps to its half of the tests, and with it to the fixtures it has made, until the
# other half is left over.
PYTEST := $(BIN)/python -m pytest -n 2 --dist worksteal --durations=40

test: $(STAMP)
	$(BIN)/vprism-plan warmup
	$(PYTEST) -m "not slow"

# Everything, with coverage and with types checked at run time: twice the work.
TYPED := perception,mapping,world,robots,collision,planning,trajopt
test-all: $(STAMP)
	$(BIN)/vprism-plan warmup
	$(PYTEST) --cov --cov-report=term:skip-covered \
		--jaxtyping-packages=$(subst $(COMMA),$(COMMA)vprism_plan.,vprism_plan.$(TYPED)),beartype.beartype

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(STAMP)
	$(BIN)/mypy

# Runs every example, once: a failure, a missing picture or a warning fails the build.
docs: $(STAMP)
	$(BIN)/python -m sphinx -W --keep-going -q -b html docs build/docs/html

bench: $(STAMP)
	$(BIN)/python -m experiments.benchmarks.run_all

# torch first: resolved later, another package would bring a CUDA build of several GB.
$(STAMP): pyproject.toml
	$(if $(PYTHON),,$(error none of Python $(PYTHONS) runs here; install one, or say: make PYTHON=/path/to/python))
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --upgrade pip
	$(BIN)/pip install --quiet $(if $(TORCH_INDEX),--index-url $(TORCH_INDEX)) "$(TORCH)"
	$(BIN)/pip install --quiet --editable ".[$(EXTRAS)]"
	touch $(STAMP)

clean:
	rm -rf $(VENV) out
