# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Pictures: real files, read back with other libraries."""

import re
from xml.etree import ElementTree

import numpy as np
import pytest
from PIL import Image

from l1slam_ros.core.errors import FileError
from l1slam_ros.io.plot import Curve, Ground, MapDrawing, plot_curves, plot_maps, plot_solution

SQUARE = np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 10.0], [0.0, 10.0], [0.0, 1.0]])


def pixels(path):
    with Image.open(path) as image:
        return np.asarray(image.convert('RGB')).astype(int)


def reddish(path):
    """How many pixels are rather red: those of rejected loops, half transparent on white."""
    r, g, b = np.moveaxis(pixels(path), -1, 0)
    return int(((r > 190) & (g < 120) & (b < 100)).sum())


def words(path):
    """The texts of an SVG: matplotlib draws them as outlines and notes them in comments."""
    return '\n'.join(re.findall(r'<!-- (.*?) -->', path.read_text()))


def test_maps_stand_beside_each_other(tmp_path):
    drawing = MapDrawing('square', SQUARE)
    sizes = []
    for count in (1, 2, 4):
        plot_maps(tmp_path / f'{count}.png', [drawing] * count)
        height, width, _ = pixels(tmp_path / f'{count}.png').shape
        sizes.append((width, height))
    assert sizes[1][0] > 1.5 * sizes[0][0] and sizes[1][1] < 1.2 * sizes[0][1]
    assert sizes[2][0] == pytest.approx(sizes[1][0], rel=0.1)
    assert sizes[2][1] > 1.5 * sizes[1][1]


def test_everything_given_is_drawn_and_named(tmp_path):
    path = tmp_path / 'map.svg'
    plot_maps(path, [MapDrawing('Some street', SQUARE, odometry=SQUARE * 1.1, truth=SQUARE * 0.9,
                                loops=np.array([[0, 4], [1, 3]]), rejected=np.array([[0, 2]]),
                                suspect=np.array([[2, 4]]), note='cost 12.5')])
    ElementTree.parse(path)
    said = words(path)
    for word in ('Some street', 'optimised', 'odometry', 'truth', 'loops', 'refused loops',
                 'suspect loops', 'x [m]', 'y [m]',
                 '5 poses, 4 loops (1 refused, 1 suspect); cost 12.5'):
        assert word in said


@pytest.mark.parametrize('name, title', [
    ('$\\frac$.g2o', '$\\frac$.g2o'), ('a\udce9.g2o', 'a?.g2o')])
def test_a_name_is_written_as_it_is(tmp_path, name, title):
    plot_maps(tmp_path / 'map.svg', [MapDrawing(name, SQUARE)])
    assert title in words(tmp_path / 'map.svg')


def test_refused_loops_are_red(tmp_path):
    for name, rejected in ('none', np.zeros((0, 2), int)), ('one', np.array([[0, 2]])):
        plot_maps(tmp_path / f'{name}.png', [MapDrawing('', SQUARE, rejected=rejected)])
    assert reddish(tmp_path / 'none.png') == 0
    assert reddish(tmp_path / 'one.png') > 300


def test_false_loops_are_not_those_refused_and_named_as_such(tmp_path):
    drawing = MapDrawing('', SQUARE, loops=np.array([[1, 3]]), false=np.array([[0, 2], [0, 3]]),
                         name='stored')
    plot_maps(tmp_path / 'map.png', [drawing])
    assert reddish(tmp_path / 'map.png') == 0
    plot_maps(tmp_path / 'map.svg', [drawing])
    said = words(tmp_path / 'map.svg')
    assert '5 poses, 3 loops (2 false)' in said and 'false loops' in said and 'stored' in said
    assert 'refused' not in said and 'optimised' not in said


def test_the_truth_is_a_path_with_its_gaps(tmp_path):
    """Of any length, and no line across a gap."""
    truth = np.array([[0.0, 0.0], [0.0, 10.0], [np.nan, np.nan], [10.0, 10.0], [10.0, 0.0]])
    orange = []
    for path in truth, truth[[0, 1, 3, 4]]:
        plot_maps(tmp_path / 'map.png', [MapDrawing('', SQUARE / 9, truth=path)])
        r, g, b = np.moveaxis(pixels(tmp_path / 'map.png'), -1, 0)
        orange.append(((r > 200) & (g > 130) & (g < 190) & (b < 90)).sum())
    assert 0 < 1.3 * orange[0] < orange[1]


