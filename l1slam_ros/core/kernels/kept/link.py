# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Functions made of kept machine code, by llvmlite alone.

This does what numba does with an object file of its cache, and compares the types of a call
itself. If anything is unexpected there is no function, and the caller uses numba.
"""

import builtins
import ctypes
import functools
import importlib.machinery
import importlib.util
import pickle
import sys
import threading
from collections.abc import Callable
from types import ModuleType
from typing import Any

import numpy as np

from l1slam_ros.core.kernels.kept import objects

# Types of numbers that numba takes for such, too.
_NUMBERS = {'int64': frozenset((int, np.int64)), 'float64': frozenset((float, np.float64)),
            'float32': frozenset((np.float32,))}
# A version: how many arguments it has, whether it takes these, and itself.
Linked = tuple[int, Callable[..., bool], Callable[..., Any]]

# Files that were read, by step; what is linked, as it must never be freed.
_read: dict[str, dict[str, list[objects.Kept]]] = {}
_lasting: list[object] = []
_modules: dict[str, ModuleType] = {}
# Reentrant: a signal's handler may call a loop while one is linked.
lock = threading.RLock()


def link(module: str, name: str, space: bool) -> list[Linked]:
    """Return the versions of a loop that are kept, those for space or the others; maybe none."""
    step = objects.step_of(module, space)
    with lock:
        try:
            if step not in _read:
                _read[step] = objects.read(step)
            return [_linked(sys.modules[module], name, kept)
                    for kept in _read[step].get(name, [])]
        except Exception:  # whatever a file, or another numba than was thought of, has in store
            _read[step] = {}
            return []


def _linked(module: ModuleType, name: str, kept: objects.Kept) -> Linked:
    from llvmlite import binding

    helpers = _helpers()
    # One engine each: names inside of the code are unique in the process that compiled it only.
    machine = binding.Target.from_default_triple().create_target_machine()
    engine = binding.create_mcjit_compiler(binding.parse_assembly(''), machine)
    for symbol in kept.missing:
        # LLVM ends the process at a name that it does not know.
        if binding.address_of_symbol(symbol) is None:
            raise ImportError(symbol)
    code = binding.ObjectFileRef.from_data(kept.code)
    engine.add_object_file(code)
    _lasting.extend([engine, code])
    engine.finalize_object()
    environment = helpers['_dynfunc'].Environment(vars(module))
    environment.consts.extend(map(np.dtype, kept.constants))
    where = engine.get_global_value_address(kept.environment)
    entry = engine.get_function_address(kept.entry)
    if not where or not entry:
        raise ImportError(kept.entry)
    ctypes.c_void_p.from_address(where).value = id(environment)
    function = helpers['_dynfunc'].make_function(module, name, '', entry, environment, (engine,))
    return len(kept.takes), _fit(kept.takes), function


def _fit(takes: list[tuple[str, str, int]]) -> Callable[..., bool]:
    """
    Return a function that tells whether arguments are of these types, see `Kept`.

    It is made as one expression: to go through the arguments takes four times as long, which is
    longer than most loops that an update calls.
    """
    names = [f'a{place}' for place in range(len(takes))]
    types: dict[str, object] = {'array': np.ndarray}
    tests = []
    for a, (what, entries, count) in zip(names, takes, strict=True):
        of = f'of_{a}'
        types[of] = np.dtype(entries) if what == 'array' else _NUMBERS[entries]
        if what == 'array':  # in C order, aligned and writable
            tests.append(f'type({a}) is array and {a}.ndim == {count:d} and '
                         f'({a}.dtype is {of} or {a}.dtype == {of}) and {a}.flags.carray')
        elif what == 'tuple':
            tests.append(f'type({a}) is tuple and len({a}) == {count:d} and '
                         f'{of}.issuperset(map(type, {a}))')
        else:
            tests.append(f'type({a}) in {of}')
    return eval(f'lambda {", ".join(names)}: {" and ".join(tests)}', types)


def _helpers() -> dict[str, ModuleType]:
    """Return numba's extension modules by their own names; makes known what they define."""
    from llvmlite import binding

    if not _modules:
        loaded = 'numba' in sys.modules
        own = {name.rpartition('.')[2]: importlib.import_module(name) if loaded
               else _extension(name, str(path)) for name, path in objects.helpers().items()}
        if not loaded:
            _teach_to_unpickle(own['_helperlib'].c_helpers['unpickle'])
            own['_nrt_python'].memsys_use_cpython_allocator()
        _tell(own)
        binding.initialize_native_target()
        binding.initialize_native_asmprinter()
        binding.check_jit_execution()
        _modules.update(own)
    return _modules


def _tell(modules: dict[str, ModuleType]) -> None:
    """Make known to LLVM what numba would before it reads a loop."""
    from llvmlite import binding

    binding.add_symbol('_Py_NoneStruct', id(None))
    for error in vars(builtins).values():
        if isinstance(error, type) and issubclass(error, BaseException):
            binding.add_symbol(f'PyExc_{error.__name__}', id(error))
    for name, prefix in ('_helperlib', 'numba_'), ('_dynfunc', 'numba_'), ('_nrt_python', 'NRT_'):
        for helper, address in modules[name].c_helpers.items():
            plain = name == '_nrt_python' and helper.startswith('_')
            binding.add_symbol(helper if plain else prefix + helper, address)


def _extension(name: str, path: str) -> ModuleType:
    """
    Return an extension module of a package that is not imported.

    It is known under its full name to Python, that an import of the package later does not set up
    a second time what may be in use.
    """
    loader = importlib.machinery.ExtensionFileLoader(name, path)
    spec = importlib.util.spec_from_file_location(name, path, loader=loader)
    assert spec
    try:
        module = importlib.util.module_from_spec(spec)
        loader.exec_module(module)
    finally:
        sys.modules.pop(name, None)
    return module


def _teach_to_unpickle(address: int) -> None:
    """
    Have numba's C code unpickle by a function of ours.

    A loop that returns an array asks that code for the array's type. To find a function of numba's
    it would import numba at its first call; by this it has found one that does the same.
    """
    name = 'numba.core.serialize'
    stand_in = ModuleType(name)
    stand_in._numba_unpickle = _unpickled  # type: ignore[attr-defined]

    def found(*_: object) -> None:
        if 'numba' in sys.modules:
            raise ImportError('another thread imports numba')
        sys.modules[name] = stand_in

    # C code imports by the built-in function of whoever calls it: no other thread sees this one.
    call = ctypes.PYFUNCTYPE(ctypes.py_object, ctypes.c_char_p, ctypes.c_int, ctypes.c_char_p)
    data = pickle.dumps(None)
    scope = {'__builtins__': {'__import__': found}, 'unpickle': call(address),
             'what': (data, len(data), bytes(20))}
    try:
        exec('unpickle(*what)', scope)
    finally:
        if sys.modules.get(name) is stand_in:
            del sys.modules[name]
    _unpickled.cache_clear()


@functools.cache
def _unpickled(address: int, data: bytes, digest: bytes) -> object:
    """
    Return the object that machine code has pickled at an address, always the same one.

    It is called in the midst of machine code, which makes nothing of a signal's exception: once
    it is known, it is found without the interpreter, where no handler of a signal can run.
    """
    return pickle.loads(data)
