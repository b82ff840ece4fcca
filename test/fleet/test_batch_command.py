# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""`l1slam batch`, in processes of its own: hostile recordings, kills, other places to work."""

import csv
import json
import os
import shutil
import signal
import subprocess
import sys
import sysconfig
import time
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest
from command import run
from worlds import made

SECONDS = 120  # of patience
L1SLAM = str(Path(sysconfig.get_path('scripts'), 'l1slam'))


@pytest.fixture(scope='module')
def recordings(tmp_path_factory):
    """Six recordings, two of them hostile; the last one in order takes longest."""
    folder = tmp_path_factory.mktemp('recordings')
    (folder / 'deep').mkdir()
    for name, poses in (('a.g2o', 40), ('deep/b.g2o', 50), ('c.graph', 60), ('z.g2o', 1000)):
        path = made((folder / name).with_suffix('.g2o'), poses, int(1.5 * poses),
                    '--false-loops', 2)
        path.rename(folder / name)
    (folder / 'deep' / 'nonsense.g2o').write_text('a poem\n')
    (folder / 'empty.mcap').touch()
    return folder


@pytest.fixture(scope='module')
def done(recordings, tmp_path_factory):
    """What comes of them, on two workers."""
    output = tmp_path_factory.mktemp('done') / 'results'
    ended = command(recordings, output)
    assert ended.wait(SECONDS) == 3
    return output, ended.stderr.read()


def command(folder, output, *options, **environment):
    """Start the command on two workers."""
    where = () if {'--scheduler', '--workers'} & {*options} else ('--workers', '2')
    return subprocess.Popen(
        [sys.executable, '-c', 'import runpy, signal; '
         'signal.signal(signal.SIGINT, signal.default_int_handler); '
         f'runpy.run_path({L1SLAM!r}, run_name="__main__")', 'batch', folder, '--output', output,
         *where, *options],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=os.environ | environment)


def children(process):
    """Return the numbers of the processes of a command that solve."""
    known = Path(f'/proc/{process.pid}/task/{process.pid}/children')
    if not Path(f'/proc/{os.getpid()}/task/{os.getpid()}/children').exists():
        pytest.skip('this system does not say which processes a process has begun')
    found = []
    for number in known.read_text().split():
        with suppress(OSError):
            if b'fleet.child' in Path(f'/proc/{number}/cmdline').read_bytes():
                found.append(int(number))
    return found


def at_work(process):
    """Wait until a command has begun to solve; return the numbers of those who do."""
    while not (found := children(process)):
        assert process.poll() is None, process.stderr.read()
        time.sleep(.002)
    return found


def rows(output):
    with open(output / 'table.csv', newline='') as file:
        return {row['recording']: row for row in csv.DictReader(file)}


def log(output):
    """Return the whole lines of a log that are about recordings."""
    path = output / 'log.jsonl'
    lines = path.read_text().split('\n')[1:-1] if path.exists() else []
    return [line for line in map(json.loads, lines) if 'recording' in line]


def files(output):
    return {path.relative_to(output).as_posix(): path.read_bytes()
            for path in output.rglob('*') if path.is_file() and path.name != 'log.jsonl'}


def until_one_is_done(process, output):
    while not log(output):
        assert process.poll() is None, process.stderr.read()
        time.sleep(.002)
    return log(output)


def test_each_recording_has_its_map_or_its_sentence(recordings, done, tmp_path, capsys):
    output, said = done
    assert 'of 6 recordings 2 failed' in said and str(output / 'table.csv') in said
    found = rows(output)
    assert list(found) == ['a.g2o', 'c.graph', 'deep/b.g2o', 'deep/nonsense.g2o', 'empty.mcap',
                           'z.g2o']
    assert {name for name, row in found.items() if row['status'] == 'failed'} == {
        'deep/nonsense.g2o', 'empty.mcap'}
    assert "deep/nonsense.g2o:1: unknown tag 'a'" in found['deep/nonsense.g2o']['sentence']
    assert 'damaged' in found['empty.mcap']['sentence']
    assert sorted(line['recording'] for line in log(output)) == list(found)
    for name, row in found.items():
        if row['status'] != 'failed':
            run(capsys, 'solve', recordings / name, '--output', tmp_path / 'alone.g2o', '--quiet')
            assert (output / row['map']).read_bytes() == (tmp_path / 'alone.g2o').read_bytes()
            assert row['rejected'] == '2'


