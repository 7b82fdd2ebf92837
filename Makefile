# Two commands from a fresh checkout, with Python 3.11 or newer and no compiler:
#
#   make demo    set up, fit the embedded street, render its movies
#   make test    set up, run the tests
#
# Everything is installed into .venv inside the checkout. `make test-slow` passes ARGS to pytest.

PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin

# Which torch to install. On Linux the default torch includes gigabytes of CUDA libraries. Without an
# NVIDIA card, the small CPU build from PyTorch's public index is enough:
#   make demo TORCH_INDEX=https://download.pytorch.org/whl/cpu
TORCH       ?= torch==2.13.0
TORCH_INDEX ?=

SETUP := $(VENV)/.set-up

.PHONY: setup demo test test-slow lint

setup: $(SETUP)

$(SETUP): pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	    echo "climatenerf needs Python 3.11 or newer and $(PYTHON) is older;" \
	         "run: make PYTHON=python3.12 $(MAKECMDGOALS)" >&2; exit 2; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install $(if $(TORCH_INDEX),--extra-index-url $(TORCH_INDEX)) "$(TORCH)"
	$(BIN)/python -m pip install -e ".[dev]"
	@touch $@

demo: $(SETUP)
	$(BIN)/climatenerf demo

test: $(SETUP)
	$(BIN)/python -m pytest -n 2 --dist loadfile

test-slow: $(SETUP)
	$(BIN)/python -m pytest -m slow $(ARGS)

lint: $(SETUP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
