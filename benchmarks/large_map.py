# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
What an update of a large map costs, in time and in memory, while the map is drawn and saved.

    python benchmarks/large_map.py [--poses 200000] [--edges 400000] [--live 4000] [--rate 50]
        [--folder DIR]

A world of streets is driven. A back end takes in the messages of all but the last keyframes
without an update, and is saved with the exact L1 map of their factors; that map stays in the
folder, for the next run. A second process loads it and goes on from there, live: an update after
each of the last keyframes, all loops doubted, with all work behind it. Once a second meanwhile all
keyframes are asked for, as a Path takes them, and half way the map is saved. Memory is what the
process has resident beyond what it had before it loaded the map.
"""

import argparse
import multiprocessing
import os
import resource
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from itertools import islice
from multiprocessing.connection import Connection
from pathlib import Path
from typing import NamedTuple

import peer_environment

os.environ.update(peer_environment.ONE_THREAD)
import numpy as np

from l1slam_ros.core.graph.measurements import LoopClosure, OdometrySample
from l1slam_ros.core.online.keyframes import KeyframeOptions, OdometryOptions
from l1slam_ros.core.robust.judgement import Judgement
from l1slam_ros.core.running.backend import Backend, BackendOptions
from l1slam_ros.core.running.optimised import Optimised
from l1slam_ros.core.solvers.nonlinear import OptimiserOptions
from l1slam_ros.core.solvers.solve import AUTO, choose, minimise_by
from l1slam_ros.core.worlds.simulate import World, WorldOptions, simulate_world
from l1slam_ros.io.free_memory import give_back_freed_memory
from l1slam_ros.io.graphs.saved_map import load_map, save_map
from l1slam_ros.paper.updates import Drive

Message = tuple[OdometrySample, list[LoopClosure]]
# Each keyframe of the world is one of the back end.
_OPTIONS = BackendOptions(KeyframeOptions(0.0, 0.0, 0.0), OdometryOptions('increment'))
# [s] How often all keyframes are asked for; the driver lags behind its rate by no more.
_DRAWN_EVERY, _LAG = 1.0, 0.1
_DUE = 50


class Sizes(NamedTuple):
    """How large the world is, how many of its keyframes come live, and in which folder it is."""

    poses: int
    edges: int
    live: int
    folder: Path

    @property
    def file(self) -> Path:
        """The file of the map that is there before."""
        return self.folder / f'{self.poses}_{self.edges}_{self.live}.g2o'

    def world(self) -> World:
        """Return the world."""
        return simulate_world(self.poses, self.edges, WorldOptions(), np.random.default_rng(0))


def main() -> None:
    """Measure, and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or '').strip().splitlines()[0])
    parser.add_argument('--poses', type=int, default=200_000)
    parser.add_argument('--edges', type=int, default=400_000)
    parser.add_argument('--live', type=int, default=4_000, help='keyframes that come live')
    parser.add_argument('--rate', type=float, default=50.0, help='of these per second')
    parser.add_argument('--folder', type=Path, help='keeps the map for the next run')
    given = parser.parse_args()
    give_back_freed_memory()
    with tempfile.TemporaryDirectory() as folder:
        sizes = Sizes(given.poses, given.edges, given.live, given.folder or Path(folder))
        if not sizes.file.exists():
            _aside(partial(_make, sizes))
        _measure(sizes, given.rate)


def _aside(work: Callable[[], None]) -> None:
    """Do some work in a process of its own, whose memory is given back then."""
    process = multiprocessing.get_context('fork').Process(target=work)
    process.start()
    process.join()
    if process.exitcode:
        raise SystemExit(process.exitcode)


def _make(sizes: Sizes) -> None:
    """Save the map that there is before the live keyframes, all of its loops believed."""
    world, n = sizes.world(), sizes.poses - sizes.live
    with Backend(_OPTIONS) as backend:
        began = time.process_time()
        for k, message in enumerate(islice(Drive.of(world.graph).messages, n)):
            _feed(backend, message)
            if k % _DUE == 0:
                backend.snapshot()  # makes factors of the loops before they expire
        saved = backend.saved()
        took = (time.process_time() - began) / n
    print(f'{n:,} keyframes and their loops taken in: {1e6 * took:.0f} us each', flush=True)
    graph = saved.builder.graph
    m, began = len(graph.between), time.process_time()
    found, _ = minimise_by(choose(AUTO, graph), graph, world.truth[:n], OptimiserOptions())
    print(f'their exact map, from the truth: {time.process_time() - began:.0f} CPU s', flush=True)
    believed = replace(Judgement.nothing(), accepted=np.ones(m, bool), suspect=np.zeros(m, bool),
                       sigmas=np.zeros(m), noise=np.ones(m))
    # As it is while messages come: more is to be done.
    optimised = Optimised(found.poses, found.dual, found.cost, found.status, 0).unfinished()
    save_map(sizes.file, replace(saved, optimised=optimised, judgement=believed))