def test_table_is_in_parquet_too_where_pyarrow_is(done):
    parquet = pytest.importorskip('pyarrow.parquet')
    output, _ = done
    table = parquet.read_table(output / 'table.parquet')
    assert table['recording'].to_pylist() == list(rows(output))
    assert table['final_cost'][3].as_py() is None


def test_what_a_kill_left_undone_is_done_and_no_more(recordings, done, tmp_path):
    output = tmp_path / 'results'
    killed = command(recordings, output)
    before = until_one_is_done(killed, output)
    killed.kill()
    assert killed.wait(SECONDS) == -signal.SIGKILL
    before = log(output)
    with open(output / 'log.jsonl', 'a') as file:
        file.write('{"recording": "z.g2')  # as a kill amid a line leaves it
    ended = command(recordings, output, '--resume', '--workers', '1')
    assert ended.wait(SECONDS) == 3, ended.stderr.read()
    assert files(output) == files(done[0]), 'one worker or two write the same bytes'
    assert log(output)[:len(before)] == before
    assert len(log(output)) == 6 and len({line['recording'] for line in log(output)}) == 6


def test_nobody_else_can_reach_it_and_a_worker_that_is_killed_costs_nothing(
        recordings, done, tmp_path):
    """No process of it has a socket, and what lies in the folder of all is not touched."""
    scratch = tmp_path / 'dask-scratch-space'
    scratch.mkdir()
    scratch.chmod(0o777)
    running = command(recordings, tmp_path / 'results', TMPDIR=str(tmp_path))
    for number in (running.pid, *at_work(running)):
        for descriptor in Path(f'/proc/{number}/fd').glob('*'):
            # What has ended meanwhile has none.
            assert not (descriptor.is_symlink() and 'socket' in os.readlink(descriptor))
    for number in at_work(running):
        with suppress(ProcessLookupError):
            os.kill(number, signal.SIGKILL)
    said = running.communicate(timeout=SECONDS)[1]
    assert running.returncode == 3 and 'signal 9, Killed; tried again' in said
    assert files(tmp_path / 'results') == files(done[0])
    assert not list(scratch.iterdir())
    assert sorted(path.name for path in tmp_path.iterdir()) == ['dask-scratch-space', 'results']


def test_ctrl_c_ends_all_of_it(recordings, tmp_path):
    running = command(recordings, tmp_path / 'results')
    numbers = at_work(running)
    running.send_signal(signal.SIGINT)
    out, said = running.communicate(timeout=SECONDS)
    assert (running.returncode, out, said) == (130, '', '')
    late = time.monotonic() + SECONDS
    while any(Path(f'/proc/{number}').exists() for number in numbers):
        assert time.monotonic() < late, 'its processes end with it'


def test_a_name_that_is_no_text_has_its_map(recordings, tmp_path, capsys):
    folder, output = tmp_path / 'odd', tmp_path / 'results'
    folder.mkdir()
    try:
        shutil.copy(recordings / 'a.g2o', os.fsencode(folder) + b'/n\xff.g2o')
    except OSError:
        pytest.skip('names of files are text here')
    run(capsys, 'batch', folder, '--output', output, '--workers', '1')
    assert os.path.exists(os.fsencode(output) + b'/maps/n\xff.g2o.g2o')
    assert {name: row['status'] for name, row in rows(output).items()} == {
        r'n\udcff.g2o': 'converged'}


