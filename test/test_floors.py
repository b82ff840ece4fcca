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
import io
import tokenize
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest
from headers import HEADER, without_header

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
    ('core.kernels',), ('core.geometry',), ('core.graph', 'core.scans'), ('core.solvers',),
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
# More in one folder mix responsibilities; one alone needs none.
MODULES_OF_A_FOLDER = range(2, 14)
LONGEST_MODULE = 420
LONGEST_FUNCTION = 60


def name_of(path):
    parts = path.relative_to(ROOT).with_suffix('').parts
    return '.'.join(parts[:-1] if parts[-1] == '__init__' else parts)


FILES = {name_of(path): path for path in sorted((ROOT / PACKAGE).rglob('*.py'))}
CORE = [name for name in FILES if name.startswith(f'{PACKAGE}.core')]
ROS_PART = [name for name in FILES if name.startswith(f'{PACKAGE}.ros')]
PACKAGES = [name for name, path in FILES.items()
            if path.name == '__init__.py' and name != PACKAGE]


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


def code_lines(path):
    """Return the numbers of the lines of a file without docstrings, comments and blanks."""
    text = path.read_text()
    documented = [node for node in ast.walk(ast.parse(text))
                  if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef)
                  and ast.get_docstring(node)]
    docstrings = {line for node in documented
                  for line in range(node.body[0].lineno, node.body[0].end_lineno + 1)}
    layout = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT,
              tokenize.ENDMARKER}
    lines = {line for token in tokenize.generate_tokens(io.StringIO(text).readline)
             if token.type not in layout for line in range(token.start[0], token.end[0] + 1)}
    return lines - docstrings


def ours(module):
    return imports(module) & FILES.keys()


def test_the_reader_of_imports_sees_them():
    se2 = f'{PACKAGE}.core.geometry.se2'
    assert {f'{PACKAGE}.core.geometry.manifold', 'numpy'} <= imports(se2)


def test_imports_have_no_circle():
    order = list(TopologicalSorter({module: ours(module) for module in FILES}).static_order())
    errors, graph = f'{PACKAGE}.core.errors', f'{PACKAGE}.core.graph.factor_graph'
    assert order.index(errors) < order.index(graph)


@pytest.mark.parametrize('module', CORE)
def test_core_sees_only_core_and_no_ros(module):
    assert ours(module) <= set(CORE)
    assert not {name.split('.')[0] for name in imports(module)} & ROS


@pytest.mark.parametrize('module', CORE)
def test_core_touches_no_file_and_prints_nothing(module):
    calls = {node.func.id for node in ast.walk(tree(module))
             if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)}
    attributes = {node.func.attr for node in ast.walk(tree(module))
                  if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)}
    assert not calls & {'open', 'print', 'input'}
    assert not attributes & {'open', 'read_text', 'write_text', 'tofile', 'savetxt', 'loadtxt'}


def floor_of(module):
    """Return the number of a module's floor, and which part of that floor it is in."""
    for number, parts in enumerate(FLOORS):
        for part in parts:
            if f'{module}.'.startswith(f'{PACKAGE}.{part}.'):
                return number, part
    return -1, ''


@pytest.mark.parametrize('module', [name for name in FILES if name != PACKAGE])
def test_imports_point_down(module):
    """All but the package's own, the door that leads to the others."""
    number, part = floor_of(module)
    for other in ours(module):
        below, other_part = floor_of(other)
        assert below < number or (below, other_part) == (number, part), f'{module} sees {other}'


@pytest.mark.parametrize('module', [name for name in FILES if name not in ROS_PART])
def test_only_the_ros_part_sees_ros(module):
    seen = {name.split('.')[0] for name in imports(module)}
    assert not seen & ROS


@pytest.mark.parametrize('module', [name for name in FILES if '.kernels.' not in name])
def test_only_kernels_see_numba(module):
    assert 'numba' not in {name.split('.')[0] for name in imports(module)}


@pytest.mark.parametrize('module', BLIND)
def test_systems_and_poses_are_kept_apart(module):
    assert not ours(module) & BLIND[module]


