# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""`l1slam solve`: what it says of maps that may be wrong, and of what it cannot judge."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from command import run, solve_json
from worlds import edge, graph_file, pairs_of, torn, whitened

import l1slam_ros as l1

DOUBT = re.compile(r'doubtful: (\d+) loops refused, between (\d+) and (\d+)'
                   r'( \([0-9.]+ s to [0-9.]+ s\))?, may be right: then the map is another one'
                   r'.*\. Vouch for a true loop, strike out a false one, or state the right noise')


@pytest.fixture(scope='module')
def torn_once(tmp_path_factory):
    path = tmp_path_factory.mktemp('torn') / 'torn.g2o'
    return path, torn(path)


@pytest.fixture
def doubtful(torn_once, tmp_path):
    """Return a graph that may be another map, ids from 100 on; and where the loops say so end."""
    path, ends = torn_once
    return Path(shutil.copy(path, tmp_path)), ends


@pytest.mark.parametrize('norm', ['l1', 'l2'])
def test_a_map_that_loops_agree_is_wrong_is_given_as_doubtful(capsys, doubtful, tmp_path, norm):
    path, ends = doubtful
    output, picture = tmp_path / 'out.g2o', tmp_path / 'map.png'
    out, err = run(capsys, 'solve', path, '--norm', norm, '--json', '--output', output, '--plot',
                   picture, code=4)
    report = json.loads(out)
    said = DOUBT.fullmatch(err.removeprefix('l1slam: ').rstrip('\n'))
    loops, first, last = map(int, said.groups()[:3])
    assert ends[0] <= first < last <= ends[1] and 10 < loops <= len(report['rejected'])
    assert report['status'] == 'doubtful' and report['warnings'] == [said[0]]
    left = report['rejected'] + report['suspect']
    doubt = report['doubts'][0]
    assert doubt['kind'] == 'another map' and doubt['text'] in said[0]
    # All of them stand in the file like this, and all are among what was refused.
    named = {tuple(pair) for pair in doubt['loops']}
    assert len(named) == loops and named <= {tuple(pair) for pair in report['rejected']}
    assert {min(map(min, named)), max(map(max, named))} == {first, last}
    assert pairs_of(output) == [pair for pair in pairs_of(path) if pair not in left]
    kept = [pair not in left for pair in pairs_of(path)]
    residual = whitened(*l1.read_graph(output))[kept]
    cost = np.abs(residual).sum() if norm == 'l1' else (residual**2).sum()
    assert cost == pytest.approx(report['final_cost'], rel=1e-9)
    assert picture.exists()


def test_a_doubt_is_said_even_quietly_with_the_times_of_a_bag_and_beside_its_damage(
        capsys, doubtful, tmp_path):
    bag, cut = tmp_path / 'bag', tmp_path / 'cut.mcap'
    run(capsys, 'convert', doubtful[0], bag)
    cut.write_bytes((bag / 'bag.mcap').read_bytes()[:-20])
    for path, damages in (bag, 0), (cut, 1):
        out, err = run(capsys, 'solve', path, '--quiet', code=4)
        *damage, doubt = err.splitlines()
        said = DOUBT.fullmatch(doubt.removeprefix('l1slam: '))
        first, last = int(said[2]), int(said[3])
        assert out == '' and said[4] == (
            f' ({1000 + first / 10:.9f} s to {1000 + last / 10:.9f} s)')
        assert len(damage) == damages and all('is damaged' in sentence for sentence in damage)


@pytest.mark.parametrize(('poses', 'true', 'lies', 'code'), [
    (150, 101, 150, 0), (150, 101, 1800, 0), (600, 5, 100, 4)])
