# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Kept machine code of loops: the same as numba's, and none at all where it is not sound."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from llvmlite import binding
from work import WORK

from l1slam_ros.core import kernels
from l1slam_ros.core.geometry import se3
from l1slam_ros.core.kernels.compiled import Loop
from l1slam_ros.core.kernels.kept import objects
from l1slam_ros.io import compilation
from l1slam_ros.io.compilation import SCANS, STEPS, fill_cache, with_space

TESTS = Path(__file__).parents[2]
# Calls loops both ways, the first times that each is called with arguments of some types.
BOTH = """
import collections
import copy
from l1slam_ros.core.kernels.compiled import Loop

def told(value):
    parts = value if isinstance(value, tuple) else (value,)
    return [(type(part), getattr(part, 'dtype', None), np.shape(part), np.asarray(part).tobytes())
            for part in parts]

def types(arguments):
    return tuple((getattr(one, 'dtype', type(one)), np.ndim(one),
                  len(one) if isinstance(one, tuple) else 0) for one in arguments)

def both(loop, *arguments):
    if calls[loop, types(arguments)] >= 3:
        return kept(loop, *arguments)
    calls[loop, types(arguments)] += 1
    copies = copy.deepcopy(arguments)
    result, other = kept(loop, *arguments), loop.dispatcher(*copies)
    assert told(result) == told(other), loop
    for one, copied in zip(arguments, copies):
        assert told(one) == told(copied), loop
    return result

calls, kept = collections.Counter(), Loop.__call__
Loop.__call__ = both
"""
# What the work of `test_warm_up` does not call: blocks of angles and of positions, dissection,
# scans.
MORE = """
sys.path.insert(0, 'core/solvers')
import test_restarted_pdhg as pages
import tempfile
from pathlib import Path
from rooms import laps, write_log
from l1slam_ros.core import scans
from l1slam_ros.core.graph.spanning_tree import odometry_poses
from l1slam_ros.core.kernels import ordering
from l1slam_ros.core.scans.occupancy import grid
from l1slam_ros.io.scans.reading import read_scans

for k in (1, 2):
    generator = np.random.default_rng(0)
    pages.test_the_kernel_takes_the_steps_of_the_page(k, np.float32, 2e-4, generator)
    pages.test_a_look_finds_the_next_point_and_its_residual(k, generator)
node = np.arange(1600).reshape(40, 40)  # of a torus
beside = [np.roll(node, shift, axis) for shift, axis in ((1, 0), (-1, 0), (1, 1), (-1, 1))]
adjacent = np.stack(beside, axis=-1).astype(np.int32).ravel()
ordering.dissect(np.arange(0, 6401, 4, dtype=np.int32), adjacent)
log = Path(tempfile.mkdtemp()) / 'room.clf'
write_log(log, *laps()[:2])
made = read_scans(log, 'odom', None, lambda *_: None)
grid.draw(made.points, odometry_poses(made.record.graph))
MODULES += scans.kernels, scans.search_kernels
for loop in {loop for module in MODULES for loop in vars(module).values()
             if getattr(loop, 'takes', ()) or getattr(loop, 'takes_in_space', ())}:
    versions = len(loop.takes) + len(loop.takes_in_space)
    called = {what for one, what in calls if one is loop}
    if not versions == len(loop.linked) == len(called):
        print(loop.__name__)
print(len(calls))
"""
# Arguments that fit no version of `whiten`, each but for one thing.
UNFIT = {
    'single precision': lambda: (np.ones((2, 3, 3), np.float32), np.ones((2, 3)), (0, 0, 0)),
    'another byte order': lambda: (np.ones((2, 3, 3), '>f8'), np.ones((2, 3)), (0, 0, 0)),
    'other dimensions': lambda: (np.ones((2, 3)), np.ones((2, 3)), (0, 0, 0)),
    'columns first': lambda: (np.ones((2, 3, 3)), np.asfortranarray(np.ones((2, 3))), (0, 0, 0)),
    'with gaps': lambda: (np.ones((2, 3, 3)), np.ones((2, 6))[:, ::2], (0, 0, 0)),
    'read only': lambda: (np.ones((2, 3, 3)), np.broadcast_to(np.ones((2, 3)), (2, 3)), (0, 0, 0)),
    'not aligned': lambda: (np.ones((2, 3, 3)), np.frombuffer(bytearray(49), np.uint8)[1:].view(
        np.float64).reshape(2, 3), (0, 0, 0)),
    'a child of arrays': lambda: (np.ones((2, 3, 3)), np.ones((2, 3)).view(np.matrix), (0, 0, 0)),
    'a list': lambda: (np.ones((2, 3, 3)), [[1.0] * 3] * 2, (0, 0, 0)),
    'two entries': lambda: (np.ones((2, 3, 3)), np.ones((2, 3)), (0, 0)),
    'truths': lambda: (np.ones((2, 3, 3)), np.ones((2, 3)), (True, True, True)),
    'an array for a tuple': lambda: (np.ones((2, 3, 3)), np.ones((2, 3)), np.zeros((1, 1, 1))),
    'nothing': lambda: (),
    'one more': lambda: (np.ones((2, 3, 3)), np.ones((2, 3)), (0, 0, 0), 1),
}
FITS = (np.ones((2, 3, 3)), np.ones((2, 3)), (0, 0, 0))


