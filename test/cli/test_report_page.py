# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""`l1slam solve --report`: what the page shows, in a browser, and that it settles a doubt."""

import io
import json
import sys
from contextlib import redirect_stdout
from functools import cache

import numpy as np
import pytest
from browser import opened, opened_together
from command import run
from worlds import between, compose, edge, edited, made, torn

from l1slam_ros.cli.main import main

pytest.importorskip('plotly')
# What a person reads and does.
HEAD = 'const words = id => document.getElementById(id).textContent.trim();'
PRESS = """const press = text => [...document.querySelectorAll('button')].find(
  one => one.textContent === text).click();"""
LINES = "[document.getElementById('trusted').value, document.getElementById('struck').value]"


def ring(path, loops=7, n=600):
    """Write a drive round a ring whose loops are all of one place, 1.2 m long: no run."""
    angle = 2 * np.pi * np.arange(n + loops) / n
    truth = np.column_stack((20 * np.cos(angle), 20 * np.sin(angle), angle))
    i = np.concatenate((np.arange(n + loops - 1), np.arange(loops) + n))
    j = np.concatenate((np.arange(1, n + loops), np.arange(loops)))
    noise = np.random.default_rng(2).standard_normal((len(i), 3)) * [0.05, 0.05, 0.005]
    path.write_text('\n'.join(
        edge(7 + a, 7 + b, measurement, np.diag([400.0, 400.0, 4e4])) for a, b, measurement in zip(
            i, j, compose(between(truth[i], truth[j]), noise), strict=True)) + '\n')
    return path


def slipping(path, i, metres):
    """Let the odometry slip ahead from one vertex to the next."""
    def slip(words, _):
        if words[1:3] == [str(i), str(i + 1)]:
            words[3] = str(float(words[3]) + metres)
    return edited(path, slip)


def weak(path, edges, seed):
    """Simulate a world of 600 keyframes that a hundred lies leave a weak map."""
    return made(path, 600, edges, '--false-loops', 100, '--seed', seed)


# A name of each: what makes it.
DOUBTFUL = {
    'a ring': ring, 'a slip': lambda path: slipping(made(path, 400, 430, '--seed', 4), 200, 0.4),
    'a weak map': lambda path: weak(path, 601, 0), 'torn': lambda path: (torn(path), path)[1]}


def shown(page):
    """Return what a page was given to show."""
    text = page.read_text(encoding='utf-8')
    return json.loads(text.split('type="application/json">')[1].split('</script>')[0])


def reported(capsys, path, *more, code=4):
    page = path.with_name('map.html')
    report = json.loads(run(capsys, 'solve', path, '--report', page, '--json', '--quiet', *more,
                            code=code)[0])
    return page, report


@pytest.fixture(scope='module')
def solve(tmp_path_factory):
    """Return what solves a doubtful world of a name once; its graph, its page and its report."""
    @cache
    def solved(name):
        path = DOUBTFUL[name](tmp_path_factory.mktemp('doubtful') / 'graph.g2o')
        with redirect_stdout(io.StringIO()) as said:
            assert main(['solve', str(path), '--report', str(path.with_name('map.html')), '--json',
                         '--quiet']) == 4
        return path, path.with_name('map.html'), json.loads(said.getvalue())
    return solved


def test_a_page_shows_each_loop_once_with_its_fate_and_the_doubted(solve):
    _, page, report = solve('torn')
    data = shown(page)
    ids = np.array(data['ids'], int)
    pairs = np.column_stack((ids[data['i']], ids[data['j']])).tolist()
    words, here = [fate['word'] for fate in data['fates']], data['maps'][0]
    assert len(pairs) == data['loops'] == report['loops'] == len(here['fate'])
    assert [pair for pair, fate in zip(pairs, here['fate'], strict=True)
            if words[fate] == 'rejected'] == report['rejected']
    doubt = data['doubts'][0]
    assert doubt['text'] == report['doubts'][0]['text']
    assert [pairs[k] for k in doubt['loops']] == report['doubts'][0]['loops']
    assert all(sigmas is not None for sigmas in here['sigmas'])
    # In the rival the doubted loops are in the map, and the map is another.
    rival = data['maps'][1]
    assert {words[rival['fate'][k]] for k in doubt['loops']} == {'trusted'}
    assert rival['doubt'] == 0 and 'm from the map that was solved' in rival['note']
    assert np.abs(np.array(rival['at']) - here['at']).max() > 1


