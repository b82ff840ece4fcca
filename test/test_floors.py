# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The walls of the package, read off its source: who may import whom, and how long things are."""

import ast
import re
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest
from headers import HEADER

ROOT = Path(__file__).parents[1]
PACKAGE = 'l1slam_ros'
ROS = {
    'builtin_interfaces', 'diagnostic_msgs', 'geometry_msgs', 'lifecycle_msgs', 'nav_msgs',
    'rcl_interfaces', 'rclpy', 'rosgraph_msgs', 'sensor_msgs', 'std_msgs', 'std_srvs',
    'tf2_msgs', 'visualization_msgs',
}
# From the ground up; what shares a floor does not know of each other. Errors, options and names
# stand beside the building: all may use them, and they use nothing.
FLOORS = (
    ('core.native',), ('core.geometry',), ('core.graph', 'core.scans'), ('core.solvers',),
    ('core.robust',), ('core.bordered', 'core.worlds'), ('core.online',), ('core.running',),
    ('io',), ('paper', 'fleet'), ('cli', 'ros'),
)
# Only the algorithms that join them may know both a linear system and poses.
BLIND = {f'{PACKAGE}.core.{name}': {f'{PACKAGE}.core.{other}' for other in others}
         for name, others in {
             'solvers.primal_dual': ('graph.factor_graph', 'geometry.se2'),
             'solvers.optimality': ('graph.factor_graph', 'geometry.se2'),
             'solvers.reweighting': ('graph.factor_graph', 'geometry.se2'),
         }.items()}
LONGEST_FUNCTION = 60


def name_of(path):
    parts = path.relative_to(ROOT).with_suffix('').parts
    return '.'.join(parts[:-1] if parts[-1] == '__init__' else parts)


FILES = {name_of(path): path for path in sorted((ROOT / PACKAGE).rglob('*.py'))}
CORE = [name for name in FILES if name.startswith(f'{PACKAGE}.core')]
ROS_PART = [name for name in FILES if name.startswith(f'{PACKAGE}.ros')]


@cache
def tree(module):
    return ast.parse(FILES[module].read_text())


def imports(module):
    """All modules named in any import statement, also those inside functions."""
    found = set()
    for node in ast.walk(tree(module)):
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f'{module} has a relative import'
            inside = {f'{node.module}.{alias.name}' for alias in node.names} & FILES.keys()
            found.update(inside or {node.module})
    return found


def ours(module):
    return imports(module) & FILES.keys()


def test_the_reader_of_imports_sees_them():
    se2 = f'{PACKAGE}.core.geometry.se2'
    assert {f'{PACKAGE}.core.geometry.manifold', 'numpy'} <= imports(se2)


def test_imports_have_no_circle():
    order = list(TopologicalSorter({module: ours(module) for module in FILES}).static_order())
    errors, graph = f'{PACKAGE}.core.errors', f'{PACKAGE}.core.graph.factor_graph'
    assert order.index(errors) < order.index(graph)


def test_the_core_knows_no_ros_touches_no_file_and_prints_nothing():
    for module in CORE:
        assert ours(module) <= set(CORE)
        calls = [node.func for node in ast.walk(tree(module)) if isinstance(node, ast.Call)]
        names = {call.id for call in calls if isinstance(call, ast.Name)}
        attributes = {call.attr for call in calls if isinstance(call, ast.Attribute)}
        assert not names & {'open', 'print', 'input'}, module
        assert not attributes & {'open', 'read_text', 'write_text', 'tofile', 'savetxt',
                                 'loadtxt'}, module


def floor_of(module):
    """Return the number of a module's floor, and which part of that floor it is in."""
    for number, parts in enumerate(FLOORS):
        for part in parts:
            if f'{module}.'.startswith(f'{PACKAGE}.{part}.'):
                return number, part
    return -1, ''


def test_imports_point_down():
    """All but the package's own, the door that leads to the others."""
    for module in FILES.keys() - {PACKAGE}:
        number, part = floor_of(module)
        for other in ours(module):
            below, other_part = floor_of(other)
            assert below < number or (below, other_part) == (number, part), f'{module}: {other}'


def test_only_the_ros_part_sees_ros():
    for module in FILES:
        seen = {name.split('.')[0] for name in imports(module)}
        assert module in ROS_PART or not seen & ROS, module


@pytest.mark.parametrize('module', BLIND)
def test_systems_and_poses_are_kept_apart(module):
    assert not ours(module) & BLIND[module]


def test_functions_are_short():
    for module in FILES:
        for node in ast.walk(tree(module)):
            if isinstance(node, ast.FunctionDef):
                length = node.end_lineno - node.lineno + 1
                assert length <= LONGEST_FUNCTION, f'{module}: {node.name} has {length} lines'


def test_modules_say_their_licence_and_what_they_are():
    for module, path in FILES.items():
        if path.stat().st_size:
            assert path.read_text().startswith(HEADER), module
            assert ast.get_docstring(tree(module)), module


def inside(path):
    """Return the modules and the private names of the package that a test uses."""
    module = ast.parse(path.read_text())
    names = set()
    for node in ast.walk(module):
        match node:
            case ast.Import():
                names |= {alias.name for alias in node.names}
            case ast.ImportFrom():
                names |= {node.module, *(f'{node.module}.{alias.name}' for alias in node.names)}
            case ast.Constant(value=str(text)):  # what a process is given to run
                names |= {*re.findall(rf'\b(?:from|import) ({PACKAGE}\.[\w.]+)', text)}
            case ast.Attribute(value=of, attr=name) if name in PRIVATE:
                names |= set() if getattr(of, 'id', '') == 'self' else {f'{PACKAGE}.{name}'}
    return {name for name in names if name.startswith(f'{PACKAGE}.')} - DOORS


PRIVATE = {name for module in FILES for node in ast.walk(tree(module))
           if isinstance(node, ast.FunctionDef | ast.ClassDef)
           or isinstance(node, ast.Name | ast.Attribute) and isinstance(node.ctx, ast.Store)
           if (name := getattr(node, 'name', '') or getattr(node, 'attr', '')
               or getattr(node, 'id', '')).startswith('_') and not name.endswith('_')}
# Beside the package itself: the command, and the nodes that the executables start.
DOORS = {f'{PACKAGE}.{name}' for name in (
    'cli.main', 'cli.main.main', 'ros.node', 'ros.node.BackendNode', 'ros.scans.node',
    'ros.scans.node.ScanLoopsNode')}


def test_tests_enter_by_the_doors():
    """The package, the command and the executables: then what is inside can move."""
    here = Path(__file__).parent
    paths = [path for path in here.rglob('*.py') if (here / 'math') not in path.parents]
    assert len(paths) > 50
    assert {path.relative_to(here): names for path in paths if (names := inside(path))} == {}
