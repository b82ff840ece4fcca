# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Filling the cache of compiled loops before they are needed, by processes of their own.

A loop is compiled at its first use after an installation, and later read from the cache. The
modules of `kernels` know not of each other, so each can be made ready in a process of its own.

In: nothing. Out: numba's cache, and beside it a note of what it holds, by which the next call
knows without numba that nothing is to be done. The note counts only for the very sources, Python,
numba and processor that it was made with, and while the files it names are there.
"""

import ctypes
import gc
import hashlib
import json
import os
import select
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from importlib import import_module

from l1slam_ros.core.geometry.manifold import Manifold
from l1slam_ros.core.kernels import compiled
from l1slam_ros.core.kernels.kept import objects
from l1slam_ros.io.progress import Progress

# What a sparse graph is solved by, what false loops are told by, what a dense graph is solved by,
# what keeps up with a graph that grows: modules of `kernels`, those first that take long to
# compile.
SPARSE = ('cholesky', 'substitution', 'ordering', 'symbolic', 'blocks', 'interior_point', 'se2')
JUDGEMENT = ('prediction',)
DENSE = ('halpern',)
ONLINE = ('border',)
# What scans are matched by: elsewhere in `core`.
SCANS = ('scans.kernels', 'scans.search_kernels')
STEPS = ('halpern', *SPARSE[:2], *JUDGEMENT, *ONLINE, *SPARSE[2:])
# What poses in space need besides; after the colon: the versions for them of that module's loops.
IN_SPACE = {'halpern': f'halpern{objects.SPACE}', 'cholesky': f'cholesky{objects.SPACE}',
             'blocks': f'blocks{objects.SPACE}', 'se2': 'se3'}

# A process makes so many steps at least: to import numba takes as long as one of them.
_STEPS_EACH = 3
# [s] How often the caller is asked whether to stop, and whether another process is done.
_LOOK = 0.1
# [s] How long a process waits for another one that makes the same step.
_PATIENCE = 60.0
# Of glibc's `mallopt`: from which size on an array has pages of its own, and how much may lie free
# at the end of a heap. Left alone it raises both, to tens of megabytes for each thread.
_MMAP_THRESHOLD, _TRIM_THRESHOLD = -3, -1
# [bytes] NumPy asks for huge pages from here on: then fresh ones cost no more than to reuse some.
_HUGE = 2**22
# Other processes go first, though not by far: whoever waits for the loops waits for these.
_NICE = 5


def with_space(steps: tuple[str, ...], manifold: Manifold) -> tuple[str, ...]:
    """Return the steps, and where the poses are not in the plane, what they need besides."""
    if manifold.NAME == 'SE2':
        return steps
    return (*(IN_SPACE[step] for step in steps if step in IN_SPACE), *steps)


def compile_now(steps: Sequence[str], quiet: bool = False) -> None:
    """Compile some of `STEPS`, which takes long only at the first use on a machine."""
    with Progress(None, 'part', quiet, 'compiling, once on this machine', delay=1.0) as progress:
        fill_cache(progress.reach, lambda: False, steps)


def fill_cache(report: Callable[[int, int], None], stopped: Callable[[], bool],
               steps: Sequence[str] = STEPS) -> bool:
    """
    Compile what is not in the cache yet; returns at once where nothing is missing.

    What is not compiled here, for whatever reason, is when it is first called.

    Parameters
    ----------
    report : called with how many steps are done, of how many: at first, and whenever one is
    stopped : asked now and then; once it says yes, compiling ends and the call returns
    steps : what is needed, of `STEPS`

    Returns
    -------
    whether all of it is in the cache now

    """
    known = _noted()
    missing = [step for step in steps if step not in known]
    if not missing:
        return True
    if stopped() or not any(map(objects.is_writable, objects.folders())):
        return False
    report(0, len(missing))
    for done, (step, files) in enumerate(_compiled(missing, stopped), 1):
        if files:
            known = {**known, **_noted(), step: files}  # another thread may note others
            _note(known)
        report(done, len(missing))
    return set(steps) <= known.keys()


def _compiled(steps: list[str], stopped: Callable[[], bool]) -> Iterator[tuple[str, list[str]]]:
    """Yield each step and the files that keep it, as processes are done with them."""
    count = max(1, min(_cores(), len(steps) // _STEPS_EACH))
    workers = [_start(steps[first::count]) for first in range(count)]
    busy = {worker.stdout for worker in workers if worker.stdout}
    try:
        while busy and not stopped():
            for answers in select.select(busy, [], [], _LOOK)[0]:
                # A process that is done, or broke, says nothing more; the others go on.
                if line := answers.readline():
                    step, files = json.loads(line)
                    yield step, files
                else:
                    busy.remove(answers)
    finally:
        for worker in workers:
            with worker:
                worker.kill()


def _start(steps: list[str]) -> 'subprocess.Popen[str]':
    """Start a process that finds its modules where this one does."""
    code = (f'import sys; sys.path[:] = {sys.path!r}; '
            f'from l1slam_ros.io.compilation import work; work({steps!r})')
    return subprocess.Popen([sys.executable, '-c', code], stdin=subprocess.PIPE,
                            stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)


def work(steps: list[str]) -> None:
    """Make some steps ready, each said on standard output; end when the parent does."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a person's Ctrl-C is for the parent
    os.nice(_NICE)

    def end_with_parent() -> None:
        sys.stdin.read()
        os._exit(0)

    threading.Thread(target=end_with_parent, daemon=True).start()
    # What numba makes it holds on to: to look for garbage takes a tenth of the time, in vain.
    gc.disable()
    for step in steps:
        print(json.dumps([step, make(step)]), flush=True)


