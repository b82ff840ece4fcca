# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""`l1slam` as a process: what it imports; readers that have gone; TAB key, terminal and log."""

import fcntl
import io
import json
import os
import pty
import re
import struct
import subprocess
import sys
import sysconfig
import termios
import time
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from platform import python_version

import numpy as np
import pytest
from command import help_of, run
from hidden import without

from l1slam_ros.cli.main import main

ROOT = Path(__file__).parents[2]
DEADLINE = 60.0
RUN = 'import sys; from l1slam_ros.cli.main import main; sys.argv[0] = "l1slam"; sys.exit(main())'
# Prints, last on standard error, which modules were imported.
TELL = 'import atexit, sys; atexit.register(lambda: print(*sys.modules, file=sys.stderr)); ' + RUN
LINES = [f'EDGE_SE2 {k} {k + 1} 1 0 {1.57 * (k % 5 == 0)} 100 0 0 100 0 900' for k in range(20)]


@pytest.fixture
def graph(tmp_path):
    path = tmp_path / 'graph.g2o'
    path.write_text('\n'.join(LINES) + '\n')
    return path


# As it is with people: what is printed is written when there is much of it, or at the end.
BUFFERED = {name: value for name, value in os.environ.items() if name != 'PYTHONUNBUFFERED'}


def l1slam(*arguments, code=RUN, **options):
    return subprocess.run([sys.executable, '-c', code, *map(str, arguments)], timeout=DEADLINE,
                          text=True, **{'capture_output': True, 'env': BUFFERED, **options})


def imported(*arguments, cwd):
    told = l1slam(*arguments, code=TELL, cwd=cwd).stderr.splitlines()[-1].split()
    assert 'l1slam_ros.cli.main' in told
    return {name.split('.')[0] for name in told}


HEAVY = {'numpy', 'scipy', 'matplotlib', 'tqdm', 'yaml', 'mcap', 'rosbags', 'argcomplete'}


@pytest.mark.parametrize('arguments', [
    (), ('--version',), ('solve', 'graph.g2o', '--norm', 'l3')], ids=' '.join)
def test_what_runs_nothing_imports_nothing(tmp_path, arguments):
    assert not imported(*arguments, cwd=tmp_path) & HEAVY


@pytest.mark.parametrize('arguments, used', [
    (('convert', 'graph.g2o', 'out'), ('numpy', 'scipy', 'mcap', 'rosbags', 'yaml')),
    (('plot', 'graph.g2o', '--output', 'map.png'), ('numpy', 'scipy', 'matplotlib')),
    (('info', 'graph.g2o'), ('numpy', 'scipy')),
    (('solve', 'graph.g2o'), ('numpy', 'scipy'))], ids=lambda value: ' '.join(value))
def test_a_command_imports_what_it_uses(graph, arguments, used):
    """Others may be behind these: matplotlib looks for YAML."""
    found = imported(*arguments, cwd=graph.parent) & HEAVY
    assert 'numpy' in found <= {*used, 'yaml'}


def test_the_version_says_commit_python_and_numpy(capsys):
    assert main(['--version']) == 0
    said = re.fullmatch(r'l1slam (\S+)(?:, commit ([0-9a-f]{7,}(?:-dirty)?))?, Python (\S+), '
                        r'NumPy (\S+)\n', capsys.readouterr().out)
    assert said[1] == version('l1slam_ros')
    assert (said[3], said[4]) == (python_version(), np.__version__)
    assert bool(said[2]) == (ROOT / '.git').exists()


@pytest.mark.parametrize('hidden, variables, said', [
    (['l1slam_ros.core.native._portable'], {}, 'the compiled core does not load (.*); `pip .*'),
    ([], {'L1SLAM_ROS_SIMD': 'sse'}, "L1SLAM_ROS_SIMD is 'sse'; expected one of avx2, portable")],
    ids=['not built', 'no level'])
def test_a_core_that_does_not_load_is_one_line(graph, hidden, variables, said):
    code = f'import sys; sys.modules.update(dict.fromkeys({hidden!r})); {RUN}'
    done = l1slam('solve', graph, code=code, env=BUFFERED | variables)
    assert done.returncode == 2 and re.fullmatch(f'l1slam: {said}\\n', done.stderr), done.stderr


