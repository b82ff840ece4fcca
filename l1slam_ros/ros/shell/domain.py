# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
A ROS domain that nobody else is in, whatever the shell says: for the demo and the tests.

Each participant of DDS binds ports of its domain, so a domain whose ports can all be bound has
none. Between the choice and the first participant, and while there is none, who else chooses sees
that it is taken by a port that DDS leaves alone: it is bound until this process is gone.
"""

import os
import socket

from l1slam_ros.core.errors import L1SlamError

# The domains whose ports are below those that Linux hands out to whoever asks for any.
_DOMAINS = range(1, 102)
# Of the RTPS standard: from domain to domain, and the discovery of all and of each participant.
_FIRST, _STEP = 7400, 250
_DISCOVERY = (0, *range(10, 250, 2))
_MARK = 5  # none of the standard's
# What else of the environment decides who hears whom, or stops what cannot be as it says.
_OF_THE_SHELL = (
    'ROS_LOCALHOST_ONLY', 'ROS_STATIC_PEERS', 'ROS_DISCOVERY_SERVER', 'ROS_SUPER_CLIENT',
    'ROS_NAMESPACE', 'ROS_SECURITY_ENABLE', 'ROS_SECURITY_STRATEGY', 'ROS_SECURITY_KEYSTORE',
    'ROS_SECURITY_ENCLAVE_OVERRIDE', 'RCL_ASSERT_RMW_ID_MATCHES',
    'FASTRTPS_DEFAULT_PROFILES_FILE', 'FASTDDS_DEFAULT_PROFILES_FILE', 'FASTDDS_ENVIRONMENT_FILE',
    'FASTDDS_BUILTIN_TRANSPORTS', 'RMW_FASTRTPS_USE_QOS_FROM_XML',
    'RMW_FASTRTPS_PUBLICATION_MODE', 'CYCLONEDDS_URI', 'ZENOH_SESSION_CONFIG_URI',
    'ZENOH_ROUTER_CONFIG_URI')

_taken: list[socket.socket] = []


def go_where_nobody_is() -> int:
    """
    Let this process and its children use a domain of their own, seen on this machine only.

    Returns
    -------
    the domain

    Raises
    ------
    L1SlamError : there is none.

    """
    offset = os.getpid()  # who begins at once with others looks elsewhere first
    for k in range(len(_DOMAINS)):
        domain = _DOMAINS[(offset + k) % len(_DOMAINS)]
        mark = _take(domain)
        if mark is not None:
            _taken.append(mark)
            break
    else:
        raise L1SlamError(f'each ROS domain from {_DOMAINS[0]} to {_DOMAINS[-1]} is in use on '
                          'this machine; expected a free one')
    for name in _OF_THE_SHELL:
        os.environ.pop(name, None)
    os.environ['ROS_DOMAIN_ID'] = str(domain)
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    return domain


def _take(domain: int) -> socket.socket | None:
    """Return what marks a domain as taken; None: it is in use."""
    first = _FIRST + _STEP * domain
    mark = _bound(first + _MARK)
    if mark is None:
        return None
    for offset in _DISCOVERY:
        found = _bound(first + offset)
        if found is None:
            mark.close()
            return None
        found.close()
    return mark


def _bound(port: int) -> socket.socket | None:
    """Return a socket of UDP at a port that is nobody else's; None: it is somebody's."""
    bound = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        bound.bind(('', port))
    except OSError:
        bound.close()
        return None
    return bound
