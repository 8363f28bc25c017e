# SPDX-License-Identifier: Apache-2.0
PYTHON ?= python3
VENV ?= .venv
RUN = $(VENV)/bin/python
# The ROS wheels: kilted (extra `ros`) or jazzy.
ROS ?= ros
EXTRAS = $(ROS),record,report,fast
# Nodes share the machine's clock with nobody; the rest runs on all cores.
PYTEST = $(RUN) -m pytest

.PHONY: demo test test-all lint format clean

demo: $(VENV)/.demo
	$(RUN) -m sst_ros demo

test: $(VENV)/.test lint
	$(PYTEST) --numprocesses auto --dist loadfile -m "not slow" --ignore test/ros
	$(PYTEST) -m "not slow" test/ros

test-all: $(VENV)/.test lint
	$(PYTEST) --numprocesses auto --dist loadfile --ignore test/ros --timeout 600
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

$(VENV)/.test: $(VENV)/.python setup.py
	$(RUN) -m pip install --quiet --disable-pip-version-check --editable ".[$(EXTRAS),engines,test]"
	@touch $@

clean:
	rm -rf $(VENV) demo_out build install log .pytest_cache .mypy_cache .ruff_cache .hypothesis *.egg-info
