# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
A large map that is loaded from a file: how soon it takes what comes, and how soon it answers.

    python benchmarks/loaded.py [KEYFRAMES [EDGES]]

The first keyframes of a simulated world are solved and saved by another process. Here the file is
loaded as `~/load` does it, and the rest of the drive comes at 100 keyframes per second, an update
of ours after each, while the map is saved as `~/save` does it and read, again and again. Seconds
of the clock, so on a machine that has nothing else to do.
"""

import pickle
import resource
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from itertools import islice
from pathlib import Path

import numpy as np
from updates.cells import prefix
from updates.tables import LARGE_MEMORY

from l1slam_ros.core.graph.spanning_tree import odometry_poses
from l1slam_ros.core.online.builder_state import BuilderState
from l1slam_ros.core.online.keyframes import KeyframeOptions, OdometryOptions
from l1slam_ros.core.robust.judgement import Judgement
from l1slam_ros.core.running.backend import Backend, BackendOptions
from l1slam_ros.core.running.optimised import Optimised
from l1slam_ros.core.running.snapshot import SavedMap
from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world
from l1slam_ros.io.compilation import load
from l1slam_ros.io.files import invented_stamps
from l1slam_ros.io.graphs.saved_map import load_map, save_map
from l1slam_ros.paper.updates import Drive

KEYFRAMES, EDGES, REST, RATE = 50_000, 80_000, 1_000, 100.0
# [s] An update may take so long; bars on the first one, and on any answer.
BUDGET, ANSWER = 0.1, 1.0
# [s] From one question to the next.
_PAUSE = 0.5
_OPTIONS = BackendOptions(KeyframeOptions(0.0, 0.0, 0.0), OdometryOptions('increment'))


def main() -> None:
    """Measure, and print."""
    given = [int(word) for word in sys.argv[1:3]]
    keyframes, edges = given + [KEYFRAMES, EDGES][len(given):]
    if sys.argv[3:]:
        _save(keyframes, edges, Path(sys.argv[3]))
        return
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / 'map.g2o'
        # That one has the graph in its memory, this one has not.
        subprocess.run([sys.executable, __file__, str(keyframes), str(edges), str(path)],
                       check=True)
        load()
        Path('/proc/self/clear_refs').write_text('5')
        with Backend(_OPTIONS) as backend:
            _measure(backend, path)
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    _tell('memory', most, LARGE_MEMORY, 'MiB')


def _save(keyframes: int, edges: int, path: Path) -> None:
    """Solve the map of the first keyframes and save it, and beside it what comes then."""
    graph = simulate_world(keyframes, edges, WorldOptions(), np.random.default_rng(0)).graph
    count = keyframes - min(REST, keyframes // 2)
    part, chain = prefix(graph, count), odometry_poses(graph)[:count]
    with Backend(_OPTIONS) as backend:
        backend.restore(SavedMap(BuilderState.of_graph(part, chain, invented_stamps(count)),
                                 Optimised.nothing(chain), Judgement.nothing(), True))
        backend.settle()
        print(save_map(path, backend.saved()), flush=True)
    rest = list(islice(Drive.of(graph).messages, count, None))
    path.with_suffix('.rest').write_bytes(pickle.dumps(rest))


def _measure(backend: Backend, path: Path) -> None:
    read = _seconds(lambda: backend.restore(load_map(path)[0]))
    print(f'{len(backend.poses)} keyframes loaded in {read:.2f} s', flush=True)
    took: list[float] = []
    driven = threading.Thread(target=lambda: _drive(backend, path.with_suffix('.rest'), took))
    driven.start()
    answers: dict[str, list[float]] = {'save': [], 'poses': [], 'loops': []}
    while driven.is_alive():
        with backend.calm:
            answers['save'].append(_seconds(lambda: save_map(path, backend.saved())))
        answers['poses'].append(_seconds(lambda: backend.poses))
        answers['loops'].append(_seconds(backend.loop_states))
        time.sleep(_PAUSE)
    driven.join()
    _tell('first update', took[0], BUDGET, 's')
    for name, seconds in answers.items():
        _tell(f'{name}, longest of {len(seconds)}', max(seconds), ANSWER, 's')
    print(f'updates: median {1e3 * np.median(took):.1f} ms, longest {1e3 * max(took):.1f} ms')


def _drive(backend: Backend, rest: Path, took: list[float]) -> None:
    """Let the rest of the drive come, an update after each keyframe; note the seconds of each."""
    due = time.monotonic()
    for sample, loops in pickle.loads(rest.read_bytes()):
        backend.add_odometry(sample)
        for loop in loops:
            backend.add_loop(loop)
        # The first one finds much to do; no later one is to wait for what goes on behind.
        took.append(_seconds(lambda: backend.update(0.0 if took else BUDGET)))
        due += 1 / RATE
        time.sleep(max(due - time.monotonic(), 0.0))


def _seconds(work: Callable[[], object]) -> float:
    began = time.monotonic()
    work()
    return time.monotonic() - began


def _tell(name: str, value: float, bar: float, unit: str) -> None:
    said = 'met' if round(value, 2) <= bar else 'missed'
    print(f'{name:24}{value:8.2f} {unit}, bar {bar:g}: {said}', flush=True)


if __name__ == '__main__':
    main()
