# SPDX-License-Identifier: Apache-2.0
PYTHON ?= python3
VENV ?= .venv
RUN = $(VENV)/bin/python
# The ROS wheels: kilted (extra `ros`) or jazzy.
ROS ?= ros
EXTRAS = $(ROS),record,report,fast
PYTEST = $(RUN) -m pytest
PARALLEL = --numprocesses auto --dist loadfile

.PHONY: demo demo-feedforward docs view test test-all test-jazzy test-ros lint format clean

demo: $(VENV)/.demo
	$(RUN) -m sst_ros demo --force

demo-feedforward: $(VENV)/.demo
	$(RUN) -m sst_ros demo feedforward --force

docs: $(VENV)/.docs
	$(RUN) -m sphinx --fail-on-warning --keep-going --quiet --builder html docs site

view: $(VENV)/.view
	@$(RUN) -m sst_ros view --scene swing --open

test: $(VENV)/.test lint
	$(PYTEST) $(PARALLEL) -m "not slow" --ignore test/ros
	$(PYTEST) $(PARALLEL) -m "not slow" test/ros

# The nodes with the wheels of ROS 2 Jazzy, in an environment of their own.
test-jazzy:
	$(MAKE) test-ros VENV=.venv-jazzy ROS=jazzy

test-ros: $(VENV)/.ros
	$(PYTEST) $(PARALLEL) -m "not slow" test/ros

test-all: $(VENV)/.test lint test-jazzy
	$(PYTEST) $(PARALLEL) --ignore test/ros --timeout 600
	$(PYTEST) test/ros --timeout 600

lint: $(VENV)/.test
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/mypy

format: $(VENV)/.test
	$(VENV)/bin/ruff check --fix .
	$(VENV)/bin/ruff format .

$(VENV)/.python:
	@$(PYTHON) -c 'import sys; v = sys.version_info[:2]; \
	  sys.exit(None if (3, 10) <= v <= (3, 13) else f"sst_ros needs Python 3.10 to 3.13 (the ROS wheels), this is {v[0]}.{v[1]}: make PYTHON=python3.12 ...")'
	$(PYTHON) -m venv $(VENV)
	$(RUN) -m pip install --quiet --disable-pip-version-check --upgrade pip
	@touch $@

$(VENV)/.demo: $(VENV)/.python setup.py
	$(RUN) -m pip install --quiet --disable-pip-version-check --editable ".[$(EXTRAS)]"
	@touch $@

$(VENV)/.view: $(VENV)/.python setup.py
	$(RUN) -m pip install --quiet --disable-pip-version-check --editable ".[$(ROS),record,view]"
	@touch $@

$(VENV)/.ros: $(VENV)/.python setup.py
	$(RUN) -m pip install --quiet --disable-pip-version-check --editable ".[$(ROS),record,report,view,test]"
	@touch $@

$(VENV)/.docs: $(VENV)/.python setup.py
	$(RUN) -m pip install --quiet --disable-pip-version-check --editable ".[$(EXTRAS),export,docs]"
	@touch $@

$(VENV)/.test: $(VENV)/.python setup.py
	$(RUN) -m pip install --quiet --disable-pip-version-check --editable ".[$(EXTRAS),view,engines,export,docs,test]"
	@touch $@

clean:
	rm -rf $(VENV) .venv-jazzy demo_out view_out site build install log .pytest_cache .mypy_cache .ruff_cache .hypothesis *.egg-info
