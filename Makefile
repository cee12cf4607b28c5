# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
#
# Every target does its own set-up: a virtual environment with ROS 2 from Python wheels.

PYTHON ?= python3.11
VENV ?= .venv
# A CPU build of torch. For a GPU: make TORCH_INDEX_URL=https://download.pytorch.org/whl/cu130
TORCH_INDEX_URL ?= https://download.pytorch.org/whl/cpu
PYTEST_ARGS ?=

BIN := $(abspath $(VENV))/bin
CONSTRAINTS := requirements/constraints.txt
COLCON_BASE := build/colcon
# The others run in `make test`.
COLCON_TESTS := test/ament test/config test/ros
COLCON := $(BIN)/colcon --log-base $(COLCON_BASE)/log
COLCON_PACKAGES := --base-paths . gam_relocalizer_msgs --build-base $(COLCON_BASE)/build
PIP := $(BIN)/python -m pip --disable-pip-version-check

# The environment stands alone: nothing of a sourced ROS installation leaks in.
unexport PYTHONPATH PYTHONHOME AMENT_PREFIX_PATH COLCON_PREFIX_PATH _ROS_WHEELS_BOOTSTRAP_COMPLETE
export PATH := $(BIN):$(PATH)
export RMW_IMPLEMENTATION := rmw_fastrtps_cpp
export ROS_AUTOMATIC_DISCOVERY_RANGE := LOCALHOST
export ROS_LOG_DIR := $(CURDIR)/build/ros_log

METADATA := setup.py setup.cfg pyproject.toml package.xml
INSTALLED := $(shell find config launch maps/demo resource scripts/node -type f 2>/dev/null)
INTERFACES := $(shell find gam_relocalizer_msgs pip_interfaces -type f)

VENV_DONE := $(VENV)/.done-venv
TORCH_DONE := $(VENV)/.done-torch
PACKAGE_DONE := $(VENV)/.done-package
INTERFACES_DONE := $(VENV)/.done-interfaces
TOOLS_DONE := $(VENV)/.done-tools

.DELETE_ON_ERROR:
.PHONY: help setup demo test lint colcon docs dist clean distclean

help:
	@echo 'make demo       relocalize a robot in the demo scene, live; results in build/demo'
	@echo 'make test       check the code and run all tests'
	@echo 'make lint       check the code only'
	@echo 'make docs       build the documentation into build/docs'
	@echo 'make colcon     build both packages as a workspace does, in build/colcon, and test them'
	@echo 'make dist       build wheels and the source distribution into dist'
	@echo 'make setup      only prepare the virtual environment ($(VENV))'
	@echo 'make clean      remove what was built'
	@echo 'make distclean  remove the virtual environment as well'

setup: $(INTERFACES_DONE)

demo: setup
	@echo '== demo: the results go to build/demo'
	$(BIN)/gam_relocalizer demo --out build/demo

test: lint
	@echo '== tests'
	ROS_PYTHON_CHECK_FIELDS=1 $(BIN)/python -m pytest $(PYTEST_ARGS)

lint: $(TOOLS_DONE)
	@echo '== lint'
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

colcon: $(TOOLS_DONE)
	@echo '== colcon'
	$(COLCON) build $(COLCON_PACKAGES) --install-base $(COLCON_BASE)/install
	$(COLCON) test $(COLCON_PACKAGES) --install-base $(COLCON_BASE)/install \
	  --pytest-args $(COLCON_TESTS)
	$(COLCON) test-result --test-result-base $(COLCON_BASE)/build --verbose

docs: $(TOOLS_DONE)
	@echo '== docs: build/docs/index.html'
	$(BIN)/sphinx-build --fail-on-warning --keep-going --quiet --conf-dir docs . build/docs

dist: $(TOOLS_DONE)
	@echo '== dist'
	$(BIN)/python -m build --no-isolation --outdir dist
	$(BIN)/python scripts/build_interfaces.py --wheel dist

clean:
	rm -rf build dist docs/api install log *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis
	find . -name __pycache__ -not -path './$(VENV)/*' -prune -exec rm -rf {} +

distclean: clean
	rm -rf $(VENV)

$(VENV_DONE): $(CONSTRAINTS)
	@echo '[1/4] creating the virtual environment $(VENV)'
	@command -v $(PYTHON) >/dev/null || { echo 'error: no $(PYTHON) on this machine; install it,' \
	  'or name another: make PYTHON=/path/to/python3.11' >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python scripts/build_interfaces.py --check
	$(PIP) install --constraint $(CONSTRAINTS) setuptools
	@touch $@

$(TORCH_DONE): $(VENV_DONE)
	@echo '[2/4] installing torch'
	@if $(BIN)/python -c 'import urllib.request as r; r.urlopen("$(TORCH_INDEX_URL)/torch/", timeout=5)' \
	    2>/dev/null; then \
	  echo 'from $(TORCH_INDEX_URL)'; \
	  $(PIP) install --constraint $(CONSTRAINTS) --no-deps --index-url $(TORCH_INDEX_URL) torch; \
	else \
	  echo '$(TORCH_INDEX_URL) cannot be reached: taking the build of the package registry'; \
	  $(PIP) install --constraint $(CONSTRAINTS) --no-deps torch; \
	fi
	@touch $@

$(PACKAGE_DONE): $(TORCH_DONE) $(CONSTRAINTS) $(METADATA) $(INSTALLED)
	@echo '[3/4] installing gam_relocalizer, ROS 2 and everything else'
	$(PIP) install --constraint $(CONSTRAINTS) --no-build-isolation --editable '.[ros,build,demo,view]'
	@# An editable installation leaves out the data files: launch files, the demo map, lib/.../node.
	$(BIN)/python -W ignore setup.py --quiet install_data --install-dir $(VENV)
	@touch $@

$(INTERFACES_DONE): scripts/build_interfaces.py $(INTERFACES) $(TORCH_DONE) | $(PACKAGE_DONE)
	@echo '[4/4] building the ROS interface packages'
	$(BIN)/python scripts/build_interfaces.py
	@touch $@

# What only developers need; `make demo` does without.
$(TOOLS_DONE): $(CONSTRAINTS) $(METADATA) | $(INTERFACES_DONE)
	@echo '[tools] installing what tests and documentation need'
	$(PIP) install --constraint $(CONSTRAINTS) --no-build-isolation --editable '.[test,docs]'
	@touch $@