def test_a_grid_lies_under_the_map_dark_where_something_is_and_grey_where_nothing_is_known(
        tmp_path):
    occupancy = np.zeros((40, 20), np.int8)
    occupancy[:, :10] = -1
    occupancy[:10] = 100
    plot_maps(tmp_path / 'without.png', [MapDrawing('square', SQUARE)])
    plot_maps(tmp_path / 'with.png', [MapDrawing(
        'square', SQUARE, ground=Ground(occupancy, np.array([2.0, 2.0]), 0.2))])
    plain, drawn = (pixels(tmp_path / f'{name}.png') for name in ('without', 'with'))
    assert plain.shape == drawn.shape
    new = (plain == 255).all(axis=2) & (drawn != 255).any(axis=2)
    shades, counts = np.unique(drawn[new][:, 0], return_counts=True)
    most = shades[np.argsort(-counts)[:2]]
    assert most.min() < 110 and 210 < most.max() < 250
    # Ten of forty columns are dark; of the others the lower half is grey.
    assert counts.max() / np.sort(counts)[-2] == pytest.approx(1.5, rel=0.1)


def test_axes_are_equal(tmp_path):
    """The blue square is as wide as it is high."""
    path = tmp_path / 'map.png'
    plot_maps(path, [MapDrawing('', SQUARE * [3, 1])])
    blue = np.argwhere((pixels(path) == (0x00, 0x72, 0xB2)).all(axis=-1))
    blue = blue[blue[:, 0] < 0.85 * len(pixels(path))]  # not the legend's line
    height, width = np.ptp(blue, axis=0)
    assert width / height == pytest.approx(3, rel=0.03)


def places(path):
    """The texts of an SVG and where their lines begin, (x, y) [points], y downwards."""
    found = re.findall(r'<!-- (.*?) -->\s*<g [^>]*?translate\((\S+) (\S+)\)', path.read_text())
    return [(word, float(x), float(y)) for word, x, y in found]


CURVE = Curve('l1 cost', np.arange(2), np.array([2.0, 1.0]))
# How wide and how high the map is.
SHAPES = [(1, 1), (1000, 1), (1, 1000)]


@pytest.mark.parametrize('shape', SHAPES)
@pytest.mark.parametrize('draw', [
    lambda path, drawing: plot_maps(path, [drawing]),
    lambda path, drawing: plot_maps(path, [drawing, MapDrawing('', SQUARE), drawing]),
    lambda path, drawing: plot_solution(path, drawing, CURVE, '')],
    ids=['one', 'three', 'solution'])
def test_whatever_the_shape_the_legend_is_in_order_below_the_axis(tmp_path, shape, draw):
    path = tmp_path / 'map.svg'
    world = SQUARE * shape
    draw(path, MapDrawing('street', world, world, world, loops=np.array([[0, 4]]),
                          rejected=np.array([[0, 2]])))
    found = places(path)
    # Where there are several maps: of the one on the left.
    legend = [min((x, y) for word, x, y in found if word == entry)
              for entry in ('odometry', 'truth', 'loops', 'refused loops', 'optimised')]
    label_x, label = min((x, y) for word, x, y in found if word == 'x [m]')
    assert len({y for _, y in legend}) == 1
    assert legend == sorted(legend), 'the order of every legend is the same'
    below = legend[0][1]
    # A capital is 7 points high here, and the brackets of the label go 3 below their line.
    assert 12 < below - label < 30
    above = max(y for word, x, y in found
                if re.fullmatch('[−0-9.]+', word) and y < label - 1 and x < legend[-1][0])
    assert 10 < label - above < 20
    assert legend[0][0] < label_x < legend[-1][0]
    width, height = map(float, re.search(r'width="(\S+)pt" height="(\S+)pt"',
                                         path.read_text()).groups())
    assert legend[0][0] > 0 and legend[-1][0] + 50 < width and below + 3 < height


@pytest.mark.parametrize('shape', SHAPES)
def test_whatever_the_shape_no_number_lies_over_the_next(tmp_path, shape):
    path = tmp_path / 'map.svg'
    plot_maps(path, [MapDrawing('', SQUARE * shape - 1.5)])
    numbers = [place for place in places(path) if re.fullmatch('[−0-9.]+', place[0])]
    lowest = max(y for _, _, y in numbers)
    row = sorted((x, word) for word, x, y in numbers if y == lowest)
    assert row
    for (x, word), (following, _) in zip(row, row[1:], strict=False):
        # A digit is 6.4 points wide, a point 3.2 and a minus 8.4.
        assert following > x + 6 * len(word.replace('.', ''))


def test_odometry_astray_does_not_shrink_the_map(tmp_path):
    path = tmp_path / 'map.png'
    plot_maps(path, [MapDrawing('', SQUARE, odometry=SQUARE * 1000)])
    blue = np.argwhere((pixels(path) == (0x00, 0x72, 0xB2)).all(axis=-1))
    blue = blue[blue[:, 0] < 0.85 * len(pixels(path))]
    assert np.ptp(blue[:, 1]) > 0.4 * pixels(path).shape[1]


