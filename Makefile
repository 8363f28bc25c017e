# SPDX-License-Identifier: Apache-2.0
PYTHON ?= python3
VENV ?= .venv
RUN = $(VENV)/bin/python
# The ROS wheels: kilted (extra `ros`) or jazzy.
ROS ?= ros
EXTRAS = $(ROS),record,plot,fast,proof
PYTEST = $(RUN) -m pytest
PARALLEL = --numprocesses auto --dist loadfile
# The tests of the nodes wait two thirds of their time, and each worker imports ROS.
PARALLEL_NODES = --numprocesses $$(($$(nproc) + 1)) --dist loadfile --no-loadscope-reorder
# Python compiles what is imported; pip would compile all 15,000 files.
INSTALL = $(RUN) -m pip install --quiet --disable-pip-version-check --no-compile
# Where the environment forbids to keep it, each of some hundred processes compiles NumPy anew.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help demo demo-feedforward demo-identify demo-sweep docs paper view test test-all test-jazzy test-ros test-search test-slow lint lint-style lint-types lint-words format clean

help:  ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "make %-18s%s\n", $$1, $$2}' $(MAKEFILE_LIST)

demo: $(VENV)/.demo  ## run the paper's examples through the nodes; results in demo_out
	$(RUN) -m sst_ros demo --force

demo-feedforward: $(VENV)/.demo  ## follow a motion with a controller; results in demo_out/feedforward
	$(RUN) -m sst_ros demo feedforward --force

demo-sweep: $(VENV)/.sweep  ## 100,000 runs with random inertias and starts: table and pictures in sweep_out
	$(RUN) -m sst_ros sweep examples/monte_carlo.yaml --out sweep_out
	$(RUN) -m sst_ros sweep plot sweep_out

demo-identify: $(VENV)/.demo  ## identify a wrong model from a recorded motion; results in demo_out/identify
	$(RUN) -m studies.identification --force

paper: $(VENV)/.paper  ## draw Figs. 8 to 14 of the paper: nodes, continuous solution, Pinocchio; results in paper_out
	$(RUN) -m studies.paper --force

docs: $(VENV)/.docs  ## build the documentation into site, in a folder named after the version
	@site=site/$$($(RUN) -c 'print(__import__("sst_ros").__version__)') && \
	  $(RUN) -m sphinx --fail-on-warning --keep-going --quiet --builder html docs $$site && \
	  rm -rf site/jupyter_execute && \
	  echo "open file://$(CURDIR)/$$site/index.html"

view: $(VENV)/.view  ## show a simulation in the browser
	@$(RUN) -m sst_ros view --scene swing --open

test: $(VENV)/.test lint  ## run the tests, without the slow ones
	$(PYTEST) $(PARALLEL) $(COVERAGE) -m "not slow" --ignore test/ros
	$(PYTEST) $(PARALLEL_NODES) -m "not slow and not breadth" test/ros

test-jazzy:  ## run the tests of the nodes with ROS 2 Jazzy, in an environment of their own
	$(MAKE) test-ros VENV=.venv-jazzy ROS=jazzy

test-ros: $(VENV)/.ros  ## run the tests of the nodes
	$(PYTEST) $(PARALLEL_NODES) -m "not slow" test/ros

# By path: pytest would leave the files with few tests, whose tests are the longest, for the end, to one processor.
test-slow: $(VENV)/.test $(VENV)/.docs  ## run the slow tests: sweeps, long pages, packages, fresh environments
	$(PYTEST) $(PARALLEL) --no-loadscope-reorder -m "slow and not search" --ignore test/ros --timeout 600
	$(PYTEST) $(PARALLEL_NODES) -m "slow or breadth" test/ros --timeout 600

test-search: $(VENV)/.test  ## run the random searches: proofs of hundreds of scenes, fits of hundreds of recordings
	$(PYTEST) $(PARALLEL) --no-loadscope-reorder -m search

# Lines and branches that the tests without nodes pass, those of child processes not counted.
test-all: COVERAGE = --cov sst_ros --cov-branch --cov-report term
test-all: test test-slow test-jazzy  ## run all tests but the random searches, and print which share of lines and branches they pass

lint: $(VENV)/.test  ## check style and types
	@$(MAKE) --no-print-directory --jobs --keep-going --output-sync lint-style lint-types lint-words

lint-style:
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .

lint-types:
	$(VENV)/bin/mypy

lint-words:
	$(VENV)/bin/codespell

format: $(VENV)/.test  ## format the source
	$(VENV)/bin/ruff check --fix .
	$(VENV)/bin/ruff format .

$(VENV)/.python:
	@$(PYTHON) -c 'import sys; v = sys.version_info[:2]; \
	  sys.exit(None if (3, 10) <= v <= (3, 13) else f"sst_ros needs Python 3.10 to 3.13 (the ROS wheels), this is {v[0]}.{v[1]}: make PYTHON=python3.12 ...")'
	$(PYTHON) -m venv $(VENV)
	$(INSTALL) --upgrade pip
	@touch $@

$(VENV)/.demo: $(VENV)/.python setup.py
	$(INSTALL) --editable ".[$(EXTRAS)]"
	@touch $@

$(VENV)/.paper: $(VENV)/.python setup.py
	$(INSTALL) --editable ".[$(EXTRAS),engines]"
	@touch $@

$(VENV)/.sweep: $(VENV)/.python setup.py
	$(INSTALL) --editable ".[sweep,plot]"
	@touch $@

$(VENV)/.view: $(VENV)/.python setup.py
	$(INSTALL) --editable ".[$(ROS),record,view]"
	@touch $@

$(VENV)/.ros: $(VENV)/.python setup.py
	$(INSTALL) --editable ".[$(ROS),record,plot,view,test]"
	@touch $@

$(VENV)/.docs: $(VENV)/.python setup.py
	$(INSTALL) --editable ".[$(EXTRAS),docs]"
	@touch $@

$(VENV)/.test: $(VENV)/.python setup.py
	$(INSTALL) --editable ".[$(EXTRAS),view,engines,cluster,test,coverage]"
	@touch $@

clean:  ## remove environments and results
	rm -rf $(VENV) .venv-jazzy demo_out view_out paper_out sweep_out site build install log .pytest_cache .mypy_cache .ruff_cache .hypothesis *.egg-info
