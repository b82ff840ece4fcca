# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Arguments that more than one suite takes: lists with commas."""

import argparse


def words_of(text: str) -> tuple[str, ...]:
    """Return the words of a list."""
    return tuple(text.split(','))


def shares_of(text: str) -> tuple[float, ...]:
    """Return the shares of a list, each of all loops; raise where one is none."""
    shares = tuple(float(word) for word in words_of(text))
    if not all(0 < share < 1 for share in shares):
        raise argparse.ArgumentTypeError(f'{text!r}, expected shares between 0 and 1')
    return shares