def test_a_doubt_is_settled_through_the_page(capsys, solve):
    """Each kind, either way; what is doubted after that is of other loops."""
    paths, pages, reports = zip(*map(solve, DOUBTFUL), strict=True)
    together = opened_together(pages, f"""{HEAD} {PRESS}
        const all = [];
        for (const [button, name] of [['true', 'trusted'], ['false', 'struck']]) {{
          press('Tick all as ' + button);
          all.push([{LINES}, words(name + '-name')]);
          press('Untick');
        }}
        return [...all, {LINES}];""")
    for kind, path, report, (found, complaints) in zip(
            DOUBTFUL, paths, reports, together, strict=True):
        *ways, none = found
        loops = report['doubts'][0]['loops']
        assert complaints == [] and none == ['', ''], kind
        for place, (lines, name) in enumerate(ways):
            assert lines[1 - place] == '', kind
            assert [list(map(int, line.split())) for line in lines[place].splitlines()] == loops
            beside = path.with_name(name)
            beside.write_text(lines[place])
            after = json.loads(run(capsys, 'solve', path, '--json', code=None)[0])
            beside.unlink()
            assert after['status'] == ('doubtful' if after['doubts'] else 'converged')
            for doubt in after['doubts']:
                assert doubt['kind'] == 'another norm' or not any(
                    loop in loops for loop in doubt['loops']), (kind, doubt)


def test_what_was_said_is_ticked_in_the_next_page(capsys, tmp_path, solve):
    path = ring(tmp_path / 'graph.g2o')
    (lines, names, verdict), complaints = opened(solve('a ring')[1], f"""{HEAD} {PRESS}
        press('Tick all as true'); document.querySelector('[data-word="false"]').click();
        return [{LINES}, [words('trusted-name'), words('struck-name')], words('status')];""")
    assert complaints == [] and verdict == 'doubtful'
    assert [text.count('\n') for text in lines] == [6, 1]
    for name, text in zip(names, lines, strict=True):
        (tmp_path / name).write_text(text)
    page, _ = reported(capsys, path, code=0)
    (again, verdict), complaints = opened(page, f"""{HEAD}
        return [{LINES}, words('status')];""")
    assert complaints == [] and again == lines and verdict == 'not doubted'


def test_ticks_make_lines_one_by_one_and_are_taken_back(capsys, tmp_path):
    path = ring(tmp_path / 'ring.g2o')
    text = path.read_text().splitlines()
    # Once more, with another measurement, and the other way round: a line of the files is of both.
    edge = next(line for line in text if line.startswith('EDGE_SE2 607 7 ')).split()
    path.write_text('\n'.join([*text, ' '.join([edge[0], '7', '607', '0', '-.2', '0',
                                                *edge[6:]])]) + '\n')
    page, _ = reported(capsys, path)
    found, complaints = opened(page, f"""
        const box = (i, j, word) => [...document.querySelectorAll('#rows tr')].find(row =>
          row.cells[0].textContent === i && row.cells[1].textContent === j
        ).querySelector(`[data-word="${{word}}"]`);
        const steps = [{LINES}];
        for (const [i, j, word] of [['607', '7', 'true'], ['608', '8', 'false'],
                                    ['607', '7', 'false'], ['608', '8', 'false']]) {{
          box(i, j, word).click();
          steps.push({LINES});
        }}
        return [steps, box('7', '607', 'false').checked, box('7', '607', 'true').checked];""")
    assert complaints == []
    assert found == [[['', ''], ['607 7\n', ''], ['607 7\n', '608 8\n'],
                      ['', '607 7\n608 8\n'], ['', '607 7\n']], True, False]


