# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""What numba compiles, taken apart so that it runs without numba; used where numba compiles."""

import struct
from collections.abc import Iterator, Set
from contextlib import contextmanager
from typing import Any

from numba import types
from numba.core import codegen
from numba.np import numpy_support

from l1slam_ros.core.kernels.kept import objects

# Of an object file in ELF, 64 bits, little-endian: a section, a symbol.
_HEAD = '<16sHHIQQQIHHHHHH'
_SECTION = '<IIQQQQIIQQ'
_SYMBOL = '<IBBHQQ'
_SYMBOLS = 2  # type of the section with the symbols
# Numba's own modules, which it calls itself.
_OWN = frozenset(('nrt', 'multi3'))


@contextmanager
def code_only_of(entries: Set[str], as_written: bool) -> Iterator[None]:
    """
    Let numba make machine code of no other functions while it compiles these.

    It would of each function that one of these calls, too, though the caller has a copy of it, and
    that takes a tenth of the time. as_written : see `compiled.Loop`
    """
    library, owner = codegen.JITCodeLibrary, codegen.JITCPUCodegen
    optimise, finish = library._optimize_functions, library._finalize_final_module
    set_environment = owner.set_env

    def left(self: Any, module: Any) -> None:
        module.data_layout = self._codegen._data_layout

    def finished(self: Any) -> None:
        if self.name in entries or self.name in _OWN:
            finish(self)
        else:
            self._finalize_dynamic_globals()
            self._finalized = True

    def set_where_it_is(self: Any, name: str, environment: Any) -> None:
        if self._engine.is_symbol_defined(name):
            set_environment(self, name, environment)

    library._optimize_functions = left if as_written else optimise
    library._finalize_final_module, owner.set_env = finished, set_where_it_is
    try:
        yield
    finally:
        library._optimize_functions, library._finalize_final_module = optimise, finish
        owner.set_env = set_environment


def taken_apart(compiled: Any) -> objects.Kept:
    """Return what is to be kept of a version; raises anything if that cannot be."""
    code = compiled.library._get_compiled_object()
    described, constants = compiled.fndesc, compiled.environment.consts
    if any(type(constant).__module__ not in ('numpy', 'numpy.dtypes') for constant in constants):
        raise TypeError('keeps other objects than types of arrays')
    return objects.Kept([_described(argument) for argument in compiled.signature.args],
                        described.llvm_cpython_wrapper_name, described.env_name,
                        [constant.str for constant in constants], _undefined(code), code)


def _described(argument: Any) -> tuple[str, str, int]:
    if isinstance(argument, types.Array):
        if argument.layout != 'C' or not argument.mutable or not argument.aligned:
            raise TypeError(argument)
        return 'array', numpy_support.as_dtype(argument.dtype).str, argument.ndim
    if isinstance(argument, types.UniTuple):
        return 'tuple', _number(argument.dtype), argument.count
    return 'number', _number(argument), 1


def _number(number: Any) -> str:
    if number not in (types.int64, types.float64, types.float32):
        raise TypeError(number)
    return str(number)


def _undefined(code: bytes) -> list[str]:
    """Return the names that an object file of Linux leaves to others to define."""
    _, _, _, version, _, _, begin, _, _, _, _, size, count, _ = struct.unpack_from(_HEAD, code)
    if code[:6] != b'\x7fELF\x02\x01' or size != struct.calcsize(_SECTION):
        raise ValueError('no object file in ELF of 64 bits')
    sections = [struct.unpack_from(_SECTION, code, begin + k * size) for k in range(count)]
    names = []
    for section in sections:
        if section[1] == _SYMBOLS:
            strings = sections[section[6]][4]
            for at in range(section[4], section[4] + section[5], struct.calcsize(_SYMBOL)):
                name, _, _, index, _, _ = struct.unpack_from(_SYMBOL, code, at)
                if name and not index:
                    first = strings + name
                    names.append(code[first:code.index(b'\0', first)].decode())
    return names
