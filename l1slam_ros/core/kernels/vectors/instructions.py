# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""LLVM's instructions on vectors, written one after the other as calls of Python."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

_DOUBLE = 8  # [bytes]


class Instructions:
    """
    Writes instructions on vectors of `lanes` doubles.

    A number is an integer, known when the loop is compiled (int) or when it runs. `zeros` is a
    vector.
    """

    def __init__(self, builder: Any, lanes: int) -> None:
        from llvmlite import ir

        self.lanes = lanes
        self._ir, self._builder = ir, builder
        self._number = ir.IntType(64)
        self._type = ir.VectorType(ir.DoubleType(), lanes)
        self.zeros = self._type([0.0] * lanes)

    def _as_number(self, number: Any) -> Any:
        if isinstance(number, int):
            return self._number(number)
        return self._builder.sext(number, self._number)

    def indices(self, count: int, rows: Any) -> list[Any]:
        """Return 0, 1, 2, ..., the last of the rows again where there are no more."""
        last = self._builder.sub(rows, self._number(1))
        return [self._builder.select(self._builder.icmp_signed('<', self._number(k), last),
                                     self._number(k), last) for k in range(count)]

    def times(self, number: Any, other: Any) -> Any:
        """Return the product of two numbers."""
        return self._builder.mul(self._as_number(number), self._as_number(other))

    def at(self, address: Any, index: Any) -> Any:
        """Return the address of an entry."""
        return self._builder.gep(address, [self._as_number(index)])

    def entry(self, address: Any, index: Any) -> Any:
        """Return an entry."""
        return self._builder.load(self.at(address, index))

    def variable(self, value: Any) -> Any:
        """Return a variable, which is kept in a register."""
        from numba.core import cgutils

        return cgutils.alloca_once_value(self._builder, value)

    def value(self, variable: Any) -> Any:
        """Return what a variable has by now."""
        return self._builder.load(variable)

    @contextmanager
    def range(self, count: Any, begin: int = 0) -> Iterator[Any]:
        """Repeat what is written for begin, begin + 1, ... below count."""
        from numba.core import cgutils

        with cgutils.for_range(self._builder, count, self._number(begin)) as loop:
            yield loop.index

    def spread(self, value: Any) -> Any:
        """Return a vector of one value, a double or a number."""
        undefined = self._ir.VectorType(value.type, self.lanes)(self._ir.Undefined)
        index = self._ir.IntType(32)
        only = self._builder.insert_element(undefined, value, index(0))
        return self._builder.shuffle_vector(
            only, undefined, self._ir.VectorType(index, self.lanes)([0] * self.lanes))

    def first(self, count: Any) -> Any:
        """Return a mask of the first few lanes."""
        lanes = self._ir.VectorType(self._number, self.lanes)(list(range(self.lanes)))
        return self._builder.icmp_signed('<', lanes, self.spread(self._as_number(count)))

    def load(self, address: Any, mask: Any = None) -> Any:
        """Return the vector that begins at an address, zero where it is masked out."""
        address = self._builder.bitcast(address, self._type.as_pointer())
        if mask is None:
            return self._builder.load(address, align=_DOUBLE)
        return self._masked('load', self._type, [address], mask, [self.zeros])

    def store(self, value: Any, address: Any, mask: Any = None) -> None:
        """Write those lanes of a vector that are not masked out."""
        address = self._builder.bitcast(address, self._type.as_pointer())
        if mask is None:
            self._builder.store(value, address, align=_DOUBLE)
        else:
            self._masked('store', self._ir.VoidType(), [value, address], mask, [])

    def _masked(self, what: str, result: Any, before: list[Any], mask: Any,
                after: list[Any]) -> Any:
        align = self._ir.IntType(32)(_DOUBLE)
        arguments = [*before, align, mask, *after]
        function = self._ir.FunctionType(result, [one.type for one in arguments])
        own = self._builder.module.declare_intrinsic(
            f'llvm.masked.{what}.v{self.lanes}f64.p0v{self.lanes}f64', fnty=function)
        return self._builder.call(own, arguments)

    def add(self, total: Any, left: Any, right: Any) -> None:
        """Add the product of two vectors to a variable, rounded once where the machine can."""
        product = self._builder.fmul(left, right, flags=('contract',))
        self._builder.store(self._builder.fadd(self._builder.load(total), product,
                                               flags=('contract',)), total)

    def less(self, value: Any, total: Any) -> Any:
        """Return a vector without what a variable has."""
        return self._builder.fsub(value, self._builder.load(total))

    def reduced(self, value: Any, left: Any, right: Any) -> Any:
        """Return a value less a product, rounded once where the machine can."""
        product = self._builder.fmul(left, right, flags=('contract',))
        return self._builder.fsub(value, product, flags=('contract',))

    def eliminated(self, row: Any, k: int, below: Any) -> Any:
        """Return a row less its entry k times a vector."""
        index = self._ir.VectorType(self._ir.IntType(32), self.lanes)([k] * self.lanes)
        entry = self._builder.shuffle_vector(row, row, index)
        return self.reduced(row, entry, below)

    def over(self, value: Any, divisor: Any) -> Any:
        """Return a quotient."""
        return self._builder.fdiv(value, divisor)

    def put(self, value: Any, address: Any) -> None:
        """Write an entry."""
        self._builder.store(value, address)

    def sum(self, left: Any, right: Any) -> Any:
        """Return the sum of two vectors."""
        return self._builder.fadd(left, right)

    def scaled(self, row: Any, factor: Any) -> Any:
        """Return the product of two vectors."""
        return self._builder.fmul(row, factor)

    def gathered(self, entries: list[Any]) -> Any:
        """Return a vector of doubles, one for each lane."""
        vector = self.zeros
        for k, entry in enumerate(entries):
            vector = self._builder.insert_element(vector, entry, self._ir.IntType(32)(k))
        return vector