def test_a_weak_map_is_doubtful_and_one_with_most_loops_refused_is_not(
        capsys, tmp_path, poses, true, lies, code):
    """Of maps that most loops are refused of, those that the others hold were right."""
    world, bad = tmp_path / 'world.g2o', tmp_path / 'bad.g2o'
    run(capsys, 'simulate', world, '--poses', poses, '--edges', poses - 1 + true)
    run(capsys, 'corrupt', world, bad, '--false-loops', lies)
    out, err = run(capsys, 'solve', bad, '--json', code=code)
    report = json.loads(out)
    loops = [pair for pair in report['rejected'] if pair not in report['slips']]
    loops += report['suspect']
    assert len(loops) >= lies and (report['confidence'] >= 0.9) == (code == 0)
    if code == 0:
        assert report['status'] == 'converged' and not report['doubts']
        return
    assert report['doubts'] and err.startswith('l1slam: doubtful: ')
    assert len(err.splitlines()) == 1


GAP = 'no edge between the consecutive vertices 1 and 2, so no chain of odometry'


@pytest.mark.parametrize('start', ['seed', 'file'])
def test_where_the_odometry_is_full_of_gaps_nothing_is_there_to_judge_by(capsys, tmp_path, start):
    vertices = [f'VERTEX_SE2 {k} {k} 0 0' for k in range(4)]
    edges = [f'EDGE_SE2 {ends} 0 0 1 0 0 1 0 1' for ends in ('0 1 1', '2 3 1', '0 2 2.1')]
    path = graph_file(tmp_path, vertices + edges)
    asked = ['solve', path, '--start', start, '--json', '--output', tmp_path / 'out.g2o']
    out, err = run(capsys, *asked, '--robust', code=4)
    report = json.loads(out)
    assert report['parts'] == 2 and report['status'] == 'doubtful'
    assert 'no accepted loop joins 2 parts of the map, between' in err
    assert report['suspect'] == [[0, 2]] and not report['rejected']
    out, err = run(capsys, *asked)
    warning = f'no loop was doubted: {GAP} to judge loops by'
    assert err == f'l1slam: {warning}\n' and json.loads(out)['warnings'] == [warning]
    assert run(capsys, *asked, '--quiet', '--no-robust')[1] == ''


def test_a_graph_too_dense_to_judge_is_solved_as_far_as_it_was_judged(
        capsys, world, machine):
    """With little free memory: the odometry alone can be factored, all loops cannot."""
    machine({'/proc/meminfo': 'MemAvailable: 400 kB'})
    for robust in ((), ('--robust',)):
        report = json.loads(run(capsys, 'solve', world, '--json', *robust, code=4)[0])
        assert report['status'] == 'doubtful' and report['suspect'] and not report['rejected']
        (warning,) = report['warnings']
        assert re.match(
            r'doubtful: judging the loops failed \(factorising [0-9]+ keyframes and [0-9]+ '
            r'factors takes [0-9.e-]+ GB of memory, and [0-9.]+ GB are free\): the map is '
            rf'made of what was accepted until then, and {len(report["suspect"])} loops between '
            r'[0-9]+ and [0-9]+ are left out\. ', warning)
    report = solve_json(capsys, world, '--no-robust')
    assert report['solver'] == 'primal-dual' and report['warnings'] == []


def test_what_a_long_solve_takes_is_said_before_it(capsys, tmp_path):
    path = tmp_path / 'random.g2o'
    pairs = np.random.default_rng(0).integers(3000, size=(9000, 2))
    path.write_text('\n'.join(edge(i, j, (1, 0, 0), np.eye(3)) for i, j in (
        *((k, k + 1) for k in range(2999)), *pairs[pairs[:, 0] != pairs[:, 1]])))
    asked = ('solve', path, '--no-robust', '--start', 'odometry', '--solver', 'interior-point',
             '--outer', 0)
    said = run(capsys, *asked)[1].splitlines()
    assert len(said) == 1 and re.fullmatch(
        r'l1slam: interior-point: predicted to take some [0-9]+ s and [0-9.]+ GB, of which '
        r'[0-9.]+ GB are free', said[0])
    assert run(capsys, *asked, '--quiet')[1] == ''