def test_nothing_is_written_but_what_was_asked_for(graph, tmp_path):
    home = tmp_path / 'home'
    home.mkdir()
    named = ('XDG_', 'PYTHON', 'TMP')
    own = {name: value for name, value in BUFFERED.items() if not name.startswith(named)}
    own |= {'HOME': str(home), 'PYTHONDONTWRITEBYTECODE': '1'}
    for _ in range(2):
        done = l1slam('solve', graph, env=own | {'TMPDIR': str(home)}, cwd=home)
        assert done.returncode == 0, done.stderr
    assert not [*home.iterdir()]


@pytest.mark.parametrize('arguments', [
    ('--help',), ('solve', 'graph.g2o'), ('solve', 'graph.g2o', '--json')], ids=' '.join)
def test_a_reader_that_has_gone_is_no_error(graph, arguments):
    """Nobody reads from the start on, so it fails whenever it writes: at once or at the end."""
    reading, writing = os.pipe()
    os.close(reading)
    try:
        done = l1slam(*arguments, cwd=graph.parent, stdout=writing, stderr=subprocess.PIPE,
                      capture_output=False)
    finally:
        os.close(writing)
    assert done.returncode == 141 and 'Error' not in done.stderr


@pytest.mark.parametrize('name', ['SIGINT', 'SIGTERM'])
def test_a_signal_leaves_nothing_half_written(graph, name):
    # Who is started in the background of a script ignores SIGINT.
    code = ('import os, signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); '
            'sys.addaudithook(lambda event, about: event == "open" and "metadata.yaml" in str('
            f'about[0]) and os.kill(os.getpid(), signal.{name})); {RUN}')
    done = l1slam('convert', 'graph.g2o', 'bag', code=code, cwd=graph.parent)
    assert (done.returncode, done.stderr) == (130, '')
    assert [path.name for path in graph.parent.iterdir()] == ['graph.g2o']


# Interrupts a process amid an import, a call from machine code, or a destructor: `point` of them.
INTERRUPT = """
import runpy, signal, sys

class Last:
    def __del__(self):
        signal.raise_signal(signal.SIGINT)

def now():
    came.append(point)
    if point == 'destructor':
        Last()
    else:
        signal.raise_signal(signal.SIGINT)

came, point = [], sys.argv.pop(1)
signal.signal(signal.SIGINT, signal.default_int_handler)
sys.addaudithook(lambda event, about: now() if not came and event == 'import' and about[0] == {
    'destructor': 'numpy'}.get(point, point) else None)
sys.setprofile(lambda frame, event, called: now() if not came and event == 'c_call' and
               f'{called.__module__}.{called.__name__}' == point else None)
try:
    runpy.run_path(SCRIPT, run_name='__main__')
except SystemExit as ended:
    sys.exit(ended.code if came else 'not reached')
""".replace('SCRIPT', repr(str(Path(sysconfig.get_path('scripts'), 'l1slam'))))


@pytest.mark.parametrize('point', ['argparse', 'numpy', 'datetime', 'l1slam_ros.core.native',
                                   'destructor'])
def test_an_interrupt_at_any_time_is_no_traceback(graph, point):
    """NumPy and machine code make errors of their own of one, and destructors hide it."""
    done = l1slam(point, 'solve', graph, code=INTERRUPT)
    assert (done.returncode, done.stdout, done.stderr) == (130, '', '')


@pytest.mark.parametrize('typed, offered', [
    ('l1slam so', ['solve ']), ('l1slam solve a.g2o --norm ', ['l1', 'group-l1', 'l2', 'huber']),
    ('l1slam solve a.g2o --no-r', ['--no-robust '])])
def test_the_tab_key_completes(tmp_path, typed, offered):
    pytest.importorskip('argcomplete')
    answer = tmp_path / 'answer'
    asked = {'_ARGCOMPLETE': '1', '_ARGCOMPLETE_STDOUT_FILENAME': str(answer),
             '_ARGCOMPLETE_IFS': '\n', 'COMP_TYPE': '9', 'COMP_LINE': typed,
             'COMP_POINT': str(len(typed))}
    l1slam(env=os.environ | asked)
    assert answer.read_text().split('\n') == offered


