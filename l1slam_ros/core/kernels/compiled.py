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

A loop is compiled once per machine. Its machine code is kept (see `kept`), and called without
numba if the arguments have types for which it was compiled ahead. Otherwise, or if nothing could
be kept, numba makes the call; its cache is beside the package, or in the user's cache folder if
that is read-only. To read a loop from that cache takes some 4 ms, however small it is, so loops
that follow each other are written as one loop.

A loop may call only functions of its own module: neither cache notices changes in other modules.
"""

from collections.abc import Callable
from contextlib import suppress
from functools import update_wrapper
from importlib import import_module
from pathlib import Path
from typing import Any

from l1slam_ros.core.kernels.kept import link, objects

Kernel = Callable[..., Any]


class Loop:
    """
    A function of arrays and numbers that is compiled.

    It runs without the interpreter's lock, so that other threads go on, unless it is brief.

    Sums may be reordered (that is what lets them be vectorised); NaN and infinity keep their
    meaning. Where no folder can be written the result is not kept, and every process compiles.

    Parameters
    ----------
    py_func : what to compile
    takes : the types of its arguments in numba's words, so that it can be compiled without them;
    f8[:, ::1] is an array of doubles, rows one after the other. Several: one version for each
    takes_in_space : those of the versions that only graphs in space need
    brief : it keeps the interpreter's lock. Whoever lets go of it, for however short a time, may
        have to wait until a thread that has taken it meanwhile lets go of it in turn
    as_written : the functions of its module are optimised where they are called, and not before,
        one by one. Of tiles that are written by vectors that leaves more in registers

    Attributes
    ----------
    linked : versions of kept machine code that this process has called, or made ready

    """

    def __init__(self, py_func: Kernel, takes: tuple[str, ...] = (),
                 takes_in_space: tuple[str, ...] = (), brief: bool = False,
                 as_written: bool = False) -> None:
        update_wrapper(self, py_func)
        objects.note_import(_source(py_func))
        self.py_func = py_func
        self.takes = takes
        self.takes_in_space = takes_in_space
        self.brief = brief
        self.as_written = as_written
        self.linked: tuple[link.Linked, ...] = ()
        self._sought: dict[bool, bool] = {}
        self._dispatcher: Any = None

    def __call__(self, *arguments: Any) -> Any:
        """Call what was compiled for arguments of these types."""
        tried = self.linked
        for count, fit, function in tried:
            if len(arguments) == count and fit(*arguments):
                return function(*arguments)
        for space in False, True:
            if space not in self._sought:
                self.seek(space)
            if self.linked is not tried:
                return self(*arguments)
        return self.dispatcher(*arguments)

    def seek(self, space: bool) -> bool:
        """Link what is kept of the versions for space, or of the others; False: nothing is."""
        with link.lock:
            if space not in self._sought:
                takes = self.takes_in_space if space else self.takes
                of = self.py_func
                found = link.link(of.__module__, of.__name__, space) if takes else []
                self.linked = (*self.linked, *found) if found else self.linked
                self._sought[space] = len(found) == len(takes)
        return self._sought[space]

    @property
    def by_numba(self) -> bool:
        """Whether this process has asked numba for it."""
        return self._dispatcher is not None

    @property
    def dispatcher(self) -> Any:
        """The loop as numba has it, which is imported now at the latest."""
        with link.lock:
            if self._dispatcher is None:
                self._dispatcher = _dispatcher(self.py_func, self.brief)
        return self._dispatcher

    @property
    def _numba_type_(self) -> Any:
        """What numba takes it for where another loop calls it."""
        return self.dispatcher._numba_type_


compiled = Loop


def loop(*takes: str, space: tuple[str, ...] = (), brief: bool = False,
         as_written: bool = False) -> Callable[[Kernel], Loop]:
    """Return what makes a function that the interpreter calls a `Loop`."""
    return lambda function: Loop(function, takes, space, brief, as_written)


def make_ready(kernel: Loop, space: bool) -> None:
    """Link the versions of a loop, or where they are not kept have numba read or compile them."""
    if not kernel.seek(space):
        for takes in kernel.takes_in_space if space else kernel.takes:
            _compile(kernel.dispatcher, takes)


def keep(step: str) -> list[str]:
    """Have what is not kept yet of a step compiled, and kept; return the files that keep it."""
    if files := objects.files(step):
        return files
    from l1slam_ros.core.kernels.kept import make

    module = import_module(objects.module_of(step))
    attribute = 'takes_in_space' if step.endswith(objects.SPACE) else 'takes'
    kept, folders = {}, set()
    kernels = {name: kernel for name, kernel in vars(module).items()
               if isinstance(kernel, Loop) and not _is_own(name)}
    as_written = any(kernel.as_written for kernel in kernels.values())
    with make.code_only_of(kernels.keys(), as_written):
        for of, kernel in kernels.items():
            if takes := getattr(kernel, attribute):
                dispatcher = kernel.dispatcher
                # What numba reads back it does not give away.
                dispatcher._cache.load_overload = lambda *_: None
                kept[of] = [_compile(dispatcher, one) for one in takes]
                folders.add(dispatcher.stats.cache_path)
    name = module.__name__.rpartition('.')[2]
    beside = sorted(str(file) for folder in folders - {None}
                    for file in Path(folder).glob(f'{name}.*.nbi'))
    if not beside:
        return []
    with suppress(Exception):  # as another numba may have it, or another system
        apart = {of: list(map(make.taken_apart, versions)) for of, versions in kept.items()}
        return [objects.write(step, apart, beside), *beside]
    return beside


def _compile(dispatcher: Any, takes: str) -> Any:
    """Compile or read a version of a loop; return what numba knows of it."""
    from numba.core.sigutils import normalize_signature

    # As the types of a call, for these are what the cache goes by.
    types = tuple(normalize_signature(takes)[0])
    dispatcher.compile(types)
    return dispatcher.overloads[types]


def _dispatcher(function: Kernel, brief: bool) -> Any:
    """Return a function as numba has it; brief : see `Loop`."""
    import numba

    _spare_blas()
    own = _is_own(function.__name__)
    # After an upgrade numba would keep what this process has under the source that is there now.
    as_imported = objects.is_as_imported(_source(function))
    options = {'nogil': not brief, 'error_model': 'numpy',
               'fastmath': {'contract', 'reassoc', 'nsz'},
               'no_cfunc_wrapper': True, 'no_cpython_wrapper': own}
    try:
        return numba.njit(cache=as_imported and not own, **options)(function)
    except RuntimeError:
        return numba.njit(**options)(function)


def _is_own(name: str) -> bool:
    """Tell whether only its own module calls a function, by its name."""
    return name.startswith('_')


def _source(function: Kernel) -> Path:
    return Path(function.__code__.co_filename)


def _spare_blas() -> None:
    """
    Let numba not import SciPy's linear algebra to find out that it is there.

    It would before it reads its first loop, which takes a fifth of a second; no loop uses it.
    """
    from numba.np import linalg

    asked = linalg.ensure_blas
    linalg.ensure_blas = lambda: None
    try:
        from numba.np import arraymath
    finally:
        linalg.ensure_blas = asked
    arraymath.ensure_blas = asked
