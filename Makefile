# SPDX-License-Identifier: Apache-2.0
# Needs Python >= 3.10 and make; everything else goes into .venv.

PYTHON ?= python3
VENV := .venv
STAMP := $(VENV)/installed

# A ROS that the shell has sourced, or another venv's ROS wheels, must not mix with this venv's.
unexport PYTHONPATH LD_LIBRARY_PATH AMENT_PREFIX_PATH _ROS_WHEELS_BOOTSTRAP_COMPLETE

.PHONY: demo test clean

demo: $(STAMP)
	$(VENV)/bin/python -m l1slam_ros.demo

test: $(STAMP)
	$(VENV)/bin/python -m pytest

clean:
	rm -rf $(VENV) build demo dist install log *.egg-info
	rm -rf .pytest_cache .ruff_cache .mypy_cache .hypothesis

# Editable, so that every process, whoever starts it, runs the checkout; an editable install
# leaves the data files out, so they are put in place by a command of their own. Setuptools
# warns at length about other uses of either.
$(STAMP): setup.py setup.cfg pyproject.toml package.xml $(wildcard config/* resource/* resource/run/*)
	test -x $(VENV)/bin/pip || $(PYTHON) -m venv $(VENV)
	$(VENV)/bin/python -m pip install --quiet --upgrade pip
	PYTHONWARNINGS=ignore $(VENV)/bin/python -m pip install --quiet --editable '.[ros,test]'
	PYTHONWARNINGS=ignore $(VENV)/bin/python setup.py --quiet install_data
	touch $@
