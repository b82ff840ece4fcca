# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""README and doc/: links lead somewhere, commands and Python run, recipes are true."""

import json
import os
import re
import shlex
import signal
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import pytest
import yaml
from environments import environment, own_variables, running_backend

import l1slam_ros
from l1slam_ros.cli.main import main

ROOT = Path(__file__).parents[1]
README = ROOT / 'README.md'
PAGES = [README, *sorted((ROOT / 'doc').glob('*.md'))]
RECIPES = ROOT / 'doc' / 'how_to_change_it.md'
DATASETS = ROOT.parent / 'shared' / 'datasets'

WALK = 'python benchmarks/ros/walk.py'
NEED_ROS = '.venv/bin/backend', '.venv/bin/replay', WALK
# Commands of the pages that no test runs as they stand, by how they begin.
NOT_RUN = (
    # Nothing of these is on this machine; test_launch.py, test_make.py and test_package.py start,
    # build, install and source what they do.
    'make ', 'rosdep ', 'source install', 'colcon ', 'ros2 ', 'rviz2 ', 'apt-get ', 'pip install',
    'ament_', 'python -m build',
    # They take minutes, some of them 8 GB.
    'python benchmarks/', 'l1slam solve $DATASETS/lidar', 'l1slam reproduce',
    'l1slam simulate w.g2o', 'l1slam solve w.g2o',
    # They need the rights of root, write to /, or run until they are ended; test/fleet does so.
    'mkdir /sys/fs/cgroup', 'echo 1G > /sys/fs/cgroup', 'echo 200000 > /sys/fs/cgroup', 'dask ',
    'mkdir -m 700 -p /fleet', 'openssl ', 'l1slam batch /fleet',
)


class Block(NamedTuple):
    """A fenced block: its language, its text, and the heading it stands under."""

    language: str
    text: str
    heading: str


def blocks(page):
    """Return the fenced blocks of a page."""
    found = []
    heading = ''
    language = None
    lines = []
    for line in page.read_text().splitlines():
        if language is None and line.startswith('#'):
            heading = line.lstrip('# ')
        elif language is not None and line == '```':
            found.append(Block(language, '\n'.join(lines) + '\n', heading))
            language = None
        elif language is None and line.startswith('```'):
            language, lines = line[3:], []
        else:
            lines.append(line)
    assert language is None, f'{page.name}: a block has no end'
    return found


def prose(page):
    """Return a page without its fenced blocks."""
    return re.sub(r'^```.*?^```$', '', page.read_text(), flags=re.M | re.S)


def commands(text):
    """Return the command lines of a block, without comments."""
    lines = (re.sub(r'(^|\s)#.*', '', line).strip() for line in text.splitlines())
    return [line for line in lines if line]


def of_page(page):
    return page.name


@pytest.mark.parametrize(('row', 'options'), [
    ('least squares, all loops used', ['--norm', 'l2', '--no-robust']),
    ('L1, all loops used', ['--no-robust']), ('least squares, loops judged', ['--norm', 'l2']),
    ('L1, loops judged', [])])
def test_the_table_of_the_readme_says_what_its_command_does(row, options, capsys):
    said = float(re.search(rf'^\| {row} \| ([\d.]+)', README.read_text(), re.M)[1])
    assert main(['solve', str(ROOT / 'bags' / 'demo'), '--reference', 'bag:/ground_truth',
                 '--json', *options]) == 0
    assert json.loads(capsys.readouterr().out)['ate'] == pytest.approx(said, rel=0.03)


@pytest.mark.parametrize('page', PAGES, ids=of_page)
def test_every_link_leads_somewhere(page):
    for target in re.findall(r'\]\(([^)]+)\)', prose(page)):
        if not target.startswith(('http://', 'https://')):
            name, _, anchor = target.partition('#')
            there = page.parent / name if name else page
            assert there.exists(), target
            headings = re.findall(r'^#+ (.*)$', there.read_text(), re.M) if anchor else ()
            assert not anchor or anchor in {
                re.sub(r'[^\w -]', '', heading).lower().replace(' ', '-')
                for heading in headings}, target


# What is `l1slam WORD ...` in a sentence or a table.
INLINE = sorted({found for page in PAGES
                 for found in re.findall(r'`(l1slam \w[^`]*)`', prose(page))})


