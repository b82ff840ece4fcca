# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Compile the loops of `kernels` before they are needed, in processes of their own.

A loop is compiled at its first use after an installation, and later read from the cache. The
modules of `kernels` do not import each other, so each can be compiled in its own process.

Out: the cache of compiled loops, and beside it a note of what the cache holds, from which the next
call knows, without importing numba, that nothing is to be done. The note is valid for the sources,
Python, numba and processor with which it was made, as long as the files it names exist.
"""

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

# Modules of `kernels` for a sparse graph, for judging loops, for a dense graph, and for a graph
# that grows.
# What poses in space need in addition: versions of a module's loops for arrays of other sizes.
IN_SPACE: dict[str, str] = {}

# Least number of steps for each process: importing numba takes as long as one step.
_STEPS_EACH = 3
# [s] Period of the checks whether to stop, and whether another process has finished.
_LOOK = 0.1
# [s] How long a process waits for another one that compiles the same step.
_PATIENCE = 60.0
# Niceness of the compiling processes: low, because somebody waits for them.
_NICE = 5


def with_space(steps: tuple[str, ...], manifold: Manifold) -> tuple[str, ...]:
    """Return the steps, and those that poses of SE(3) need in addition."""
    if manifold.NAME == 'SE2':
        return steps
    return (*(IN_SPACE[step] for step in steps if step in IN_SPACE), *steps)


def compile_now(steps: Sequence[str], quiet: bool = False) -> None:
    """Compile some of `STEPS` with a progress line; quick after the first use on a machine."""
    with Progress(None, 'part', quiet, 'compiling, once on this machine', delay=1.0) as progress:
        fill_cache(progress.reach, lambda: False, steps)


def fill_cache(report: Callable[[int, int], None], stopped: Callable[[], bool],
               steps: Sequence[str] = STEPS) -> bool:
    """
    Compile the steps that are not in the cache yet; return at once if none is missing.

    A loop that is not compiled here, for whatever reason, is compiled when it is first called.

    Parameters
    ----------
    report : called with the number of steps that are done and of all, at first and after each step
    stopped : asked periodically; when it returns True, compiling ends and the call returns
    steps : the steps that are needed, of `STEPS`

    Returns
    -------
    whether all of these steps are in the cache now

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
    """Yield each step and its files in the cache, when a process has compiled it."""
    count = max(1, min(cores(), len(steps) // _STEPS_EACH))
    workers = [_start(steps[first::count]) for first in range(count)]
    busy = {worker.stdout for worker in workers if worker.stdout}
    try:
        while busy and not stopped():
            for answers in select.select(busy, [], [], _LOOK)[0]:
                # A process that has finished or failed closes its output; the others go on.
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
    """Start a process that compiles steps, with the module search path of this one."""
    code = (f'import sys; sys.path[:] = {sys.path!r}; '
            f'from l1slam_ros.io.compilation import work; work({steps!r})')
    return subprocess.Popen([sys.executable, '-c', code], stdin=subprocess.PIPE,
                            stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)


def work(steps: list[str]) -> None:
    """Compile steps and print a line for each; end when the parent process ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent
    os.nice(_NICE)

    def end_with_parent() -> None:
        sys.stdin.read()
        os._exit(0)

    threading.Thread(target=end_with_parent, daemon=True).start()
    # numba keeps all that it makes, so searching for garbage would waste a tenth of the time.
    gc.disable()
    for step in steps:
        print(json.dumps([step, make(step)]), flush=True)


def make(step: str) -> list[str]:
    """Compile a step unless another process has; return its files in the cache."""
    with alone(step):
        return compiled.keep(step)


@contextmanager
def alone(step: str) -> Iterator[None]:
    """Hold a lock on a step of the cache folder, so that only one process compiles it."""
    with ExitStack() as held:
        with suppress(ImportError, OSError, StopIteration):  # no lock is possible
            import fcntl

            folder = next(filter(objects.is_writable, objects.folders()))
            path = folder / objects.file_name(f'{step}.lock')
            file = held.enter_context(path.open('w'))
            # The holder may be stopped by Ctrl-Z: then both compile the step.
            end = time.monotonic() + _PATIENCE
            while time.monotonic() < end:
                with suppress(BlockingIOError):
                    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    break
                time.sleep(_LOOK)
        yield


def load(steps: Sequence[str] = STEPS) -> None:
    """Load the compiled loops of some steps, which stay: no search for garbage looks at them."""
    for step in steps:
        make_ready(step)
    # Some 100,000 objects stay; each search of them for garbage would take a tenth of a second.
    gc.collect()
    gc.freeze()


def make_ready(step: str) -> None:
    """Link the loops of one step from the cache, or let numba read or compile them."""
    module = import_module(objects.module_of(step))
    for loop in list(vars(module).values()):
        if hasattr(loop, 'takes'):
            compiled.make_ready(loop, step.endswith(objects.SPACE))


def cores() -> int:
    """Return the number of processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, 'sched_getaffinity') else (
        os.cpu_count() or 1)


def _noted() -> dict[str, list[str]]:
    """Return the steps that are in the cache, and the files of each."""
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
    """Write the note of what is in the cache, whole or not at all."""
    note = {'key': _key(), 'steps': steps}
    objects.put(objects.file_name('json'), json.dumps(note).encode())


def _key() -> str:
    """Return a digest of the sources; Python, numba and machine are in the name of the note."""
    return hashlib.sha256(repr(objects.sources()).encode()).hexdigest()
