# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Call every function of one module of the compiled core with arguments that do not fit.

Run as `python native_calls.py MODULE CALLS`: prints each call before it is made, so that the last
line says which one it was if the process ends in it. A call must return, or raise a TypeError (a
MemoryError for what is too large).
"""

import re
import sys
import types
from contextlib import suppress

import numpy as np

from l1slam_ros.core import native

_ARRAY = re.compile(r'a (?:C-contiguous )?(?:writable )?(\w+) array of (\d) dimensions')
_SIZES = (0, 1, 2, 3, 4, 6, 7)
# Of a kind each: what may be handed in in place of a number.
_NUMBERS = {'a number': (0.0, 1.0, -1.0, 1e300, np.nan, np.inf, 3, '1', None),
            'a whole number of 64 bits': (0, 1, 2, 3, 6, -1, 2**62, -2**63, 2**64, 1.5, None),
            'True or False': (True, False, 0, None)}


class Nothing:
    """Neither an array nor a number, nor true or false."""

    def __bool__(self):
        raise TypeError('neither')


def functions(module):
    """Return the functions of a module of the core, by name."""
    return {name: function for name, function in vars(getattr(native, module)).items()
            if isinstance(function, types.BuiltinFunctionType)}


def modules():
    """Return the names of the modules of the core."""
    return sorted(name for name, module in vars(native._portable).items()
                  if isinstance(module, types.ModuleType))


def names_of(function):
    """Return the names of the arguments of a function."""
    return [name for name in function.__text_signature__.strip('()').split(', ') if name]


def expected(function):
    """Return what each argument must be, as the errors of the function say it; empty: unknown."""
    kinds, fitting = [], []
    for name in names_of(function):
        rest = [Nothing()] * (len(names_of(function)) - len(fitting))
        try:
            function(*fitting, *rest)
            kind = ''
        except TypeError as error:
            said = re.match(rf'{function.__name__}: {name} must be (.*?), found ', str(error))
            kind = said[1] if said else ''
        kinds.append(kind)
        fitting.append(array(kind, (1,) * 9) if _ARRAY.match(kind)
                       else {'a number': 0.0, 'True or False': False}.get(kind, 0))
    return kinds


def array(kind, sizes):
    """Return an array that is what an error says is expected, of zeros."""
    dtype, dimensions = _ARRAY.match(kind).groups()
    return np.zeros(sizes[:int(dimensions)], dtype)


def argument(kind, rng, sizes):
    """
    Return what mostly has the type of an argument, and mostly sizes that others have, too.

    Arrays of whole numbers hold zeros: not every function checks each index in them.
    """
    if kind not in _NUMBERS and not _ARRAY.match(kind):
        dtype, dimensions = rng.choice(['float64', 'int64']), rng.integers(1, 4)
        kind = rng.choice([*_NUMBERS, f'a C-contiguous {dtype} array of {dimensions} dimensions'])
    if not _ARRAY.match(kind):
        numbers = _NUMBERS[kind]
        # Mostly one that fits, and is small.
        return numbers[rng.integers(4 if rng.random() < 0.9 else len(numbers))]
    given = array(kind, rng.choice(sizes if rng.random() < 0.8 else _SIZES, 9))
    if given.dtype == float and rng.random() < 0.5:
        given[...] = rng.standard_normal(given.shape)
    if given.dtype == float and rng.random() < 0.05:
        given.reshape(-1)[:1] = np.nan
    change = rng.integers(40)
    if change == 0:
        given.flags.writeable = False
    elif change == 1:
        given = np.repeat(given, 2, axis=-1)[..., ::2]
    elif change == 2:
        given = given.astype(rng.choice(['f4', 'i2', '>f8', 'c16', 'O', 'U3']))
    elif change == 3:
        given = given[None] if rng.random() < 0.5 else given.reshape(-1)
    elif change == 4:
        given = np.frombuffer(bytes(given.nbytes + 1), np.uint8)[1:].view(given.dtype)
    elif change == 5:
        given = given.tolist() if given.size else None
    return given


def shown(given):
    if not isinstance(given, np.ndarray):
        return repr(given)
    return f'{given.dtype}{given.shape}'


def main(module, calls):
    for name, function in functions(module).items():
        kinds = expected(function)
        rng = np.random.default_rng(0)
        for _ in range(calls):
            sizes = rng.choice(_SIZES, 2)
            given = [argument(kind, rng, sizes) for kind in kinds]
            if rng.random() < 0.05:
                given = given[:-1] if rng.random() < 0.5 else [*given, 0]
            print(f'{name}({", ".join(map(shown, given))})', flush=True)
            with suppress(TypeError, MemoryError):
                function(*given)


if __name__ == '__main__':
    main(sys.argv[1], int(sys.argv[2]))
