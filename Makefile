# `make demo` and `make test` do everything on a fresh machine; nothing is installed outside .venv.
PYTHON ?= python3
VENV ?= .venv
BIN = $(VENV)/bin

.PHONY: demo test test-cluster lint docs locked clean

demo: $(VENV)/.run-installed
	$(BIN)/improvo demo -o output/demo

# The tests of training have a process of their own: torch's threads come after those of all the other libraries there.
test: $(VENV)/.dev-installed lint
	$(BIN)/python -m pytest --ignore-glob='*/test_training_*'
	$(BIN)/python -m pytest tests/test_training_*.py

# What `make test` skips for want of the packages: a Ray cluster of two nodes and an S3 server, both of this machine.
test-cluster: $(VENV)/.cluster-installed
	$(BIN)/python -m pytest -rs tests/test_jobs_on_ray.py tests/test_locations.py
	$(BIN)/python -m pytest -rs tests/test_training_locations.py

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

$(VENV)/.cluster-installed: $(VENV)/.dev-installed
	# the extra boto3: S3's client wants an older one than moto would take, which pip does not find out in time
	$(BIN)/pip install --quiet -e '.[ray,remote]' 'aiobotocore[boto3]' 'moto[server]>=5'
	touch $@

# The versions that requirements-dev.txt names, by their hashes; `make locked test` tests with them. To renew the file:
# uv pip compile pyproject.toml --extra dev --universal --python-version 3.10 --no-emit-index-url --generate-hashes
locked: $(VENV)/bin/python
	$(BIN)/pip install --quiet torch==2.13.0
	$(BIN)/pip install --quiet --require-hashes -r requirements-dev.txt
	$(BIN)/pip install --quiet --no-deps -e .
	$(BIN)/pip install --quiet evo==1.38.1  # GPL, see above
	touch $(VENV)/.dev-installed $(VENV)/.run-installed

clean:
	rm -rf $(VENV) output
