# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Types for decoding messages: the standard ones, and all others as the bag defines them."""

import re
from contextlib import suppress
from functools import lru_cache
from typing import Any

from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

# Types that ROS 1 messages contain, in their ROS 2 form.
_BASIC = ('std_msgs/msg/Header', 'builtin_interfaces/msg/Time', 'builtin_interfaces/msg/Duration')
_IDL_PART = re.compile(r'^={80}\nIDL: .*\n', re.MULTILINE)
_LONGEST = 2**20  # letters of a definition


# Files of one bag define the same, and the library makes code of each.
@lru_cache(maxsize=4)
def types_of(definitions: tuple[tuple[str, MessageDefinition], ...], is_ros1: bool = False) -> Any:
    """
    Return the types for decoding; of ROS 1, for converting to CDR and decoding that.

    definitions : message type and its definition; an empty or damaged one counts as none:
        recorders write empty ones where the package of a type is not installed
    """
    found = dict[str, Any]()
    for name, definition in definitions:
        with suppress(Exception):  # malformed ones make the library raise anything
            if definition.data.strip() and len(definition.data) <= _LONGEST:
                found.update(_parsed(name, definition))
    basic = dict[str, Any]()
    if is_ros1:
        # The header of ROS 1 has one more field, which the library's conversion drops.
        jazzy = get_typestore(Stores.ROS2_JAZZY).fielddefs
        basic = {name: jazzy[name] for name in _BASIC}
    standard = Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_JAZZY
    with suppress(Exception):  # definitions that do not fit together do, too
        return _registered(standard, {**found, **basic})
    return _registered(standard, basic)


def _parsed(name: str, definition: MessageDefinition) -> Any:
    if definition.format is MessageDefinitionFormat.MSG:
        return get_types_from_msg(definition.data, name)
    found = dict[str, Any]()
    for part in _IDL_PART.split(definition.data):
        if part.strip():
            found.update(get_types_from_idl(part))
    return found


def _registered(standard: Stores, fields: dict[str, Any]) -> Any:
    """Return the standard types, of which some are replaced and others added."""
    types = get_typestore(standard)
    others = {name: found for name, found in fields.items() if types.fielddefs.get(name) != found}
    for name in others:
        types.fielddefs.pop(name, None)
        types.types.pop(name, None)
    if others:
        types.register(others)
    return types
