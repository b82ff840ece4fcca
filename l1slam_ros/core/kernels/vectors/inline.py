# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
What lets a loop call instructions that we choose.

Numba turns a loop into LLVM's instructions, and finds vectors only where the innermost loop adds
up or writes numbers that lie side by side. What calls for more says so by itself, here. It is part
of the loop's own machine code, for the processor that it is compiled on: nothing is to be linked,
and where a processor has shorter vectors, LLVM takes several of them.
"""

from collections.abc import Callable
from functools import cached_property
from inspect import signature
from typing import Any

from l1slam_ros.core.kernels.vectors.instructions import Instructions


class Inline:
    """
    A part of loops that is written in LLVM's own instructions, on vectors of `lanes` doubles.

    Parameters
    ----------
    write : gets `Instructions` and what a loop gives: of an array the address, else a number

    """

    def __init__(self, write: Callable[..., None], lanes: int) -> None:
        self._write, self._lanes = write, lanes

    @cached_property
    def _numba_type_(self) -> Any:
        """What numba takes it for where a loop calls it."""
        from numba import types
        from numba.core.typing.templates import make_intrinsic_template

        def typed(context: Any, *takes: Any) -> Any:
            return types.void(*takes), self._written

        typed.__signature__ = signature(self._write)  # type: ignore[attr-defined]
        return types.Function(make_intrinsic_template(self, typed, self._write.__name__))

    def _written(self, context: Any, builder: Any, call: Any, arguments: Any) -> Any:
        from numba.core import types

        given = [context.make_array(of)(context, builder, one).data
                 if isinstance(of, types.Array) else one
                 for of, one in zip(call.args, arguments, strict=True)]
        self._write(Instructions(builder, self._lanes), *given)
        return context.get_dummy_value()