@pytest.fixture(scope='module', autouse=True)
def full_cache():
    fill_cache(lambda done, total: None, lambda: False, with_space((*STEPS, *SCANS), se3))


def run(code, **settings):
    done = subprocess.run([sys.executable, '-X', 'faulthandler', '-c', code], text=True,
                          capture_output=True, timeout=300, cwd=TESTS,
                          env={**os.environ, **settings})
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


def test_the_loops_that_are_brief_keep_the_interpreters_lock_and_no_others():
    brief = set()
    for step in with_space((*STEPS, *SCANS), se3):
        for name, versions in objects.read(step).items():
            for kept in versions:
                lets_go = {'PyEval_SaveThread', 'PyEval_RestoreThread'} & set(kept.missing)
                assert len(lets_go) in (0, 2)
                if not lets_go:
                    brief.add((step, name))
    assert brief == {('border', name) for name in ('follow', 'predict', 'pull', 'move')}


def test_every_loop_gives_the_same_by_both_ways():
    work = WORK[:WORK.index('assert fill_cache')]
    rest = WORK[WORK.index('world = spoilt'):WORK.index('for missing in compiled_here')]
    wrong = run(work + BOTH + rest + MORE)
    assert len(wrong) == 1, wrong
    assert int(wrong[0]) > 40


@pytest.fixture
def loop():
    """A loop that has been linked; calls that go to numba are noted instead."""
    made = Loop(kernels.blocks.whiten.py_func, *[('one',)] * 2)
    assert np.all(made(*FITS) == [3.0, 2.0, 1.0])
    assert not made.by_numba
    made._dispatcher = lambda *arguments: len(arguments)
    return made


@pytest.mark.parametrize('what', UNFIT)
def test_what_does_not_fit_goes_to_numba(loop, what):
    arguments = UNFIT[what]()
    assert type(loop(*arguments)) is int
    assert np.all(loop(*FITS) == [3.0, 2.0, 1.0])


@pytest.mark.parametrize('at', [np.int32(0), True, 0.0, '0'])
def test_a_number_of_another_type_goes_to_numba(at):
    made = Loop(kernels.border.follow.py_func, ('one',))
    made._dispatcher = lambda *arguments: 'numba'
    blocks = np.ones((1, 3, 3))
    assert made(blocks, at, blocks[0], blocks[0], blocks) == 'numba'
    assert made.linked


@pytest.fixture
def copy_of_cache(tmp_path, monkeypatch):
    """The file that keeps a step, alone in a folder that is looked in first and last."""
    whole = Path(objects.files('blocks')[0]).read_bytes()
    monkeypatch.setattr(objects, 'folders', lambda: [tmp_path])
    path = tmp_path / objects.file_name('blocks')
    path.write_bytes(whole)
    assert objects.read('blocks')
    return path


def test_a_damaged_file_is_as_none(copy_of_cache, rng):
    whole = copy_of_cache.read_bytes()
    head = whole.index(b'\n')
    places = {*range(0, head, 97), head, len(whole) - 1, *rng.integers(0, len(whole), 300)}
    for place in places:
        copy_of_cache.write_bytes(whole[:place] + bytes([whole[place] ^ 1 << int(place) % 8])
                                  + whole[place + 1:])
        assert not objects.read('blocks') and not objects.files('blocks')
        copy_of_cache.write_bytes(whole[:place])
        assert not objects.read('blocks')
    copy_of_cache.write_bytes(whole + b'\0')
    assert not objects.read('blocks')
    copy_of_cache.write_bytes(whole)
    assert objects.read('blocks')