def _feed(backend: Backend, message: Message) -> None:
    sample, loops = message
    backend.add_odometry(sample)
    for loop in loops:
        backend.add_loop(loop)


@contextmanager
def _played(sizes: Sizes) -> Iterator[Iterator[Message]]:
    """Give the live messages, from another process."""
    context = multiprocessing.get_context('fork')
    here, there = context.Pipe(duplex=False)
    player = context.Process(target=_play, args=(there, sizes))
    player.start()
    there.close()
    try:
        yield iter(here.recv, None)
    except BaseException:
        player.terminate()  # else it would wait for ever to be heard
        raise
    finally:
        player.join()


def _play(there: Connection, sizes: Sizes) -> None:
    # Each time counts from the first keyframe on, so all are made.
    for message in islice(Drive.of(sizes.world().graph).messages, sizes.poses - sizes.live, None):
        there.send(message)
    there.send(None)


def _measure(sizes: Sizes, rate: float) -> None:
    with _played(sizes) as messages, Backend(_OPTIONS) as backend:
        bare, began = _resident(), time.perf_counter()
        backend.restore(load_map(sizes.file)[0])
        print(f'loaded in {time.perf_counter() - began:.1f} s, '
              f'{(_resident() - bare) / sizes.poses:.0f} B a keyframe', flush=True)
        while not backend.snapshot().views:
            backend.update(1.0)
        print(f'its first front after {time.perf_counter() - began:.1f} s, '
              f'{(_resident() - bare) / sizes.poses:.0f} B a keyframe', flush=True)
        Path('/proc/self/clear_refs').write_text('5')
        over = threading.Event()
        asks = threading.Thread(target=_ask, args=(backend, over, sizes.live / rate / 2))
        asks.start()
        _live(backend, messages, rate)
        over.set()
        asks.join()
        print(f'{backend.counts().sizes}')
        most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
        print(f'{(_resident() - bare) / sizes.poses:.0f} B a keyframe, at most '
              f'{(most - bare) / sizes.poses:.0f}')


def _live(backend: Backend, messages: Iterator[Message], rate: float) -> None:
    took = []
    due = began = time.perf_counter()
    process, own = time.process_time(), time.thread_time()
    for message in messages:
        _feed(backend, message)
        cpu, wall = time.thread_time(), time.perf_counter()
        backend.update(0.0)
        took.append((time.thread_time() - cpu, time.perf_counter() - wall))
        due = max(due + 1 / rate, time.perf_counter() - _LAG)
        time.sleep(max(due - time.perf_counter(), 0.0))
    elapsed = time.perf_counter() - began
    behind = time.process_time() - process - (time.thread_time() - own)
    print(f'{len(took) / elapsed:.0f} keyframes a second, other threads at work for '
          f'{behind / elapsed:.0%} of the time')
    for name, seconds in zip(('CPU', 'wall'), np.array(took).T, strict=True):
        print(f'an update, {name} [ms]: median, p95, p99, most ' + ', '.join(
            f'{ms:.2f}' for ms in 1e3 * np.percentile(seconds, (50, 95, 99, 100))), flush=True)


def _ask(backend: Backend, over: threading.Event, until_saved: float) -> None:
    """Ask for all keyframes now and then, and save the map once."""
    took = []
    began = time.monotonic()
    saved = False
    while not over.wait(_DRAWN_EVERY):
        with _timed() as drawn:
            _ = backend.snapshot().drawn
        took.append(drawn)
        if not saved and time.monotonic() > began + until_saved:
            saved = True
            _save(backend)
    wall, cpu = np.array(took).T
    print(f'all keyframes: median {np.median(cpu):.3f} CPU s, {np.median(wall):.3f} s, most '
          f'{wall.max():.3f} s', flush=True)


def _save(backend: Backend) -> None:
    with tempfile.TemporaryDirectory() as folder, backend.calm, _timed() as whole:
        with _timed() as copied:
            saved = backend.saved()
        save_map(Path(folder) / 'map.g2o', saved)
    print(f'saved in {whole[0]:.2f} s, {whole[1]:.2f} CPU s; {copied[1]:.2f} of these to copy it',
          flush=True)


@contextmanager
def _timed() -> Iterator[list[float]]:
    """Give a list for what the block takes: wall and processor time [s] of this thread."""
    found = []
    wall = time.perf_counter()
    cpu = time.thread_time()
    yield found
    found += time.perf_counter() - wall, time.thread_time() - cpu


def _resident() -> int:
    with open('/proc/self/statm') as file:
        return int(file.read().split()[1]) * resource.getpagesize()


if __name__ == '__main__':
    main()