def test_the_table_is_cut_searched_and_sorted_and_the_map_switched(solve):
    _, page, report = solve('torn')
    i, j = report['doubts'][0]['loops'][0]
    found, complaints = opened(page, f"""
        const rows = () => [...document.querySelectorAll('#rows tr')];
        const ends = () => rows().map(row => row.cells[0].textContent + ' '
          + row.cells[1].textContent);
        const map = document.getElementById('map');
        const keyframes = () => map.data.find(one => one.name === 'keyframes');
        const first = rows().length, all = rows().every(one => one.classList.contains('doubted'));
        const box = document.getElementById('search'), before = keyframes().x.slice();
        map.emit('plotly_click', {{points: [{{data: keyframes(), pointNumber: {i - 100}}}]}});
        const at = [box.value, ends()];
        box.value = '{i} {j}'; box.dispatchEvent(new Event('input')); await wait(400);
        const one = ends();
        box.value = ''; box.dispatchEvent(new Event('input')); await wait(400);
        const which = document.getElementById('which');
        which.value = '1'; which.dispatchEvent(new Event('change')); await wait(500);
        const fate = document.getElementById('fate');
        fate.value = '4'; fate.dispatchEvent(new Event('change'));
        const moved = keyframes().x.slice();
        rows()[0].click(); await wait(300);
        return [at, first, all, one, rows().length, document.getElementById('found').textContent,
          Math.max(...before.map((x, k) => Math.abs(x - moved[k]))) > 1,
          map.data.some(one => one.name.startsWith('chosen')),
          document.getElementById('note').textContent];""")
    (searched, at), *found = found
    assert complaints == [] and searched == str(i)
    assert f'{i} {j}' in at and all(str(i) in ends.split() for ends in at)
    assert found == [50, True, [f'{i} {j}'], 50, f'{len(report["doubts"][0]["loops"])} listed',
                     True, True, shown(page)['maps'][1]['note']]


def test_a_world_in_space_is_drawn_in_space(capsys, tmp_path):
    path = tmp_path / 'building.g2o'
    run(capsys, 'simulate', path, '--world', 'building', '--poses', 150, '--edges', 330)
    page, _ = reported(capsys, path, code=0)
    found, complaints = opened(page, """
        return [...new Set(document.getElementById('map').data.map(one => one.type))];""")
    assert complaints == [] and found == ['scatter3d']
    assert len(shown(page)['maps'][0]['at']) == 3


def test_a_slip_and_a_weak_map_have_rivals(solve):
    _, page, report = solve('a weak map')
    rival, = shown(page)['maps'][1:]
    assert rival['name'] == 'rival: every loop believed'
    assert rival['note'].startswith(f'{report["loops"]} loops used')
    _, page, report = solve('a slip')
    doubt, = report['doubts']
    assert doubt['kind'] == 'a slip suspected'
    *_, rival = shown(page)['maps'][1:]
    step = doubt['text'].split(' between ')[1].split(':')[0].split(' and ')
    assert rival['name'].split(' the step ')[1] == ' - '.join(step)


def test_a_named_slip_is_in_the_rival_and_is_not_ticked(capsys, tmp_path):
    """Only a loop can be vouched for or struck out: the reader of the files says so."""
    path = slipping(weak(tmp_path / 'world.g2o', 606, 1), 300, 6)
    page, report = reported(capsys, path)
    assert report['slips'] == [[300, 301]]
    name = shown(page)['maps'][1]['name'].removeprefix('rival: ')
    found, complaints = opened(page, f"""{HEAD} {PRESS}
        const box = document.getElementById('search'), row = () => [...document.querySelectorAll(
          '#rows tr')].find(one => one.cells[1].textContent === '301').cells[2].textContent;
        document.getElementById('all-true').click();
        const ticked = document.getElementById('trusted').value.includes('300 301');
        box.value = '300 301'; box.dispatchEvent(new Event('input')); await wait(400);
        const inputs = document.querySelectorAll('#rows input').length, before = row();
        press('See the rival: ' + {json.dumps(name)}); await wait(400);
        return [ticked, inputs, before, words('note')];""")
    assert complaints == []
    assert found == [False, 0, 'slip', shown(page)['maps'][1]['note']]