@contextmanager
def cluster(folder):
    """Yield the address of a scheduler with a worker."""
    pytest.importorskip('distributed')
    where = folder / 'scheduler.json'
    dask = [sys.executable, '-m']
    quiet = {'stdout': subprocess.DEVNULL, 'stderr': subprocess.DEVNULL, 'cwd': folder}
    others = [subprocess.Popen([*dask, 'distributed.cli.dask_scheduler', '--host', '127.0.0.1',
                                '--port', '0', '--no-dashboard', '--scheduler-file', where],
                               **quiet)]
    try:
        while not where.exists() or not where.read_text():
            assert others[0].poll() is None
            time.sleep(.05)
        others.append(subprocess.Popen(
            [*dask, 'distributed.cli.dask_worker', '--scheduler-file', where, '--nthreads', '2',
             '--no-dashboard', '--host', '127.0.0.1'], **quiet))
        yield json.loads(where.read_text())['address']
    finally:
        for other in others[::-1]:
            other.terminate()
            other.wait(SECONDS)


def test_a_scheduler_and_a_worker_of_their_own_do_the_same(recordings, done, tmp_path, capsys):
    """And who uses them without TLS is warned."""
    with cluster(tmp_path) as address:
        said = run(capsys, 'batch', recordings, '--output', tmp_path / 'results', '--scheduler',
                   address, code=3)[1]
    assert 'not tls://' in said
    assert files(tmp_path / 'results') == files(done[0])


def test_what_changed_and_what_failed_is_done_again(recordings, done, tmp_path, capsys):
    folder, output = tmp_path / 'in', tmp_path / 'results'
    shutil.copytree(recordings, folder)
    shutil.copytree(done[0], output)
    (folder / 'z.g2o').unlink()
    shutil.copy(recordings / 'a.g2o', folder / 'empty.mcap')
    (folder / 'a.g2o').write_text('no graph any more\n')
    run(capsys, 'batch', folder, '--output', output, '--resume', '--workers', '1', code=3)
    assert sorted(line['recording'] for line in log(output)[6:]) == ['a.g2o', 'empty.mcap']
    assert rows(output)['a.g2o']['status'] == 'failed' and 'z.g2o' not in rows(output)
    run(capsys, 'batch', folder, '--output', output, '--resume', 'failed', '--workers', '1',
        code=3)
    assert sorted(line['recording'] for line in log(output)[8:]) == [
        'a.g2o', 'deep/nonsense.g2o', 'empty.mcap']


def test_nothing_of_others_is_replaced(recordings, done, tmp_path, capsys):
    output = tmp_path / 'results'
    output.mkdir()
    (output / 'mine').write_text('kept')
    assert 'not empty' in run(capsys, 'batch', recordings, '--output', output, code=2)[1]
    assert 'no such file' in run(
        capsys, 'batch', recordings, '--output', output, '--resume', code=2)[1]
    assert [path.name for path in output.iterdir()] == ['mine']
    assert 'is the folder of the recordings' in run(
        capsys, 'batch', recordings, '--output', recordings, code=2)[1]
    assert 'expected --resume' in run(capsys, 'batch', recordings, '--output', done[0], code=2)[1]
    copy = tmp_path / 'copy'
    shutil.copytree(done[0], copy)
    (copy / 'table.csv').write_text('my own notes\n')
    assert 'not replaced' in run(
        capsys, 'batch', recordings, '--output', copy, '--resume', code=2)[1]
    assert (copy / 'table.csv').read_text() == 'my own notes\n'
    # It is taken up as it was begun or not at all; where all is done, nothing is done again.
    before = (done[0] / 'log.jsonl').read_bytes()
    again = ('batch', recordings, '--output', done[0], '--resume')
    assert 'give the same options' in run(capsys, *again, '--odom-topic', '/o', code=2)[1]
    run(capsys, *again, code=3)
    assert (done[0] / 'log.jsonl').read_bytes() == before


def test_dask_is_needed_for_a_cluster_alone(recordings, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, 'dask', None)
    said = run(capsys, 'batch', recordings, '--output', tmp_path / 'results', '--scheduler',
               'tls://localhost:1', code=2)[1]
    assert said.count('\n') == 1 and '--scheduler' in said and 'pip install distributed' in said
    run(capsys, 'batch', recordings / 'deep', '--output', tmp_path / 'others', code=3)


