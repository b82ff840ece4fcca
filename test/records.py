# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""What `l1.read_graph` finds in a file, what it warns of, and what is written of it again."""

import tempfile
import warnings
from functools import cached_property
from pathlib import Path

import numpy as np
from command import run

import l1slam_ros as l1


def beside(path, what):
    """Return the path of a file beside a graph, such as `truth`."""
    return path.with_name(f'{path.name}.{what}.txt')


class Record:
    """
    A file that was read.

    graph, poses : see `l1.read_graph`; skipped : the warnings, those on damage last
    """

    def __init__(self, path, **options):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter('always')
            self.graph, self.poses = l1.read_graph(path, **options)
        self.skipped = tuple(str(one.message) for one in caught)

    def write(self, path, poses=None, **options):
        """Write it; poses : (n, p), those of the file, or if there are none, of the origin."""
        if poses is None:
            poses = self.poses
        if poses is None:
            poses = np.tile(np.eye(self.graph.manifold.POSE_SIZE)[-1],
                            (self.graph.n_poses, 1)) * (self.graph.manifold.POSE_SIZE > 3)
        l1.write_graph(path, self.graph, poses, **options)

    @cached_property
    def _written(self):
        with tempfile.TemporaryDirectory() as name:
            path = Path(name) / 'a.g2o'
            self.write(path)
            ids = [int(line.split()[1]) for line in path.read_text().splitlines()
                   if line.startswith('VERTEX')]
            stamps = beside(path, 'stamps')
            lines = stamps.read_text().splitlines() if stamps.exists() else []
        return np.array(ids, np.int64), [line.split() for line in lines if line[:1] != '#']

    @property
    def ids(self):
        """The vertex ids, (n,)."""
        return self._written[0]

    @property
    def stamps(self):
        """The stamps [ns], (n,); None: there are none."""
        found = self._written[1]
        if not found:
            return None
        assert [int(number) for number, _ in found] == self.ids.tolist()
        return np.array([int(text.replace('.', '')) for _, text in found])


# Every message a keyframe, with the covariance it states: as the note of our bags has it.
EVERY = """\
/**:
  ros__parameters:
    keyframe: {translation: 0.0, rotation: 0.0, period: 0.0}
    odometry: {covariance_source: increment}
"""


class Converted:
    """
    A bag as the graph that `l1slam convert` writes into a folder.

    every : by EVERY, else by the bag's note; code : that the command must end with; None: any
    content : of the graph and of its stamps; vertices, edges : lines of the graph; skipped : what
    is said on standard error

    Raises
    ------
    L1SlamError : there is no graph

    """

    def __init__(self, capsys, folder, path, every=False, code=0):
        graph, options = folder / 'out.g2o', ()
        if every:
            (folder / 'every.yaml').write_text(EVERY)
            options = ('--params-file', folder / 'every.yaml')
        graph.unlink(missing_ok=True)
        _, err = run(capsys, 'convert', path, graph, *options, code=code)
        if not graph.exists():
            raise l1.L1SlamError(err)
        self.path = graph
        self.skipped = tuple(line.removeprefix('l1slam: ') for line in err.splitlines())
        self.content = graph.read_bytes(), beside(graph, 'stamps').read_bytes()
        lines = graph.read_text().splitlines()
        self.vertices = [line for line in lines if line.startswith('VERTEX')]
        self.edges = [line for line in lines if line.startswith('EDGE')]

    @cached_property
    def graph(self):
        """The graph, as long as no other bag is converted into the folder."""
        return read(self.path).graph


def read(path, **options):
    """Return the `Record` of a file."""
    return Record(path, **options)


def error_of(call, *arguments, **options):
    """Return the one line of the error of a call."""
    try:
        call(*arguments, **options)
    except l1.L1SlamError as error:
        assert '\n' not in str(error)
        return str(error)
    raise AssertionError('no error')


def information_of(graph):
    """Return the information matrices of all factors, (m, d, d)."""
    roots = graph.between.sqrt_information
    return roots.transpose(0, 2, 1) @ roots