def test_folders_are_neither_crowded_nor_of_one():
    folders = {path.parent for path in FILES.values()} - {ROOT / PACKAGE, ROOT / PACKAGE / 'core'}
    assert len(folders) > 12
    for folder in folders:
        modules = [path for path in folder.glob('*.py') if path.name != '__init__.py']
        assert len(modules) in MODULES_OF_A_FOLDER, folder


@pytest.mark.parametrize('package', [name for name in PACKAGES if 'kernels' not in name])
def test_packages_are_empty(package):
    """All but one, whose modules wait until they are called."""
    assert not tree(package).body


@pytest.mark.parametrize('module', FILES)
def test_modules_and_functions_are_short(module):
    assert len(without_header(FILES[module]).splitlines()) <= LONGEST_MODULE
    for node in ast.walk(tree(module)):
        if isinstance(node, ast.FunctionDef):
            length = node.end_lineno - node.lineno + 1
            assert length <= LONGEST_FUNCTION, f'{node.name} has {length} lines'


@pytest.mark.parametrize('module', [name for name in FILES if FILES[name].stat().st_size])
def test_modules_say_their_licence_and_what_they_are(module):
    assert FILES[module].read_text().startswith(HEADER)
    assert ast.get_docstring(tree(module))


# A reader holds each class and function at once.
MOST_ATTRIBUTES = 15
MOST_METHODS = 25
MOST_CODE = 260
MOST_OF_A_FUNCTION = 40
# What runs while a robot drives.
RUNNING = [name for name in FILES if name.startswith(tuple(
    f'{PACKAGE}.core.{part}' for part in ('bordered', 'graph', 'running')))]


def stored(node):
    """Return the attributes that are assigned anywhere in a node: of what, which."""
    return [(getattr(one.value, 'id', ''), one.attr) for one in ast.walk(node)
            if isinstance(one, ast.Attribute) and isinstance(one.ctx, ast.Store)]


def sizes(module):
    """Yield the name of each function and class of a module, what is counted, count and limit."""
    lines = code_lines(FILES[module])
    for node in ast.walk(tree(module)):
        if not isinstance(node, ast.FunctionDef | ast.ClassDef):
            continue
        name = f'{module}.{node.name}'.removeprefix(f'{PACKAGE}.')
        if isinstance(node, ast.FunctionDef):
            own = lines & set(range(node.lineno, node.end_lineno + 1))
            yield name, 'lines of code', len(own), MOST_OF_A_FUNCTION
        else:
            methods = [one for one in node.body if isinstance(one, ast.FunctionDef)]
            fields = {one.target.id for one in node.body if isinstance(one, ast.AnnAssign)}
            fields |= {name for method in methods for of, name in stored(method) if of == 'self'}
            yield name, 'methods', len(methods), MOST_METHODS
            yield name, 'attributes', len(fields), MOST_ATTRIBUTES


@pytest.mark.parametrize('module', FILES)
def test_functions_and_classes_are_small(module):
    for name, what, count, limit in sizes(module):
        assert count <= limit, f'{name} has {count} {what}'


@pytest.mark.parametrize('module', RUNNING)
def test_modules_that_run_are_short(module):
    assert len(code_lines(FILES[module])) <= MOST_CODE


@pytest.mark.parametrize('module', RUNNING)
def test_no_attribute_is_set_from_outside_its_class(module):
    """A clone is of the class that makes it."""
    assert {of for of, _ in stored(tree(module))} <= {'self', 'clone'}


# Folders whose tests enter by the doors, and the modules in them that do not yet.
BY_DOORS = 'cli', 'files', 'fleet', 'node', 'python'
BY_INNER_DOORS = {'test_progress.py', 'test_batch_command.py'}


@pytest.mark.parametrize('folder', BY_DOORS)
def test_tests_enter_by_the_doors(folder):
    """The package, the command and the executables: then what is inside can move."""
    for path in (Path(__file__).parent / folder).rglob('*.py'):
        inner = {name for name in imported(ast.parse(path.read_text()))
                 if name.startswith(f'{PACKAGE}.') and name != f'{PACKAGE}.cli.main'}
        assert bool(inner) == (path.name in BY_INNER_DOORS), f'{path}: {inner}'


def imported(module):
    """Return the names of the modules that a module imports, wherever it does."""
    names = set()
    for node in ast.walk(module):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names.add(node.module)
    return names
