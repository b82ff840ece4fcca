# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Whatever stands in a graph file: an answer in one line, never a traceback or half a file."""

import contextlib
import io
import tempfile
import warnings
from pathlib import Path

import numpy as np
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.testing import assert_allclose, assert_array_equal
from records import beside, read
from worlds import edge

from l1slam_ros.cli.main import main

VALID = {
    '.g2o': """\
VERTEX_SE2 0 0 0 0
VERTEX_SE2 1 1 0 0.1
VERTEX_SE2 2 2 0.1 0.2
VERTEX_SE2 4 1 1 3
FIX 0
EDGE_SE2 0 1 1 0 0.1 100 0 0 100 0 400
EDGE_SE2 1 2 1 0 0.1 100 1 2 100 3 400
EDGE_SE2 2 4 0.5 0.5 2.5 100 0 0 100 0 400
EDGE_SE2 0 4 1 1 3 10 0 0 10 0 40
EDGE_PRIOR_SE2 0 0 0 0 1 0 0 1 0 1
EDGE_PRIOR_SE2_XY 2 2 0.1 1 0 1
""",
    '.graph': """\
VERTEX2 0 0 0 0
VERTEX2 1 1 0 0.1
VERTEX2 2 2 0.1 0.2
EDGE2 0 1 1 0 0.1 100 0 100 400 0 0
EDGE2 1 2 1 0 0.1 100 1 100 400 2 3
EDGE2 0 2 2 0.1 0.2 10 0 10 40 0 0
""",
}
# What breaks readers: numbers at the ends of their ranges, words, signs, other tags.
TOKENS = st.sampled_from(
    ['', '0', '-0', '1', '-1', '3', '2.5', '1e308', '-1e308', '1e-308', '5e-324', '1e154', '1e40',
     '1e-40', 'nan', 'inf', '-inf', '9223372036854775807', '9223372036854775808', '1e3', '0x10',
     '1_0', '++1', '1,5', 'x', '#', '\x00', '\u0663', '\u2028', '\x1b[31m', 'VERTEX_SE2',
     'EDGE_SE2', 'EDGE2', 'VERTEX2', 'FIX', 'PARAMS_\x07', 'VERTEX_XY', 'EDGE_SE3:QUAT'])
NUMBERS = st.sampled_from(
    ['0', '1', '-1', '2', '3', '0.1', '100', '3.14159265358979', '-3.2', '1e-9', '1e9', '1e-40',
     '1e40', '1e-154', '1e154', '-1e154', '1e-300', '1e300', '1e308', '-1e308', '5e-324'])
COMMANDS = st.sampled_from(
    [('info', ()), ('convert', ('out.g2o',)), ('convert', ('out',)),
     ('convert', ('out.tum',)), ('solve', ('--output', 'out.g2o', '--outer', '2')),
     ('solve', ('--norm', 'l2', '--start', 'odometry', '--output', 'out.tum')),
     ('solve', ('--norm', 'huber', '--start', 'file', '--output', 'out.g2o', '--json')),
     ('corrupt', ('out.g2o', '--false-loops', '1')), ('plot', ('--output', 'out.png'))])
BOUNDED = settings(derandomize=True, deadline=None, database=None,
                   suppress_health_check=[HealthCheck.too_slow])


@st.composite
def mutations(draw):
    """A valid file with other numbers, or with garbage and cut: suffix and bytes."""
    suffix, is_garbage = draw(st.sampled_from(sorted(VALID))), draw(st.booleans())
    lines = [line.split(' ') for line in VALID[suffix].splitlines()]
    for _ in range(draw(st.integers(1, 4))):
        line = lines[draw(st.integers(0, len(lines) - 1))]
        field = draw(st.integers(0, len(line)))
        if is_garbage:
            gone = draw(st.sampled_from([0, 1, len(line)]))
            line[field:field + gone] = draw(st.lists(TOKENS, max_size=1))
        elif len(line) > 3:
            line[-1 - field % (len(line) - 2)] = draw(NUMBERS)
        if draw(st.booleans()):
            lines.insert(0, lines[-1])
    content = '\n'.join(' '.join(line) for line in lines).encode() + b'\n'
    if is_garbage:
        content = content[:draw(st.integers(0, len(content)) | st.just(len(content)))]
    return suffix, content


