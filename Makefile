# SPDX-License-Identifier: Apache-2.0
# Needs Python >= 3.10 with its headers and make; everything else goes into .venv.

PYTHON ?= python3
VENV := .venv
# What there is so far: the compiled core, on top of it what the demo needs, and the tests.
CORE := $(VENV)/compiled
STAMP := $(VENV)/installed
TESTS := $(VENV)/installed-tests
# Is there while packages are being installed. What an interrupted pip leaves half done it takes
# for complete the next time, so after that the environment is made anew.
HALF := $(VENV)/half-installed

# A ROS that the shell has sourced, or another venv's ROS wheels, must not mix with this venv's.
unexport PYTHONPATH LD_LIBRARY_PATH AMENT_PREFIX_PATH _ROS_WHEELS_BOOTSTRAP_COMPLETE
# Without bytecode each process parses a hundred modules: .2 s for a command, in hundreds of tests.
unexport PYTHONDONTWRITEBYTECODE

# Says what is being installed, and installs it. On a terminal pip shows its progress, in a log it
# would fill pages. What fails by itself is not half done.
define install
	@echo '$(1)'
	@touch $(HALF)
	@quiet=; test -t 1 || quiet=--quiet; PYTHONWARNINGS=ignore PIP_DISABLE_PIP_VERSION_CHECK=1 \
	  $(VENV)/bin/python -m pip install $$quiet $(2) || \
	  { test $$? -ge 128 || rm $(HALF); exit 1; }
endef

.PHONY: demo test clean anew

demo: $(STAMP)
	$(VENV)/bin/python -m l1slam_ros.ros.executables

# Three at a time also on two cores: many wait, for a node, a bag or a registry.
test: $(TESTS)
	$(VENV)/bin/python -m pytest -n 3 --dist worksteal

clean:
	rm -rf $(VENV) build demo dist install log *.egg-info l1slam_ros/core/native/*.so
	rm -rf .pytest_cache .ruff_cache .mypy_cache .hypothesis

METADATA := setup.py setup.cfg pyproject.toml package.xml

# Editable, so that every process, whoever starts it, runs the checkout.
$(CORE): $(METADATA) build_backend.py $(wildcard l1slam_ros/core/native/*.[ch]pp) \
		$(if $(wildcard $(HALF)),anew)
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10))' 2> /dev/null || { echo \
	  '$(PYTHON) is no Python 3.10 or newer; expected one: make PYTHON=python3.12' >&2; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' 2> /dev/null || { echo \
	  '$(PYTHON) makes no environments; expected its venv: apt install python3-venv' >&2; exit 1; }
	@$(PYTHON) -c 'from sysconfig import *; open(get_path("include") + "/Python.h")' \
	  2> /dev/null || { echo \
	  '$(PYTHON) has no headers; expected its Python.h: apt install python3-dev' >&2; exit 1; }
	@if test -e $(HALF) || ! $(VENV)/bin/python -m pip --version > /dev/null 2>&1; then \
	  echo 'Making a Python environment in $(VENV)'; \
	  rm -rf $(VENV) && mkdir $(VENV) && touch $(HALF) && $(PYTHON) -m venv $(VENV); fi
	$(call install,Compiling the core; if there is no compiler it is downloaded,--no-deps --editable .)
	@rm $(HALF) && touch $@

$(STAMP): $(METADATA) $(if $(wildcard $(HALF)),anew) | $(CORE)
	$(call install,Installing what the demo needs; the first time it is downloaded,'l1slam_ros[ros]')
	@rm $(HALF) && touch $@

# An editable install leaves the data files out, so they are put in place by a command of their
# own. Setuptools warns at length about other uses of it.
$(TESTS): $(STAMP) $(wildcard config/* launch/*.py resource/* resource/run/*)
	$(call install,Installing what the tests need,'l1slam_ros[test]')
	@PYTHONWARNINGS=ignore $(VENV)/bin/python setup.py --quiet install_data
	@rm $(HALF) && touch $@
