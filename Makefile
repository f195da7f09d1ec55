# Everything a person does here: `make demo`, `make test`, `make lint`. Each makes the virtual environment once.
PYTHON ?= python3
VENV ?= .venv
# Where torch is taken from, e.g. TORCH_INDEX=URL of a CPU wheel index. Empty: pip's own configuration.
TORCH_INDEX ?=
BIN := $(VENV)/bin
READY := $(VENV)/.installed

.PHONY: demo test lint format clean

demo: $(READY)
	$(BIN)/companion demo --output demo-output

test: $(READY)
	$(BIN)/python -m pytest -n auto --dist worksteal

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: $(READY)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

$(READY): pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(0 if sys.version_info >= (3, 11) else "companion needs Python 3.11 or newer, this is %d.%d; set PYTHON=" % sys.version_info[:2])'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt $(if $(TORCH_INDEX),--index-url $(TORCH_INDEX)) torch
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev]'
	touch $@

clean:
	rm -rf $(VENV) demo-output build *.egg-info .pytest_cache .mypy_cache .ruff_cache