def test_keyframes_of_a_bag_have_stamps_and_the_page_says_to_make_a_graph_first(
        capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run(capsys, 'convert', ring(tmp_path / 'ring.g2o'), 'bag')
    page, report = reported(capsys, tmp_path / 'bag')
    found, complaints = opened(page, """
        const rows = () => [...document.querySelectorAll('#rows tr')].map(
          row => [row.cells[0].innerText, row.cells[1].innerText]);
        const all = rows().length, box = document.getElementById('search');
        box.value = '1060.3'; box.dispatchEvent(new Event('input')); await wait(400);
        return [all, rows(), document.getElementById('map').data.find(
          one => one.name === 'keyframes').text[603]];""")
    assert complaints == []
    assert found == [7, [['603\n1060.300000000 s', '3\n1000.300000000 s']],
                     '603, 1060.300000000 s']
    steps = shown(page)['files']
    assert steps['first'] == 'l1slam convert bag bag.g2o'
    run(capsys, *steps['first'].split()[1:])
    i, j = report['doubts'][0]['loops'][0]
    page.with_name(steps['trusted']).write_text(f'{i} {j}\n')
    run(capsys, *steps['command'].split()[1:])


def test_a_page_of_what_nobody_judged(capsys, tmp_path):
    torn(tmp_path / 'torn.g2o')
    page, _ = reported(capsys, tmp_path / 'torn.g2o', '--no-robust', code=0)
    data = shown(page)
    assert data['verdict'] == 'All of 165 loops were believed; none was judged.'
    assert set(data['maps'][0]['fate']) == {0} and set(data['maps'][0]['sigmas']) == {None}


def test_a_doubt_that_no_loop_settles_least_squares_does(capsys, datasets, tmp_path):
    recorded = datasets / 'real' / 'bovisa06.g2o'
    if not recorded.exists():
        pytest.skip('the recorded graphs are not on this machine')
    (tmp_path / 'bovisa06.g2o').write_bytes(recorded.read_bytes())
    page, report = reported(capsys, tmp_path / 'bovisa06.g2o')
    assert [doubt['kind'] for doubt in report['doubts']] == ['another norm']
    assert not shown(page)['doubts'][0]['settled']
    assert shown(page)['maps'][1]['name'] == 'rival: least squares'
    assert shown(page)['files']['settled'] == 'l1slam solve bovisa06.g2o --norm l2'


def test_a_page_is_no_other_file(capsys, tmp_path):
    path = ring(tmp_path / 'ring.g2o')
    for name in 'map.png', 'map':
        err = run(capsys, 'solve', path, '--report', tmp_path / name, code=2)[1]
        assert 'is not the name of a web page; expected one that ends in .html or .htm' in err
    (tmp_path / 'folder.html').mkdir()
    for where in tmp_path / 'none' / 'map.html', tmp_path / 'folder.html':
        err = run(capsys, 'solve', path, '--report', where, '--output', tmp_path / 'map.g2o',
                  '--force', code=2)[1]
        assert f'{where}: cannot be written' in err and err.count('\n') == 1
        assert not (tmp_path / 'map.g2o').exists()


def test_without_the_library_one_line_says_so_before_the_work(capsys, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, 'plotly', None)
    out, err = run(capsys, 'solve', tmp_path / 'absent.g2o', '--report', tmp_path / 'map.html',
                   code=2)
    assert out == '' and err.count('\n') == 1
    assert '--report draws with plotly, which is not installed' in err
    assert not list(tmp_path.iterdir())


def test_a_name_ends_no_script_and_its_command_runs(capsys, tmp_path):
    names, pages = ['<\u2044script><b>.g2o', "a'b c.g2o"], []
    for folder, name in enumerate(names):
        (tmp_path / str(folder)).mkdir()
        page, _ = reported(capsys, ring(tmp_path / str(folder) / name))
        assert shown(page)['files']['command'].startswith("l1slam solve '")
        pages.append(page)
    assert opened_together(pages, "return document.getElementById('name').textContent;") == [
        (name, []) for name in names]