def test_the_loops_of_a_large_graph_are_thinned_out_and_one_image(tmp_path, rng):
    path = tmp_path / 'map.svg'
    walk = np.cumsum(rng.normal(size=(50_000, 2)), axis=0)
    plot_maps(path, [MapDrawing('large', walk, loops=rng.integers(50_000, size=(650_000, 2)))])
    assert '50,000 poses, 650,000 loops (20,000 drawn)' in words(path)
    elements = [element.tag.split('}')[1] for element in ElementTree.parse(path).iter()]
    assert elements.count('image') == 1
    assert elements.count('path') < 500


def test_positions_in_space_are_seen_from_above_and_from_the_side(tmp_path):
    flat, tall = tmp_path / 'flat.png', tmp_path / 'tall.png'
    heights = np.array([[0.0], [5.0], [9.0], [-3.0], [1.0]])
    aside, loops = np.hstack((SQUARE[:, :1], heights)), np.array([[0, 2]])
    plot_maps(flat, [MapDrawing('', SQUARE, loops=loops),
                     MapDrawing(', from the side', aside, loops=loops, upwards='z')])
    plot_maps(tall, [MapDrawing('', np.hstack((SQUARE, heights)), loops=loops)])
    np.testing.assert_array_equal(pixels(flat), pixels(tall))


def test_one_pose_is_a_map(tmp_path):
    plot_maps(tmp_path / 'map.png', [MapDrawing('', np.zeros((1, 2)), np.zeros((1, 2)))])
    assert pixels(tmp_path / 'map.png').min() < 100


def test_curves_are_drawn_on_a_logarithmic_scale(tmp_path):
    path = tmp_path / 'curves.svg'
    k = np.arange(50)
    plot_curves(path, [Curve('angles', k, 1e6 * np.exp(-k)), Curve('global', k, 10.0 + k)],
                'Cost of things')
    for word in ('Cost of things', 'angles', 'global', 'iteration', 'cost', 'mathdefault{10^{'):
        assert word in words(path)


def curve_of(costs):
    return Curve('l1 cost', np.arange(len(costs), dtype=float), np.array(costs))


def test_a_solution_is_a_map_and_the_way_there(tmp_path):
    plot_maps(tmp_path / 'alone.png', [MapDrawing('square', SQUARE)])
    curve, note = curve_of([1158.0, 972.0]), 'initial 5940, final 972'
    plot_solution(tmp_path / 'both.png', MapDrawing('square', SQUARE), curve, note)
    alone, both = (pixels(tmp_path / f'{name}.png').shape for name in ('alone', 'both'))
    assert both[1] > 1.6 * alone[1] and both[0] < 1.2 * alone[0]
    plot_solution(tmp_path / 'both.svg', MapDrawing('square', SQUARE), curve, note)
    for word in 'square', 'l1 cost', 'iteration', note, '1000':
        assert word in words(tmp_path / 'both.svg')


@pytest.mark.parametrize('costs', [[0.0], [0.0, 0.0], [5940.0], [971.78, 971.7, 971.69],
                                   [2.7e6, 3772.0], [5.0, 0.0], np.linspace(9e3, 1e3, 1000)])
@pytest.mark.filterwarnings('error')
def test_any_costs_are_drawn_without_a_warning(tmp_path, costs):
    plot_solution(tmp_path / 'a.png', MapDrawing('', SQUARE * [30, 1]), curve_of(costs), '')
    assert pixels(tmp_path / 'a.png').min() < 100


@pytest.mark.parametrize('name, start', [
    ('map.png', b'\x89PNG'), ('MAP.PNG', b'\x89PNG'), ('map.svg', b'<?xml'), ('map.pdf', b'%PDF')])
def test_the_suffix_decides(name, start, tmp_path):
    plot_maps(tmp_path / name, [MapDrawing('', SQUARE)])
    assert (tmp_path / name).read_bytes().startswith(start)
    assert [path.name for path in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize('name', ['map.jpg', 'map', 'map.png.txt'])
def test_another_suffix_is_refused(name, tmp_path):
    expected = f'{tmp_path / name}: unknown suffix; expected .png, .svg, .pdf'
    for draw in (lambda path: plot_maps(path, [MapDrawing('', SQUARE)]),
                 lambda path: plot_curves(path, [Curve('', np.arange(2), np.ones(2))])):
        with pytest.raises(FileError) as caught:
            draw(tmp_path / name)
        assert str(caught.value) == expected
    assert not list(tmp_path.iterdir())


def test_what_cannot_be_written_is_said_and_leaves_nothing(tmp_path):
    (tmp_path / 'taken.png').mkdir()
    missing = tmp_path / 'missing' / 'map.png'
    for path in missing, tmp_path / 'taken.png':
        with pytest.raises(FileError, match=f'^{path}: cannot be written: '):
            plot_maps(path, [MapDrawing('', SQUARE)])
    assert [path.name for path in tmp_path.iterdir()] == ['taken.png']
