# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
What becomes of maps when a rule of the judgement is left out.

    python benchmarks/robust/ablation.py --datasets DIR [--drawn N] [--only FUNCTION...]

A rule is a function that decides something; left out, it says what it says where there is nothing
to decide. The runs, and what is counted of them, are those of `sensitivity.py`.
"""

import argparse
import ast
import inspect
import sys
import textwrap
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

# As a program of its own it finds its neighbours.
sys.path.insert(0, str(Path(__file__).parents[1]))

from measuring import report_progress
from robust.sensitivity import compared, modules_of_judgement, telling_cases

from l1slam_ros.core import robust
from l1slam_ros.core.robust.rounds.growth import gain_of_places

_NONE = np.zeros(0, np.int64)
# Each function, and what stands for it.
RULES: dict[str, Callable[..., Any]] = {
    'gating.rivals': lambda found, posterior, alone, place: np.full(len(place), -np.inf),
    'gating.together': lambda *_: _NONE,
    'places.err_together': lambda *_: False,
    'rounds.growth.Growth._is_noisier': lambda growth, rows: False,
    'rounds.growth.Growth._misfits': lambda growth, rows, residual: _NONE,
    'pairwise_consistency._by_chance': lambda growth, rows: 0.0,
    'pairwise_consistency.longest_run': lambda growth, rows: _NONE,
    'pairwise_consistency.gain_of': gain_of_places,
    'odometry.drift_likelihood.likely_drifts': lambda graph: np.zeros(0),
    'odometry.hypotheses.noisier_run': lambda growth: [],
    'odometry.hypotheses._log_likelihood_loss': lambda growth, noisier: 0.0,
    'odometry.slips.slips': lambda growth, as_stated: [],
    'odometry.slips._Search.pointers': lambda search: [],
    'odometry.slips._Search.by_own_odds': lambda search: iter(()),
    'odometry.cuts.moved_to_likeliest': lambda state, motion: state,
    'odometry.cuts.unusual': lambda state, motion: _NONE,
    'audit._with_uncontested': lambda growth: growth,
    'audit._drop': lambda growth: [],
    'batch.slips': lambda growth: [],
    'batch.agreeing': lambda growth: [],
    'batch._norm_doubts': lambda *_: (),
}


def places_of(rule: str) -> tuple[Any, list[Any], str]:
    """Return a function, the modules or the class that hold it, and its name there."""
    path, _, name = rule.rpartition('.')
    module, _, own = path.rpartition('.')
    if own.lstrip('_')[0].isupper():
        holder = getattr(import_module(f'{robust.__name__}.{module}'), own)
        return vars(holder)[name], [holder], name
    function = getattr(import_module(f'{robust.__name__}.{path}'), name)
    holders = [one for one in modules_of_judgement() if vars(one).get(name) is function]
    return function, holders, name


def lines_of(function: Callable[..., Any]) -> int:
    """Return how many lines of code a function has, without what it says of itself."""
    source = textwrap.dedent(inspect.getsource(function))
    (body,) = ast.parse(source).body
    assert isinstance(body, ast.FunctionDef)
    said = ast.get_docstring(body, clean=False)
    return sum(line.strip()[:1] not in ('', '#')
               for line in source.replace(f'"""{said}"""', '').splitlines())


def main() -> int:
    """Leave out each rule, run, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--datasets', type=Path, required=True)
    parser.add_argument('--drawn', type=int, default=12, help='worlds of each kind')
    parser.add_argument('--only', nargs='+', choices=[*RULES], default=[*RULES])
    given = parser.parse_args()
    cases = telling_cases(given.datasets, given.drawn)
    print(f'{len(cases)} runs\n\n| rule | lines | called in | other | better | worse | silent |\n'
          '|---|---|---|---|---|---|---|')
    for rule in given.only:
        report_progress(rule)
        function, holders, name = places_of(rule)
        telling = [case for case in cases if function.__code__ in case.called]
        try:
            for holder in holders:
                setattr(holder, name, RULES[rule])
            ended = compared(telling)
        finally:
            for holder in holders:
                setattr(holder, name, function)
        print(f'| `{rule}` | {lines_of(function)} | {len(telling)} | {ended} |', flush=True)
    return 0


if __name__ == '__main__':
    sys.exit(main())