@pytest.mark.parametrize('name, setting', [('NUMBA_CPU_NAME', 'x86-64'), ('NUMBA_OPT', '1')])
def test_code_made_otherwise_is_not_used(copy_of_cache, monkeypatch, name, setting):
    assert os.environ.get(name) != setting
    monkeypatch.setenv(name, setting)
    assert not objects.read('blocks')


@pytest.mark.parametrize('name, setting', [
    ('NUMBA_NUM_THREADS', '1'), ('NUMBA_THREADING_LAYER', 'omp'), ('NUMBA_CACHE_DIR', '/nowhere')])
def test_settings_that_code_does_not_depend_on_ask_for_no_other(copy_of_cache, monkeypatch, name,
                                                                setting):
    monkeypatch.setenv(name, setting)
    assert objects.read('blocks')


@pytest.mark.parametrize('made, whole', [(True, 1), (False, 3)])
def test_only_a_folder_that_is_named_is_used_if_it_can_be(tmp_path, monkeypatch, made, whole):
    named = tmp_path / 'named'
    if not made:
        named.write_text('')
    monkeypatch.setenv('NUMBA_CACHE_DIR', str(named))
    assert objects.folders()[0] == named
    assert len(objects.folders()) == whole


def test_who_shares_a_folder_but_not_the_settings_replaces_nothing(copy_of_cache, monkeypatch):
    kept = objects.read('blocks')
    with monkeypatch.context() as patched:
        patched.setenv('NUMBA_OPT', '1')
        other = Path(objects.write('blocks', {'whiten': kept['whiten']}, []))
        assert objects.read('blocks') == {'whiten': kept['whiten']}
    assert objects.read('blocks') == kept
    assert {copy_of_cache, other} == set(copy_of_cache.parent.glob('*.blocks'))


@pytest.mark.parametrize('of, what, found', [
    (binding, 'get_host_cpu_name', lambda: 'another'), (binding, 'get_host_cpu_features', dict),
    (objects, '_machine_and_libraries', str)])
def test_code_of_another_processor_library_or_source_is_not_used(copy_of_cache, monkeypatch, of,
                                                                 what, found):
    monkeypatch.setattr(of, what, found)
    assert not objects.read('blocks')


def test_code_of_an_upgrade_is_not_used_by_a_process_that_began_before(copy_of_cache, monkeypatch):
    """It has the older functions that call these loops."""
    source = objects.KERNELS / 'blocks.py'
    monkeypatch.setitem(objects._imported, source, (1, 1))
    assert not objects.read('blocks') and not objects.is_as_imported(source)


def test_code_of_another_source_is_not_used(copy_of_cache, monkeypatch):
    read = Path.read_bytes
    monkeypatch.setattr(Path, 'read_bytes', lambda path: read(path) + (
        b'# A change.' if path.name == 'blocks.py' else b''))
    assert not objects.read('blocks')


# Makes a step, once all who shall are ready.
MAKE = """
import sys, time
from pathlib import Path
from l1slam_ros.io import compilation

print('ready', flush=True)
sys.stdin.read()
before = time.process_time()
print(*compilation.make('interior_point'), time.process_time() - before)
"""


# Makes a step; prints the functions of which numba made machine code.
NOTED = """
from l1slam_ros.core.kernels import compiled
from numba.core import codegen

def noted(library):
    made.add(library.name)
    finish(library)

made, finish = set(), codegen.JITCodeLibrary._finalize_specific
codegen.JITCodeLibrary._finalize_specific = noted
assert compiled.keep('se2')
print(*sorted(made - {'nrt'}))
"""


def test_what_only_loops_call_has_no_machine_code_of_its_own(tmp_path):
    said = subprocess.run([sys.executable, '-c', NOTED], check=True, text=True,
                          stdout=subprocess.PIPE,
                          env={**os.environ, 'NUMBA_CACHE_DIR': str(tmp_path)}).stdout
    assert said.split() == ['curvature', 'jacobians', 'residual']


def test_two_who_make_the_same_at_once_make_it_once(tmp_path):
    both = [subprocess.Popen([sys.executable, '-c', MAKE], stdin=subprocess.PIPE, text=True,
                             stdout=subprocess.PIPE, env={**os.environ, 'NUMBA_CACHE_DIR':
                                                          str(tmp_path)}) for _ in range(2)]
    for one in both:
        assert one.stdout.readline() == 'ready\n'
    for one in both:
        one.stdin.close()
    (*files, first), (*others, last) = sorted((one.stdout.read().split() for one in both),
                                              key=lambda said: float(said[-1]))
    assert files == others and all(map(os.path.exists, files)) and len(files) > 1
    assert float(first) < float(last) / 4
    assert [one.wait() for one in both] == [0, 0]


