# SPDX-License-Identifier: Apache-2.0
"""
Making the compiled loops ready before they are needed.

A loop is compiled at its first use after an installation, and later read from the cache. The
modules of `kernels` know not of each other, so each can be made ready in a process of its own.
"""

import importlib
from collections.abc import Callable

# What a sparse graph is solved by, what false loops are told by, what a dense graph is solved by,
# what keeps up with a graph that grows: modules of `kernels`, those first that take long to
# compile.
SPARSE = ('cholesky', 'substitution', 'ordering', 'symbolic', 'blocks', 'interior_point', 'se2')
JUDGEMENT = ('prediction',)
DENSE = ('halpern', 'tiles')
ONLINE = ('border',)
STEPS = ('halpern', *SPARSE[:2], *JUDGEMENT, *ONLINE, *SPARSE[2:], 'tiles')


def warm_up(report: Callable[[str], None] = lambda step: None) -> None:
    """Make all loops ready in this process; report : called with each of `STEPS` once it is."""
    for step in STEPS:
        make_ready(step)
        report(step)


def make_ready(step: str) -> str:
    """Compile the loops of one step, or read them; return where they are kept, empty: nowhere."""
    from l1slam_ros.core.kernels import compiled

    module = importlib.import_module(f'l1slam_ros.core.kernels.{step}')
    folder = ''
    for kernel in list(vars(module).values()):
        if hasattr(kernel, 'takes'):
            folder = compiled.make_ready(kernel)
    return folder