def answer(suffix, content, command, more):
    """Run one command on a file of these bytes; look at what it says and what it leaves."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        path = folder / f'in{suffix}'
        path.write_bytes(content)
        arguments = [str(folder / word) if word.startswith('out') else word for word in more]
        out, err = io.StringIO(), io.StringIO()
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), \
                warnings.catch_warnings():
            # A warning would be a second line, of no use to who reads it.
            warnings.simplefilter('error')
            code = main([command, str(path), *arguments])
        left = {p.name for p in folder.iterdir()} - {path.name}
        assert path.read_bytes() == content
        for line in err.getvalue().splitlines():
            assert line.startswith('l1slam: ') and line.isprintable()
            assert len(line) < 500 + 2 * len(name)
        if code == 2:
            assert left == set() and out.getvalue() == '' and err.getvalue()
        else:
            assert code == (4 if 'doubtful: ' in err.getvalue() else 0)
            assert all(part.startswith('out') for part in left)
            if 'out.g2o' in left:
                read(folder / 'out.g2o')
        return code


@settings(BOUNDED, max_examples=60)
@given(suffix=st.sampled_from(sorted(VALID)), content=st.binary(max_size=300), command=COMMANDS)
def test_arbitrary_bytes(suffix, content, command):
    assert answer(suffix, content, *command) == 2


@settings(BOUNDED, max_examples=250)
@given(file=mutations(), command=COMMANDS)
@example(file=('.g2o', VALID['.g2o'].encode()), command=('convert', ('out.g2o',)))
@example(file=('.graph', VALID['.graph'].encode()), command=('info', ()))
def test_mutated_files(file, command):
    code = answer(*file, *command)
    assert code == 0 or file[1] != VALID[file[0]].encode() or command[1] == ('out',)


@st.composite
def graphs(draw):
    """Random ids, poses, edges either way, numbers of any size, information, stamps or none."""
    ids = np.array(sorted(draw(st.sets(st.integers(-2**63, 2**63 - 1), min_size=2, max_size=6))))
    n, rng = len(ids), np.random.default_rng(draw(st.integers(0, 2**32)))
    i = np.append(np.arange(n), rng.integers(n, size=4))  # every vertex has an edge
    number = st.floats(-1e30, 1e30) | st.sampled_from([0.0, -0.0, 1 / 3])
    A = rng.normal(size=(len(i), 3, 3))
    information = A @ A.transpose(0, 2, 1) + 0.1 * np.eye(3)
    return (ids, draw(arrays(float, (n, 3), elements=number)),
            np.stack((i, (i + rng.integers(1, n, len(i))) % n), axis=1),
            draw(arrays(float, (len(i), 3), elements=number)),
            information * 10.0 ** rng.integers(-20, 20, (len(i), 1, 1)),
            draw(st.none() | arrays(np.int64, n, elements=st.integers(0, 2**62))))


@settings(BOUNDED, max_examples=30)
@given(made=graphs())
def test_what_is_written_is_read_to_the_last_bit_and_converted(made):
    ids, poses, pairs, measurement, information, stamps = made
    with tempfile.TemporaryDirectory() as name:
        source, path = Path(name) / 'b.g2o', Path(name) / 'a.g2o'
        source.write_text('\n'.join(map(edge, *ids[pairs].T.tolist(), measurement, information)))
        if stamps is not None:
            beside(source, 'stamps').write_text(''.join(
                f'{k} {t // 10**9}.{t % 10**9:09}\n' for k, t in zip(ids, stamps, strict=True)))
        record = read(source)
        record.write(path, poses)
        back = read(path)
        mine, theirs = record.graph.between, back.graph.between
        for x, y, z in ((ids, record.ids, back.ids), (poses, poses, back.poses),
                        (pairs, mine.pairs, theirs.pairs),
                        (measurement, mine.measurement, theirs.measurement)):
            assert x.tobytes() == y.tobytes() == z.tobytes()
        assert_array_equal(stamps, record.stamps)
        assert_array_equal(stamps, back.stamps)
        scale = np.abs(mine.sqrt_information).max(axis=(1, 2), keepdims=True)
        assert_allclose(theirs.sqrt_information / scale, mine.sqrt_information / scale,
                        atol=1e-13)
        answer('.g2o', path.read_bytes(), 'convert', ('out',))