@pytest.mark.parametrize('command', INLINE)
def test_a_command_in_a_sentence_has_options_that_there_are(command, capsys):
    _, word, *arguments = shlex.split(command)
    with pytest.raises(SystemExit) as ended:
        main([word, '--help'])
    assert ended.value.code == 0
    said = capsys.readouterr().out
    for option in (word for word in arguments if word.startswith('--')):
        assert option.replace('--no-', '--') in said, option


def room(folder):
    """
    Return a folder like a fresh checkout, beside its own outputs, and what it is run with.

    Without the package, and with a Python that begins the running one.
    """
    for entry in ROOT.iterdir():
        if entry.name not in ('.git', '.venv', 'demo', 'build', 'l1slam_ros'):
            (folder / entry.name).symlink_to(entry)
    programs = folder / '.venv' / 'bin'
    programs.mkdir(parents=True)
    for entry in (Path(sys.prefix) / 'bin').iterdir():
        if not entry.name.startswith('python'):
            (programs / entry.name).symlink_to(entry)
    python = programs / 'python'
    python.write_text(f'#!/bin/sh\nexec {shlex.quote(sys.executable)} "$@"\n')
    python.chmod(0o755)
    return {**os.environ, 'PATH': f'{programs}:{os.environ["PATH"]}', 'DATASETS': str(DATASETS)}


def run(command, folder, environment, codes=(0,)):
    ran = subprocess.run(['sh', '-c', command], cwd=folder, env=environment, capture_output=True,
                         text=True, timeout=300)
    assert ran.returncode in codes, f'{command}\n{ran.returncode}\n{ran.stdout}{ran.stderr}'
    return ran


@pytest.mark.parametrize('page', [page for page in PAGES if page != RECIPES], ids=of_page)
def test_the_commands_of_a_page_run_in_their_order(page, tmp_path):
    environment, nodes = room(tmp_path), []
    for block in blocks(page):
        if block.language == 'python':
            run(f'{shlex.quote(sys.executable)} -c {shlex.quote(block.text)}', tmp_path,
                environment)
        for command in commands(block.text) if block.language == 'sh' else ():
            if (command.startswith(NOT_RUN) and not command.startswith(WALK)
                    or command.startswith(NEED_ROS) and find_spec('rclpy') is None
                    or '$DATASETS' in command and not DATASETS.exists()):
                continue
            if command.startswith('.venv/bin/backend'):
                nodes.append(running_backend(*shlex.split(command.rstrip('& ')), cwd=tmp_path,
                                             env=environment, end=signal.SIGINT))
                nodes[-1].__enter__()
            else:
                # The best map of a graph with lies that nobody vouches for may be doubtful.
                codes = (0, 4) if 'lies' in command else (0,)
                doubtful = f'{command}    # exit code 4\n' in block.text
                run(command, tmp_path, environment, (4,) if doubtful else codes)
    for node in nodes:
        node.__exit__(None, None, None)


# Takes modules that a recipe has changed in the place of those of the package.
CHANGED = """
import importlib.util, pathlib, sys

class Changed:
    def find_spec(self, name, path=None, target=None):
        file = pathlib.Path({folder!r}, *name.split('.')).with_suffix('.py')
        return importlib.util.spec_from_file_location(name, file) if file.exists() else None

sys.meta_path.insert(0, Changed())
"""


def carry_out(block, folder):
    """Change the package as a block says, in a folder."""
    first, _, rest = block.text.partition('\n')
    path = first.split()[1]
    (folder / path).parent.mkdir(parents=True, exist_ok=True)
    if block.language == 'python':
        assert not (ROOT / path).exists(), path
        (folder / path).write_text(rest)
        return
    lines = rest.splitlines()
    before, after = (''.join(f'{line[1:]}\n' for line in lines if line[0] in marks)
                     for marks in (' -', ' +'))
    text = (folder / path if (folder / path).exists() else ROOT / path).read_text()
    assert text.count(before) == 1, f'{path}: {text.count(before)} times\n{before}'
    (folder / path).write_text(text.replace(before, after))


def assert_the_map_is_good(trials, folder, environment):
    """Hold the map of the first solve to one of a norm and a solver that are tested elsewhere."""
    truth = folder / 'world.g2o.truth.txt'
    asked = next(command for command in trials if command.startswith('l1slam solve'))
    asked = re.sub(' --(reference|output) \\S+', '', asked)
    ours, theirs = (
        json.loads(run(f'{command} --no-robust --json --quiet --reference {truth}', folder,
                       environment).stdout) for command in (asked, 'l1slam solve world.g2o'))
    assert ours['status'] == 'converged'
    assert ours['poses'] == ours['ate_poses'] == 200
    assert ours['ate'] < 1.5 * theirs['ate']
    if '--solver' in asked:
        assert ours['solver'] == 'newton'
        assert ours['final_cost'] == pytest.approx(theirs['final_cost'], rel=1e-4)


