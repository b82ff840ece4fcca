# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Pictures of maps: real files, read back with other libraries."""

from xml.etree import ElementTree

import numpy as np
import pytest
from command import run, texts_of
from PIL import Image
from worlds import between, edge

import l1slam_ros as l1

SQUARE = np.array([(0, 0), (10, 0), (10, 10), (0, 10), (0, 1)], float)


def graph(path, shape=(1, 1), loops=(), odometry=1.0, positions=SQUARE):
    """Write a graph with poses and loops (pairs), whose odometry is longer by a factor."""
    poses = np.insert(positions * shape, 2, 0.0, axis=1)
    lines = [f'VERTEX_SE2 {k} {x!r} {y!r} 0' for k, (x, y, _) in enumerate(poses.tolist())]
    pairs = [*((k, k + 1) for k in range(len(poses) - 1)), *loops]
    lines += [edge(i, j, between(poses[i], poses[j]) * (odometry if j == i + 1 else 1), np.eye(3))
              for i, j in pairs]
    path.write_text('\n'.join(lines) + '\n')
    return path


def pixels(path):
    with Image.open(path) as image:
        return np.asarray(image.convert('RGB')).astype(int)


def reddish(path):
    """How many pixels are rather red: those of refused loops, half transparent on white."""
    r, g, b = np.moveaxis(pixels(path), -1, 0)
    return int(((r > 190) & (g < 120) & (b < 100)).sum())


def extent_of_blue(path):
    """Return the height and the width of the map [pixels], without the line of the legend."""
    blue = np.argwhere((pixels(path) == (0x00, 0x72, 0xB2)).all(axis=-1))
    return np.ptp(blue[blue[:, 0] < 0.85 * len(pixels(path))], axis=0)


def test_refused_loops_are_red_and_false_ones_are_not_and_each_is_named(capsys, tmp_path):
    path, solved = graph(tmp_path / 'a.g2o', loops=[(0, 2), (1, 3)]), tmp_path / 'solved.g2o'
    l1.write_graph(solved, *l1.read_graph(path), inliers=np.arange(6) != 4)
    (tmp_path / 'false.g2o').write_text(path.read_text())
    (tmp_path / 'false.g2o.false.txt').write_text('0 2\n')
    (tmp_path / 'false.g2o.truth.txt').write_text('0 0 0 0\n1 10 0 0\n2 10 10 0\n')
    names = {'a': '5 poses, 2 loops', 'false': '5 poses, 2 loops (1 false)',
             'solved': '5 poses, 2 loops (1 refused)'}
    for name, words in names.items():
        for picture in tmp_path / f'{name}.png', tmp_path / f'{name}.svg':
            run(capsys, 'plot', tmp_path / f'{name}.g2o', '--output', picture)
        said = texts_of(tmp_path / f'{name}.svg')
        assert words in said and ('refused loops' in said) == (name == 'solved')
        assert ('false loops' in said) == ('truth' in said) == (name == 'false')
        assert (reddish(tmp_path / f'{name}.png') > 300) == (name == 'solved')
        assert reddish(tmp_path / f'{name}.png') == 0 or name == 'solved'


def test_axes_are_equal_and_odometry_astray_does_not_shrink_the_map(capsys, tmp_path):
    run(capsys, 'plot', graph(tmp_path / 'a.g2o', (3, 1)), '--output', tmp_path / 'a.png')
    height, width = extent_of_blue(tmp_path / 'a.png')
    assert width / height == pytest.approx(3, rel=0.03)
    run(capsys, 'plot', graph(tmp_path / 'a.g2o', odometry=1000), '--output', tmp_path / 'b.png')
    assert extent_of_blue(tmp_path / 'b.png')[1] > 0.4 * pixels(tmp_path / 'b.png').shape[1]


def test_the_loops_of_a_large_graph_are_thinned_out_and_one_image(capsys, tmp_path, rng):
    walk = np.cumsum(rng.normal(size=(3000, 2)), axis=0)
    loops = np.sort(rng.integers(3000, size=(20_500, 2)), axis=1)
    loops = loops[np.diff(loops, axis=1)[:, 0] > 1]
    path = graph(tmp_path / 'large.g2o', loops=loops.tolist(), positions=walk)
    run(capsys, 'plot', path, '--output', tmp_path / 'map.svg')
    assert f'3,000 poses, {len(loops):,} loops (20,000 drawn)' in texts_of(tmp_path / 'map.svg')
    elements = [element.tag.split('}')[1]
                for element in ElementTree.parse(tmp_path / 'map.svg').iter()]
    assert elements.count('image') == 1 and elements.count('path') < 500


@pytest.mark.parametrize('name, start', [
    ('map.png', b'\x89PNG'), ('MAP.PNG', b'\x89PNG'), ('map.svg', b'<?xml'), ('map.pdf', b'%PDF'),
    ('map.jpg', None), ('map', None), ('map.png.txt', None)])
def test_the_suffix_decides(capsys, name, start, tmp_path):
    path = graph(tmp_path / '$\\frac$.g2o')
    err = run(capsys, 'plot', path, '--output', tmp_path / name, code=2 if start is None else 0)[1]
    if start is None:
        assert err == f'l1slam: {tmp_path / name}: unknown suffix; expected .png, .svg, .pdf\n'
    else:
        assert (tmp_path / name).read_bytes().startswith(start)
    assert len(list(tmp_path.iterdir())) == 1 + (start is not None)
    if name == 'map.svg':  # a name is written as it is
        assert '$\\frac$.g2o' in texts_of(tmp_path / name)