def test_the_help_says_how_to_switch_completion_on_and_what_exit_codes_mean(capsys):
    said = help_of(capsys)
    assert 'register-python-argcomplete l1slam' in said
    assert re.findall(r'^  (\d)  ', said, re.MULTILINE) == ['0', '2', '3', '4']


def on_a_terminal(*arguments, **options):
    """Run the command with standard error on a terminal; return what it showed there."""
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack('HHHH', 24, 80, 0, 0))
    process = subprocess.Popen(['timeout', str(DEADLINE), sys.executable, '-c', RUN,
                                *map(str, arguments)], stderr=theirs, stdout=subprocess.DEVNULL,
                               cwd=ROOT, **options)
    os.close(theirs)
    shown = b''
    with open(ours, 'rb', buffering=0) as screen, suppress(OSError):  # its other end is closed
        while news := screen.read(4096):
            shown += news
    assert process.wait() == 0
    return shown.decode()


def test_on_a_terminal_there_is_a_bar_of_what_takes_long(clean, tmp_path):
    shown = on_a_terminal('solve', clean)
    assert 'round' in shown and '%|' in shown
    assert on_a_terminal('solve', clean, '--quiet') == ''
    without_bar = on_a_terminal('solve', clean, env=without(tmp_path, 'tqdm'))
    assert 'Traceback' not in without_bar and '%|' not in without_bar


def test_in_a_log_there_is_a_line_now_and_then_of_what_takes_long(clean, capsys, monkeypatch):
    """By a clock that goes on by an eighth of a second whenever somebody looks."""
    asked, now, said = ('solve', clean, '--no-robust', '--solver', 'primal-dual'), [100.0], []

    class Log(io.StringIO):
        def write(self, text):
            said.append((now[0], text))
            return len(text)

    def looked_at():
        now[0] += 0.125
        return now[0]

    assert run(capsys, *asked)[1] == ''
    monkeypatch.setattr(time, 'monotonic', looked_at)
    monkeypatch.setattr(sys, 'stderr', Log())
    run(capsys, *asked)
    times, lines = zip(*[one for one in said if one[1] != '\n'], strict=True)
    assert 3 <= times[0] - 100 < 6 and 5 <= np.diff(times).min() <= np.diff(times).max() < 10
    steps = [int(re.fullmatch(r'l1slam: solving: step (\d+) of 60, cost 29[89]\.\d+', line)[1])
             for line in lines]
    assert len(steps) > 3 and steps == sorted(set(steps))
    run(capsys, *asked, '--quiet')
    assert len(said) == 2 * len(steps)


def test_a_name_with_a_line_break_in_it_is_told_in_one_line(capsys):
    assert main(['info', 'no\nsuch.g2o']) == 2
    assert capsys.readouterr().err == (
        'l1slam: no\\nsuch.g2o: no such file or directory; expected a graph, a bag or a log\n')


@pytest.mark.skipif(not Path('/dev/full').exists(), reason='no device that is always full')
def test_a_full_disk_is_one_line_and_changes_no_other_exit_code(graph, tmp_path):
    with open('/dev/full', 'w') as full:
        done = l1slam('info', graph, stdout=full, stderr=subprocess.PIPE, capture_output=False)
        ended = l1slam('info', 'no.g2o', cwd=tmp_path, capture_output=False, stderr=full)
    assert (done.returncode, done.stderr) == (2, 'l1slam: No space left on device\n')
    assert ended.returncode == 2


def test_without_standard_error_nothing_is_mixed_into_the_json(graph):
    graph.write_text(graph.read_text() + 'EDGE_SE2 3 3 0 0 0 100 0 0 100 0 900\n')
    shell = ['sh', '-c', '"$@" 2>&-', 'sh', sys.executable, '-c', RUN, 'solve', graph, '--json']
    ended = subprocess.run(shell, timeout=DEADLINE, stdout=subprocess.PIPE, text=True)
    assert ended.returncode == 0
    assert 'itself' in json.loads(ended.stdout)['warnings'][0]
