# SPDX-License-Identifier: Apache-2.0
"""Fixtures every test may ask for."""

from pathlib import Path

import numpy as np
import pytest


@pytest.fixture
def rng():
    """Return a generator with a fixed seed: a failing test fails again."""
    return np.random.default_rng(0)


@pytest.fixture(scope='session')
def datasets():
    """Return the folder of the paper's own graphs; they are not part of the repository."""
    folder = Path(__file__).parents[2] / 'shared' / 'datasets'
    if not folder.is_dir():
        pytest.skip('the public datasets are not on this machine')
    return folder
