# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The compiled core: its levels, its arguments, and what it says where it is not there."""

import importlib
import os
import re
import subprocess
import sys
from pathlib import Path

import native_calls
import numpy as np
import pytest
from worlds import made

from l1slam_ros.cli.main import main
from l1slam_ros.core import native

CALLS = 400
LEVEL = 'from l1slam_ros.core import native; print(native.level)'
# Nothing of the core is built.
HIDDEN = 'import sys; sys.modules["l1slam_ros.core.native._portable"] = None; '


def ran(*command, **variables):
    return subprocess.run([sys.executable, *command], capture_output=True, text=True, timeout=300,
                          env={**os.environ, **variables})


def level(name):
    """Return the module of a level of processors."""
    if name == 'avx2' and not importlib.import_module(f'{native.__name__}._portable').has_avx2():
        pytest.skip('this processor has no AVX2')
    return importlib.import_module(f'{native.__name__}._{name}')


@pytest.mark.parametrize('asked', ['portable', 'avx2'])
def test_the_level_is_the_one_that_is_asked_for(asked):
    level(asked)
    assert ran('-c', LEVEL, L1SLAM_ROS_SIMD=asked).stdout == f'{asked}\n'


def test_the_best_level_is_taken_unless_one_is_asked_for():
    has = importlib.import_module(f'{native.__name__}._portable').has_avx2()
    assert ran('-c', LEVEL, L1SLAM_ROS_SIMD='').stdout == ('avx2\n' if has else 'portable\n')


@pytest.mark.parametrize('code, variables, said', [
    (LEVEL, {'L1SLAM_ROS_SIMD': 'sse'},
     "L1SLAM_ROS_SIMD is 'sse'; expected one of avx2, portable"),
    (HIDDEN + LEVEL, {'L1SLAM_ROS_SIMD': ''}, r'the compiled core does not load \(import of .* '
     r'halted.*\); `pip install .` or `colcon build` builds it, with a C\+\+17 compiler and the '
     r'headers of Python \(apt install g\+\+ python3-dev\)')], ids=['no level', 'not built'])
def test_what_cannot_be_loaded_is_one_sentence(code, variables, said):
    done = ran('-c', code, **variables)
    assert done.returncode == 1
    assert re.fullmatch(rf'l1slam_ros\.core\.errors\.\w+: {said}', done.stderr.splitlines()[-1])


@pytest.fixture(params=native_calls.modules())
def module(request):
    """Return the name of each module of the core."""
    return request.param


def test_every_function_says_the_names_of_its_arguments_and_has_types(module):
    typed = (Path(native.__file__).parent / f'{module}.pyi').read_text()
    for name, function in native_calls.functions(module).items():
        assert native_calls.names_of(function) or function.__text_signature__ == '()'
        assert f'def {name}(' in typed


def test_no_argument_ends_the_process(module):
    done = ran(native_calls.__file__, module, str(CALLS))
    last = done.stdout.rpartition('\n')[0].rpartition('\n')[2]
    assert done.returncode == 0, f'{last}\n{done.stderr}'


def test_wrong_arguments_are_named():
    z = np.zeros((2, 3))
    for given, said in [
            ((z, z), 'residual takes 3 arguments, not 2'),
            ((z, z, 1.0), "residual: x_j must be .*array of 2 dimensions, found <class 'float'>"),
            ((z, z[:, ::-1], z), 'residual: x_i must be .* found a strided float64 array of .*')]:
        with pytest.raises(TypeError, match=f'^{said}$'):
            native.se2.residual(*given)


def numbers(*parts):
    """Return all arrays and numbers of arguments and results as arrays, of tuples those inside."""
    for part in parts:
        if isinstance(part, tuple | list):
            yield from numbers(*part)
        elif isinstance(part, np.ndarray | float | int):
            yield np.asarray(part)


class Both:
    """
    In the place of a function of the core: calls that of both levels, and compares.

    seen : where its name is noted
    """

    def __init__(self, one, other, seen):
        self.one, self.other, self.seen = one, other, seen

    def __call__(self, *given):
        again = [part.copy() if isinstance(part, np.ndarray) else part for part in given]
        largest = max((np.max(np.abs(part), where=np.isfinite(part), initial=0)
                       for part in numbers(given) if part.dtype.kind == 'f'), default=0)
        found = self.one(*given)
        # What factorise leaves above the diagonal nobody reads.
        if self.one.__name__ != 'factorise' and all(
                isinstance(part, np.ndarray | float | int) for part in given):
            self.seen.add(self.one.__name__)
            # What all but cancels is as exact as what it is the difference of.
            step = 1e-5 if any(part.dtype == np.float32 for part in numbers(given)) else 1e-10
            for one, other in zip(numbers(found, given), numbers(self.other(*again), again),
                                  strict=True):
                np.testing.assert_allclose(other, one, rtol=10 * step, atol=step * largest,
                                           err_msg=self.one.__name__)
        return found


@pytest.fixture
def both(monkeypatch):
    """Let each call of the core be made at both levels; return the names of what is called."""
    one, other, seen = level('avx2'), level('portable'), set()
    for name in native_calls.modules():
        for called in native_calls.functions(name):
            monkeypatch.setattr(getattr(native, name), called, Both(
                getattr(getattr(one, name), called), getattr(getattr(other, name), called), seen))
    return seen


@pytest.mark.parametrize('arguments', [
    ('--no-robust',), ('--norm', 'l2'), ('--solver', 'primal-dual', '--no-robust'), ()],
    ids=' '.join)
@pytest.mark.parametrize('world', ['streets', 'building'])
def test_both_levels_give_the_same(both, world, arguments, tmp_path):
    graph = made(tmp_path / 'world.g2o', 150, 250, '--world', world, '--false-loops', 5)
    assert main(['solve', str(graph), '--quiet', *arguments]) in (0, 4)
    assert len(both) > 5
