# SPDX-License-Identifier: Apache-2.0
"""
The decorator of every compiled loop.

The modules beside this one import numba, which takes half a second, so the core imports them
where it calls them. A loop is compiled at its first call, once per machine: numba keeps the result
beside the package, or where that is read-only in the user's cache folder.
"""

from collections.abc import Callable
from typing import Any

import numba

Kernel = Callable[..., Any]


def compiled(function: Kernel) -> Kernel:
    """
    Compile a function of arrays and numbers; it runs without the interpreter's lock.

    Sums may be reordered (that is what lets them be vectorised); NaN and infinity keep their
    meaning. Where no folder can be written the result is not kept, and every process compiles.
    """
    options = {'nogil': True, 'error_model': 'numpy', 'fastmath': {'contract', 'reassoc', 'nsz'}}
    try:
        kernel: Kernel = numba.njit(cache=True, **options)(function)
    except RuntimeError:
        kernel = numba.njit(**options)(function)
    return kernel
