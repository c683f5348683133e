# `make demo` and `make test` do everything on a fresh machine; nothing is installed outside .venv.
PYTHON ?= python3
VENV ?= .venv
BIN = $(VENV)/bin

.PHONY: demo test lint docs clean

demo: $(VENV)/.run-installed
	$(BIN)/improvo demo -o output/demo

# The tests of training and of worker processes have processes of their own: after the threads of all the other
# libraries, in one long process, they crashed now and then.
test: $(VENV)/.dev-installed lint
	$(BIN)/python -m pytest --ignore-glob='*/test_training_*' --ignore-glob='*/test_jobs_*'
	$(BIN)/python -m pytest tests/test_jobs_*.py
	$(BIN)/python -m pytest tests/test_training_*.py

lint: $(VENV)/.dev-installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

docs: $(VENV)/.dev-installed
	$(BIN)/mkdocs build --strict

$(VENV)/bin/python:
	$(PYTHON) -m venv $(VENV)

$(VENV)/.run-installed: $(VENV)/bin/python pyproject.toml
	$(BIN)/pip install --quiet torch==2.13.0
	$(BIN)/pip install --quiet -e '.[train]'
	touch $@

# torch first and by its exact version, so that nothing else pulls in another build of it
$(VENV)/.dev-installed: $(VENV)/bin/python pyproject.toml
	$(BIN)/pip install --quiet torch==2.13.0
	$(BIN)/pip install --quiet -e '.[dev]'
	$(BIN)/pip install --quiet evo  # GPL: the tests run its commands beside us to compare figures; never imported
	touch $@ $(VENV)/.run-installed

clean:
	rm -rf $(VENV) output