def make(step: str) -> list[str]:
    """Compile a step if no other process does; return the files that keep it."""
    with alone(step):
        return compiled.keep(step)


@contextmanager
def alone(step: str) -> Iterator[None]:
    """Keep other processes from making a step for the same folder; wait until none does."""
    with ExitStack() as held:
        with suppress(ImportError, OSError, StopIteration):  # nowhere to lock
            import fcntl

            folder = next(filter(objects.is_writable, objects.folders()))
            path = folder / objects.file_name(f'{step}.lock')
            file = held.enter_context(path.open('w'))
            # Whoever holds it may be stopped, by Ctrl-Z: then both make it.
            end = time.monotonic() + _PATIENCE
            while time.monotonic() < end:
                with suppress(BlockingIOError):
                    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    break
                time.sleep(_LOOK)
        yield


def load(steps: Sequence[str] = STEPS) -> None:
    """Read the loops of some steps into a process that is to keep a map."""
    for step in steps:
        make_ready(step)
    # Some 100,000 objects that stay: to look at them for garbage takes a tenth of a second.
    gc.collect()
    gc.freeze()
    with suppress(AttributeError, OSError):  # another C library
        ctypes.CDLL(None).mallopt(_MMAP_THRESHOLD, _HUGE)
        # As it would by itself.
        ctypes.CDLL(None).mallopt(_TRIM_THRESHOLD, 2 * _HUGE)


def make_ready(step: str) -> None:
    """Link the loops of one step, or have them read or compiled."""
    module = import_module(objects.module_of(step))
    for loop in list(vars(module).values()):
        if hasattr(loop, 'takes'):
            compiled.make_ready(loop, step.endswith(objects.SPACE))


def _cores() -> int:
    """Return how many processors this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, 'sched_getaffinity') else (
        os.cpu_count() or 1)


def _noted() -> dict[str, list[str]]:
    """Return the steps that are in the cache, and the files that keep each."""
    for folder in objects.folders():
        try:
            note = json.loads((folder / objects.file_name('json')).read_text())
        except (OSError, ValueError):
            continue
        if note['key'] == _key():
            return {step: files for step, files in note['steps'].items()
                    if all(map(os.path.exists, files))}
    return {}


def _note(steps: dict[str, list[str]]) -> None:
    """Write down what is in the cache; a reader finds all of the note or none."""
    note = {'key': _key(), 'steps': steps}
    objects.put(objects.file_name('json'), json.dumps(note).encode())


def _key() -> str:
    """Return what changes with the sources; on the rest depends how the note is called."""
    return hashlib.sha256(repr(objects.sources()).encode()).hexdigest()
