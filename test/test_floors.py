# SPDX-License-Identifier: Apache-2.0
"""The walls of the package, read off its source: who may import whom, and how long things are."""

import ast
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = 'l1slam_ros'
ROS = {
    'builtin_interfaces', 'diagnostic_msgs', 'geometry_msgs', 'nav_msgs', 'rcl_interfaces',
    'rclpy', 'rosgraph_msgs', 'std_msgs', 'std_srvs', 'tf2_msgs', 'visualization_msgs',
}
# Only these of the core may be seen by io: the records it reads and writes, and what they need.
GROUND = {
    f'{PACKAGE}.core.{name}'
    for name in ('errors', 'graph', 'manifold', 'measurements', 'noise', 'se2')
}
# Only the algorithms that join them may know both a linear system and poses.
BLIND = {f'{PACKAGE}.core.{name}': {f'{PACKAGE}.core.{other}' for other in others}
         for name, others in {
             'primal_dual': ('graph', 'se2', 'seed', 'optimiser', 'backend'),
             'optimality': ('graph', 'se2', 'seed', 'optimiser', 'backend'),
             'linearise': ('primal_dual', 'l2', 'optimality', 'seed', 'optimiser', 'backend'),
         }.items()}
LONGEST_MODULE = 350
LONGEST_FUNCTION = 60


def name_of(path):
    parts = path.relative_to(ROOT).with_suffix('').parts
    return '.'.join(parts[:-1] if parts[-1] == '__init__' else parts)


FILES = {name_of(path): path for path in sorted((ROOT / PACKAGE).rglob('*.py'))}
CORE = [name for name in FILES if name.startswith(f'{PACKAGE}.core')]
IO = [name for name in FILES if name.startswith(f'{PACKAGE}.io')]


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
    assert f'{PACKAGE}.core.manifold' in imports(f'{PACKAGE}.core.se2')
    assert 'numpy' in imports(f'{PACKAGE}.core.se2')


def test_imports_have_no_circle():
    order = list(TopologicalSorter({module: ours(module) for module in FILES}).static_order())
    assert order.index(f'{PACKAGE}.core.errors') < order.index(f'{PACKAGE}.core.graph')


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


@pytest.mark.parametrize('module', IO)
def test_io_sees_the_records_of_the_core_and_no_solver(module):
    assert ours(module) <= set(IO) | GROUND
    assert 'rclpy' not in {name.split('.')[0] for name in imports(module)}


@pytest.mark.parametrize('module', BLIND.keys() & FILES.keys())
def test_systems_and_poses_are_kept_apart(module):
    assert not ours(module) & BLIND[module]


@pytest.mark.parametrize('package', ['', '.core', '.io'])
def test_packages_are_empty(package):
    assert not tree(PACKAGE + package).body


@pytest.mark.parametrize('module', FILES)
def test_modules_and_functions_are_short(module):
    assert len(FILES[module].read_text().splitlines()) <= LONGEST_MODULE
    for node in ast.walk(tree(module)):
        if isinstance(node, ast.FunctionDef):
            length = node.end_lineno - node.lineno + 1
            assert length <= LONGEST_FUNCTION, f'{node.name} has {length} lines'


@pytest.mark.parametrize('module', [name for name in FILES if FILES[name].stat().st_size])
def test_modules_say_their_licence_and_what_they_are(module):
    assert FILES[module].read_text().startswith('# SPDX-License-Identifier: Apache-2.0\n')
    assert ast.get_docstring(tree(module))
