# `make demo` and `make test` need Python >= 3.11 and make; the rest is installed into .venv.
PYTHON ?= python3
BIN := .venv/bin
READY := .venv/ready
DEMO := build/demo
DATA := ../shared/data

.PHONY: demo test check golden bench wheel-test clean

# uv where it is installed, else venv and pip.
$(READY): pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "Python 3.11 or newer is needed; name one: make PYTHON=python3.12 $(MAKECMDGOALS)"; exit 1; }
	@if command -v uv >/dev/null 2>&1; then \
	  test -x $(BIN)/python || uv venv --quiet --python $(PYTHON) .venv; \
	  uv pip install --quiet --python $(BIN)/python --editable '.[plots]' --group dev; \
	else \
	  test -x $(BIN)/pip || $(PYTHON) -m venv .venv; \
	  $(BIN)/python -m pip install --quiet --upgrade 'pip>=25.1'; \
	  $(BIN)/python -m pip install --quiet --editable '.[plots]' --group dev; \
	fi
	@touch $@

demo: $(READY)
	@PATH="$(CURDIR)/$(BIN):$$PATH" sh demo.sh $(DEMO)

test: $(READY)
	$(BIN)/python -m pytest

check: $(READY)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports --no-logo
	$(BIN)/python -m pytest

# Re-record the poses that the replay tests compare with.
golden: $(READY)
	$(BIN)/python -m pytest tests/replay --golden

bench: $(READY)
	$(BIN)/python benchmarks/stage_times.py $(DATA)

# The suite against the installed wheel, not the checkout.
wheel-test: $(READY)
	sh tests/run_against_wheel.sh

clean:
	rm -rf .venv build dist