@pytest.mark.parametrize('heading, said', [
    ('Add a norm', 'pseudo-huber'), ('Add a solver', 'newton'), ('Add an input', '.edges')])
def test_a_recipe_carried_out_as_written_does_what_it_says(heading, said, tmp_path):
    environment = room(tmp_path)
    (tmp_path / 'hooks').mkdir()
    (tmp_path / 'hooks' / 'sitecustomize.py').write_text(CHANGED.format(folder=str(tmp_path)))
    searched = [str(tmp_path / 'hooks'), *filter(None, [os.environ.get('PYTHONPATH')])]
    environment['PYTHONPATH'] = os.pathsep.join(searched)
    ours = [block for block in blocks(RECIPES) if block.heading == heading]
    trials = [command for block in ours if block.language == 'sh'
              for command in commands(block.text)]
    (first,) = commands(blocks(RECIPES)[0].text)
    run(first, tmp_path, environment)
    # Without the recipe nobody knows the name.
    assert said in run(trials[-1], tmp_path, environment, (2,)).stderr
    for block in ours:
        if block.language != 'sh':
            carry_out(block, tmp_path)
    for command in trials:
        run(command, tmp_path, environment)
    assert_the_map_is_good(trials, tmp_path, environment)


def test_sphinx_builds_the_pages_and_finds_every_name(tmp_path):
    """As rosdoc2 does, with the same two tools, and what is only warned of is an error."""
    tools = environment('sphinx', 'myst-parser', 'numpy', 'scipy')
    built = subprocess.run([tools.prefix / 'bin' / 'sphinx-build', '-q', '-W', '--keep-going',
                            '-d', tmp_path / 'read', ROOT / 'doc', tmp_path / 'html'],
                           capture_output=True, text=True,
                           env=own_variables(), timeout=300)
    assert built.returncode == 0, built.stderr
    api = (tmp_path / 'html' / 'api.html').read_text()
    for name in l1slam_ros.__all__:
        assert f'id="l1slam_ros.{name}"' in api or f'{name}</span>' in api, name


OTHERS = ROOT / 'doc' / 'with_other_tools.md'


@pytest.mark.parametrize('block', [block for block in blocks(OTHERS) if block.language == 'xml'],
                         ids=lambda block: block.heading)
def test_a_launch_file_starts_what_there_is(block):
    launch = ElementTree.fromstring(block.text)
    ours = [node for node in launch.iter('node') if node.get('pkg') == 'l1slam_ros']
    assert launch.tag == 'launch' and ours
    topics = (ROOT / 'doc' / 'topics_and_parameters.md').read_text()
    for node in ours:
        assert node.get('exec') in {'backend', 'scan_loops'} and node.get('name')
        for remap in node.iter('remap'):
            assert f'`{remap.get("from")}`' in topics
        for param in node.iter('param'):
            folder, shipped, name = param.get('from').rpartition('/config/')
            assert not shipped or ((ROOT / 'config' / name).exists()
                                   and folder == '$(find-pkg-share l1slam_ros)')
    beside = {block.heading for block in blocks(OTHERS) if block.language == 'yaml'}
    assert block.heading in beside


@pytest.mark.parametrize('block', [block for block in blocks(OTHERS) if block.language == 'yaml'],
                         ids=lambda block: block.heading)
def test_the_node_starts_with_a_parameter_file_of_the_page(block, start, tmp_path):
    pytest.importorskip('rclpy')
    told = yaml.safe_load(block.text)
    ours = told.get('backend') or told['/**']
    known = yaml.safe_load((ROOT / 'config' / 'backend.yaml').read_text())['/**']
    for name in flat(ours['ros__parameters']):
        assert name in flat(known['ros__parameters']), name
    (tmp_path / 'of_the_page.yaml').write_text(block.text)
    process = start('--ros-args', '--params-file', tmp_path / 'of_the_page.yaml')
    said = process.stderr.readline()
    assert 'ready' in said, said


def flat(parameters, prefix=''):
    """Return the names of parameters, joined by points."""
    for name, value in parameters.items():
        if isinstance(value, dict):
            yield from flat(value, f'{prefix}{name}.')
        else:
            yield f'{prefix}{name}'
