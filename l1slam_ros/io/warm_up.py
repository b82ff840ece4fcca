# SPDX-License-Identifier: Apache-2.0
"""
Making the compiled loops ready before they are needed.

A loop is compiled at its first use after an installation, and later read from the cache. The
modules of `kernels` know not of each other, so each can be made ready in a process of its own.
"""

import importlib
from collections.abc import Callable, Sequence

from l1slam_ros.core.geometry.manifold import Manifold

# What a sparse graph is solved by, what false loops are told by, what a dense graph is solved by,
# what keeps up with a graph that grows: modules of `kernels`, those first that take long to
# compile.
SPARSE = ('cholesky', 'substitution', 'ordering', 'symbolic', 'blocks', 'interior_point', 'se2')
JUDGEMENT = ('prediction',)
DENSE = ('halpern',)
ONLINE = ('border',)
STEPS = ('halpern', *SPARSE[:2], *JUDGEMENT, *ONLINE, *SPARSE[2:])
# What poses in space need besides; after the colon: the versions for them of that module's loops.
_SPACE = ':space'
_IN_SPACE = {'halpern': f'halpern{_SPACE}', 'cholesky': f'cholesky{_SPACE}',
             'blocks': f'blocks{_SPACE}', 'se2': 'se3'}
STEPS_IN_SPACE = tuple(_IN_SPACE.values())


def with_space(steps: tuple[str, ...], manifold: Manifold) -> tuple[str, ...]:
    """Return the steps, and where the poses are not in the plane, what they need besides."""
    if manifold.NAME == 'SE2':
        return steps
    return (*(_IN_SPACE[step] for step in steps if step in _IN_SPACE), *steps)


def warm_up(report: Callable[[str], None] = lambda step: None,
            steps: Sequence[str] = STEPS) -> None:
    """Make loops ready in this process; report : called with each of the steps once it is."""
    for step in steps:
        make_ready(step)
        report(step)


def make_ready(step: str) -> str:
    """Compile the loops of one step, or read them; return where they are kept, empty: nowhere."""
    from l1slam_ros.core.kernels import compiled

    module = importlib.import_module(f'l1slam_ros.core.kernels.{module_of(step)}')
    folder = ''
    for kernel in list(vars(module).values()):
        if hasattr(kernel, 'takes'):
            folder = compiled.make_ready(kernel, step.endswith(_SPACE)) or folder
    return folder


def module_of(step: str) -> str:
    """Return the module of `kernels` that a step makes ready."""
    return step.removesuffix(_SPACE)