def test_nobody_waits_for_ever_for_one_who_is_stopped(tmp_path, monkeypatch):
    monkeypatch.setattr(objects, 'folders', lambda: [tmp_path])
    monkeypatch.setattr(compilation, '_PATIENCE', 0.2)
    with compilation.alone('blocks'), compilation.alone('se2'), compilation.alone('blocks'):
        pass


# Calls a loop; prints whether numba was imported for it.
CALL = """
import sys
import numpy as np
from l1slam_ros.core.kernels import blocks
from l1slam_ros.core.kernels.kept import objects
{before}
assert np.all(blocks.whiten(np.ones((2, 3, 3)), np.ones((2, 3)), (0, 0, 0)) == [3.0, 2.0, 1.0])
print('numba' in sys.modules)
"""
READ = 'read = objects.read\nobjects.read = lambda step: {name: [one._replace(%s) ' \
       'for one in kept] for name, kept in read(step).items()}'
SURPRISES = {
    'a name that nobody defines': READ % "missing=[*one.missing, 'l1slam_no_such_name']",
    'another name inside': READ % "entry='another'",
    'an unknown type': READ % "takes=[('array', 'nonsense', 1)]",
    'no helpers': "objects.helpers = lambda: {'numba._helperlib': None}",
    'nothing as it was': 'objects.read = lambda step: 1 / 0',
}


def test_a_kept_loop_needs_no_numba():
    assert run(CALL.format(before='')) == ['False']


@pytest.mark.parametrize('surprise', SURPRISES)
def test_a_surprise_is_left_to_numba(surprise):
    assert run(CALL.format(before=SURPRISES[surprise])) == ['True']


def test_threads_may_call_first_at_the_same_time():
    code = """
import sys, threading
import numpy as np
from l1slam_ros.core import kernels

def work(k):
    generator = np.random.default_rng(k)
    z, x, y = (generator.standard_normal((500, 3)) for _ in range(3))
    gate.wait()
    for _ in range(200):
        results[k].append((kernels.se2.residual(z, x, y), kernels.se2.jacobians(z, x, y)))

gate, results = threading.Barrier(8), {k: [] for k in range(8)}
threads = [threading.Thread(target=work, args=(k,)) for k in range(8)]
[thread.start() for thread in threads]
[thread.join() for thread in threads]
for found in results.values():
    assert len(found) == 200
    for e, J in found:
        assert np.array_equal(e, found[0][0]) and np.array_equal(J, found[0][1])
print('numba' in sys.modules)
"""
    assert run(code) == ['False']


def test_an_error_in_a_loop_is_raised_as_by_numba():
    code = """
import numpy as np
from l1slam_ros.core.kernels import border
said = []
# Fewer than no panels.
i, l, blocks = np.zeros(0, np.int32), np.zeros(1, np.int64), np.ones((1, 3, 3))
for call in border.reach, border.reach.dispatcher:
    try:
        call(blocks.ravel(), i, l, i, l, l, i, l, l, blocks, blocks)
    except Exception as error:
        said.append((type(error), str(error)))
assert border.reach.linked
print(len(said), said[0] == said[1])
"""
    assert run(code) == ['2', 'True']


def test_numba_comes_later_without_a_second_start_of_its_memory():
    """Arrays that loops return are of numba's memory; others may be in use as numba comes."""
    code = """
import numpy as np
from l1slam_ros.core.kernels import blocks
from l1slam_ros.core.kernels.kept import link
whiten, arguments = blocks.whiten, (np.ones((2, 3, 3)), np.ones((2, 3)), (0, 0, 0))
kept = [whiten(*arguments) for _ in range(100)]
link._modules['_nrt_python'].memsys_enable_stats()
before = link._modules['_nrt_python'].memsys_get_stats_alloc()
kept += [whiten(*arguments) for _ in range(100)]
import numba
from numba.core.runtime import _nrt_python
assert _nrt_python.memsys_stats_enabled()
assert _nrt_python.memsys_get_stats_alloc() >= before + 100
kept += [call(*arguments) for call in (whiten, whiten.dispatcher) for _ in range(100)]
print(all(np.all(one == [3.0, 2.0, 1.0]) for one in kept))
del kept
"""
    assert run(code) == ['True']
