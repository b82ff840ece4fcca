# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Declaring options as ROS parameters; name, default, unit and range come from the fields."""

from collections.abc import Callable
from difflib import get_close_matches
from typing import Generic

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.exceptions import ParameterException
from rclpy.node import Node
from rclpy.parameter import Parameter

from l1slam_ros.core.errors import OptionError
from l1slam_ros.core.options import AnyOptions, Meaning, Scalar, flatten, with_values


class NodeParameters(Generic[AnyOptions]):
    """
    The parameters of a node, as an options record that is replaced at every change.

    Parameters
    ----------
    node : where to declare them
    defaults : the options to declare, at their defaults
    on_change : called with the new options after each accepted change

    Raises
    ------
    OptionError : a value given at start is refused.

    """

    def __init__(self, node: Node, defaults: AnyOptions,
                 on_change: Callable[[AnyOptions], None]):
        self._node, self._on_change = node, on_change
        # To ROS an empty list has no type and is no value: it stands for the default.
        empty = {name for name, one in node._parameter_overrides.items() if one.value is None}
        try:
            given = {name: node.declare_parameter(
                name, list(value) if isinstance(value, tuple) else value,
                _descriptor(value, meaning), ignore_override=name in empty).value
                     for name, (value, meaning) in flatten(defaults).items()}
        except ParameterException as error:
            raise OptionError(str(error)) from error
        self.options = with_values(defaults, given)
        node.add_on_set_parameters_callback(self._check)
        node.add_post_set_parameters_callback(self._apply)

    def unknown(self) -> list[str]:
        """Return a sentence for each unknown parameter that was given at start."""
        overrides, known = self._node._parameter_overrides, self._node._parameters
        sentences = []
        for name in sorted(overrides.keys() - known.keys()):
            near = get_close_matches(name, known, 1)
            sentences.append(f'there is no parameter {name!r}: it is not used'
                             + (f'; did you mean {near[0]!r}?' if near else ''))
        return sentences

    def _check(self, parameters: list[Parameter]) -> SetParametersResult:
        try:
            self._changed(parameters)
        except OptionError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _apply(self, parameters: list[Parameter]) -> None:
        changed = self._changed(parameters)
        if changed != self.options:
            self.options = changed
            self._on_change(changed)

    def _changed(self, parameters: list[Parameter]) -> AnyOptions:
        return with_values(self.options, {parameter.name: parameter.value
                                          for parameter in parameters
                                          if parameter.name in flatten(self.options)})


def _descriptor(value: Scalar, meaning: Meaning) -> ParameterDescriptor:
    unit = f' [{meaning.unit}]' if meaning.unit else ''
    descriptor = ParameterDescriptor(
        description=meaning.doc + unit,
        read_only=meaning.fixed,
        # The options check types themselves, and take 1 for 1.0 as people write it.
        dynamic_typing=True)
    if meaning.choices:
        descriptor.additional_constraints = meaning.expected()
    if meaning.low is not None and meaning.high is not None:
        if isinstance(value, float):
            descriptor.floating_point_range = [
                FloatingPointRange(from_value=float(meaning.low), to_value=float(meaning.high))]
        else:
            descriptor.integer_range = [
                IntegerRange(from_value=int(meaning.low), to_value=int(meaning.high))]
    return descriptor
