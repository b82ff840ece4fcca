# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
The decorators of every compiled loop.

A loop is compiled once per machine: numba keeps the result beside the package, or where that is
read-only in the user's cache folder. Reading one back takes some 4 ms, however small it is, so
loops that follow each other are one loop.

A loop may call only functions of its own module: of others numba would not see that they changed.
"""

from collections.abc import Callable
from typing import Any

import numba
from numba.core.sigutils import normalize_signature
from numba.np import linalg

Kernel = Callable[..., Any]
# Of blocks of whole poses in the plane, and of parts of poses; see `cholesky`.
ANY_SIZE = ('UniTuple(i8, 3)', 'f8[::1]')


def compiled(function: Kernel) -> Kernel:
    """
    Compile a function of arrays and numbers; it runs without the interpreter's lock.

    Sums may be reordered (that is what lets them be vectorised); NaN and infinity keep their
    meaning. Where no folder can be written the result is not kept, and every process compiles.
    """
    options = {'nogil': True, 'error_model': 'numpy', 'fastmath': {'contract', 'reassoc', 'nsz'},
               'no_cfunc_wrapper': True, 'no_cpython_wrapper': function.__name__.startswith('_')}
    try:
        kernel: Kernel = numba.njit(cache=True, **options)(function)
    except RuntimeError:
        kernel = numba.njit(**options)(function)
    return kernel


def loop(*takes: str, space: tuple[str, ...] = ()) -> Callable[[Kernel], Kernel]:
    """
    Compile, as `compiled`, a function that the interpreter calls.

    takes : the types of its arguments in numba's words, so that it can be compiled without them;
    f8[:, ::1] is an array of doubles, rows one after the other. Several: one version for each;
    space : those of the versions that only graphs in space need
    """
    def decorate(function: Kernel) -> Kernel:
        kernel: Any = compiled(function)
        kernel.takes, kernel.takes_in_space = takes, space
        return kernel

    return decorate


def for_sizes(takes: str, plane: tuple[str, ...] = ('UniTuple(i8, 3)',)) -> Callable[
        [Kernel], Kernel]:
    """Return `loop` for functions whose last argument is a tuple as long as a block has rows."""
    return loop(*(f'({takes}, {size})' for size in plane),
                space=(f'({takes}, UniTuple(i8, 6))',))


def make_ready(kernel: Any, space: bool) -> str:
    """Compile a loop, or read it from the cache; return the cache's folder, empty: none."""
    for takes in kernel.takes_in_space if space else kernel.takes:
        # As the types of a call, for these are what the cache goes by.
        kernel.compile(tuple(normalize_signature(takes)[0]))
    return kernel.stats.cache_path or ''


def _spare_blas() -> None:
    """
    Let numba not import SciPy's linear algebra to find out that it is there.

    It would before it reads its first loop, which takes a fifth of a second; no loop uses it.
    """
    asked = linalg.ensure_blas
    linalg.ensure_blas = lambda: None
    try:
        from numba.np import arraymath
    finally:
        linalg.ensure_blas = asked
    arraymath.ensure_blas = asked


_spare_blas()