@pytest.mark.parametrize(('options', 'sentence'), [
    (('--workers', '0'), '--workers is 0'), (('--retries', '-1'), '--retries is -1'),
    (('--seconds', '0'), '--seconds is 0'), (('--memory', 'nan'), '--memory is nan'),
    (('--scheduler', 'tls://localhost:1'), 'nobody answers')])
def test_what_cannot_be_asked_for_is_refused(recordings, tmp_path, capsys, options, sentence):
    if '--scheduler' in options:
        pytest.importorskip('distributed')
    said = run(capsys, 'batch', recordings, '--output', tmp_path / 'results', *options, code=2)[1]
    assert sentence in said and said.count('\n') == 1


# The `sitecustomize` of processes that end at the recordings they read, by their names.
BAD_JOBS = """
import os, signal, sys

def bomb(path):
    kept = [bytearray(10**9) for _ in range(100)]

def quiet(path):
    os._exit(1)

def endless(path):
    while True:
        pass

def clock(path):
    signal.raise_signal(signal.SIGALRM)

def crash(path):
    os.kill(os.getpid(), signal.SIGSEGV)

def crash_once(path):
    if not os.path.exists(path + '.crashed'):
        os.close(os.open(path + '.crashed', os.O_CREAT))
        crash(path)

def opened(event, about):
    path = str(about[0]) if event == 'open' else ''
    what, _, suffix = os.path.basename(path).partition('.')
    if suffix == 'g2o' and what in globals() and 'batch' not in sys.argv:
        globals()[what](path)

sys.addaudithook(opened)
"""


@pytest.fixture(scope='module')
def ended(recordings, tmp_path_factory):
    """Return what comes of recordings that end the process which reads them, by their names."""
    folder, hooks = tmp_path_factory.mktemp('bad'), tmp_path_factory.mktemp('hooks')
    (hooks / 'sitecustomize.py').write_text(BAD_JOBS)
    for name in ('bomb', 'quiet', 'endless', 'clock', 'crash', 'crash_once'):
        shutil.copy(recordings / 'a.g2o', folder / f'{name}.g2o')
    output = tmp_path_factory.mktemp('ended') / 'results'
    searched = [str(hooks), *filter(None, [os.environ.get('PYTHONPATH')])]
    process = command(folder, output, '--retries', '1', '--seconds', '2', '--memory', '2',
                      PYTHONPATH=os.pathsep.join(searched))
    said = process.communicate(timeout=SECONDS)[1]
    assert process.returncode == 3, said
    return rows(output), said


@pytest.mark.parametrize(('what', 'sentence'), [
    ('bomb', 'not enough memory'), ('quiet', 'ended with code 1 and said nothing, 2 times'),
    ('endless', 'took more than 2 s of the processor'), ('clock', 'took more than 20 s by the'),
    ('crash', 'ended by signal 11, Segmentation fault, 2 times'), ('crash_once', '')])
def test_what_ends_a_process_is_tried_again_and_said(ended, what, sentence):
    row, said = ended[0][f'{what}.g2o'], ended[1]
    assert row['status'] == ('failed' if sentence else 'converged') and sentence in row['sentence']
    again = [line for line in said.splitlines() if f'{what}.g2o' in line]
    assert any('tried again' in line for line in again) == (
        what == 'crash_once' or '2 times' in sentence)


def test_recordings_are_found_however_deep_and_bags_as_a_whole(tmp_path, capsys):
    for name in ('b/bag/metadata.yaml', 'b/bag/bag_0.mcap', 'b/loose.mcap', 'notes.txt',
                 '.hidden/x.g2o', 'metadata.yaml'):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text('x')
    (tmp_path / 'a.G2O').write_text('EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n')
    (tmp_path / 'b' / 'circle').symlink_to(tmp_path)
    for more in (), ('--resume',):  # the second time its own maps are there, too
        run(capsys, 'batch', tmp_path, '--output', tmp_path / 'out', *more, code=3)
        assert list(rows(tmp_path / 'out')) == ['a.G2O', 'b/bag', 'b/loose.mcap']
        assert (tmp_path / 'out' / 'maps' / 'a.G2O.g2o').exists()
