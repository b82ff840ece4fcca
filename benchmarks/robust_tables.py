# SPDX-License-Identifier: Apache-2.0
"""The runs of the false-loop suite as Markdown: a table for each graph and kind."""

import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from robust_kinds import CLEAN, KINDS, ONLINE
from robust_runs import EVERY, HOLDS, KEPT_PROBABILITY, MORE, MOST_KEPT, MOST_LOST, TIMES, Run

Lines = list[str]
NOTHING = '–'
_GRAPHS = ('intel', 'manhattan3500', 'city10000')
_NUMBERS = ('false', 'solver', 'runs', 'hold', 'told apart', 'error [m]', 'to truth [m]',
            'precision', 'recall', 'false kept', 'true lost', 'seconds')
_ONLINE = ('false', 'solver', 'runs', 'hold', 'told apart', 'mean error [m]', 'clean [m]',
           'largest [m]', 'false kept', 'true lost', 'seconds')


def document(recorded: Mapping[str, Any], runs: Sequence[Run]) -> Lines:
    """Return the whole report."""
    lines = ['# False loops', '', *_introduction(recorded)]
    for graph in _in_order(_GRAPHS, (run.graph for run in runs)):
        mine = [run for run in runs if run.graph == graph]
        lines += [f'## {graph}', '', 'Runs that hold, of those that were made:', '',
                  *_summary(mine)]
        for kind in _in_order(KINDS, (run.kind for run in mine)):
            part = [run for run in mine if run.kind == kind]
            online = kind.startswith(ONLINE)
            header, cells = (_ONLINE, _online_cells) if online else (_NUMBERS, _batch_cells)
            lines += [f'### {graph}, {kind}', '', *_table(header, _body(part, cells))]
    return lines


def _introduction(recorded: Mapping[str, Any]) -> Lines:
    machine = recorded['machine']
    versions = ', '.join(f'{name} {recorded["versions"][name]}'
                         for name in ('python', 'numpy', 'gtsam'))
    limits = ', '.join(f'{name} {limit:g} m' for name, limit in HOLDS.items())
    return [
        'Made by `python benchmarks/false_loops.py --datasets DIR`; medians over the seeds, '
        'seconds of the processor, one core and one thread. '
        f'{machine["cpu"]}, {machine["used"]} of {machine["cores"]} cores; {versions}.', '',
        '- **false**: part of all loops that is false; of n true ones, n p / (1 - p) are added. '
        'Kinds: `random` (says two far poses are near), `identity` (says they are the same), '
        '`grouped` (10 to 20 that agree with each other); `tenth-`: only a random tenth of the '
        'true loops is there; `slip-`: one odometry factor is off by 5 m or 90 degrees; '
        '`heading`: 1 degree more noise in each odometry factor; `odometry-`: drawn anew with 3 '
        'or 10 times the noise that it states (**undecidable**: part of the true loops that would '
        'look like chance to one who knew all others and the noise); `online-`: pose by pose.',
        '- **error**: position, RMSE after alignment, to the map that the same solver makes of '
        'the clean graph (from its L2 map: the optimum, not where a bad start leads). A map '
        f'**holds** when that is at most: {limits}. (Where no loop is believed at all, both are '
        'the odometry, and that says nothing: see **told apart**.)',
        '- **told apart**: runs that keep no more than '
        f'{MOST_KEPT:.1%} of the false loops and lose no more than {MOST_LOST:.0%} of the true '
        'ones. **Precision**: part of what is believed that is true; **recall**: part of the true '
        'that is believed. gtsam does not say which loops it believes: those whose residual at '
        f'its map is within the {KEPT_PROBABILITY:.1%} quantile of chi2.',
        f'- **{NOTHING}**: the time was up; then the solver did not get the other seeds, and the '
        'run counts as one that does not hold.',
        '- gtsam: Levenberg-Marquardt, kernels on loops only, GNC told that the odometry is sure. '
        'The last word is the start: the odometry chain, our seed (L1, Algorithm 3, '
        'of all loops), or the poses stored in the file, which are much better than what a robot '
        'has. Neither start nor graph is counted in the seconds, but both in the limit.',
        f'- **Online**: every {EVERY} poses the map is compared with the truth (Intel: with the '
        f'L2 map); it holds when no error is above {TIMES:g} times that of the clean run at the '
        f'same pose plus {MORE:g} m. `clean` is the mean error of the clean run.', '']


def _summary(runs: Sequence[Run]) -> Lines:
    """Return the runs of one graph that hold: solvers down, groups of kinds across."""
    groups = [name for name, belongs in _GROUPS.items() if any(belongs(run.kind) for run in runs)]
    body = []
    for solver in _solvers(runs):
        mine = [run for run in runs if run.solver == solver]
        body.append([solver, *(_share([run for run in mine if _GROUPS[name](run.kind)])
                               for name in groups)])
    return _table(['solver', *groups], body)


_GROUPS: dict[str, Callable[[str], bool]] = {
    'clean': lambda kind: kind == CLEAN, 'random': lambda kind: kind == 'random',
    'identity': lambda kind: kind == 'identity', 'grouped': lambda kind: kind == 'grouped',
    'tenth': lambda kind: kind.startswith('tenth'),
    'slip': lambda kind: kind.startswith('slip'), 'heading': lambda kind: kind == 'heading',
    'odometry': lambda kind: kind.startswith('odometry'),
    'online': lambda kind: kind.startswith(ONLINE),
}


def _body(runs: Sequence[Run], cells: Callable[[list[Run]], Lines]) -> Iterable[Lines]:
    for share in sorted({run.share for run in runs}):
        part = [run for run in runs if run.share == share]
        for solver in _solvers(part):
            mine = [run for run in part if run.solver == solver]
            yield [f'{share:.0%}', solver, str(len(mine)), _held(mine, 'holds'),
                   _held(mine, 'told'), *cells([run for run in mine if run.seconds is not None])]


def _batch_cells(ended: list[Run]) -> Lines:
    if not ended:
        return [NOTHING] * 7
    kept, lost = _ratio(ended, 'kept', 'false'), _ratio(ended, 'lost', 'true')
    return [_median(run.error for run in ended), _median(run.truth for run in ended),
            _percent(statistics.median(_precision(run) for run in ended)),
            _percent(1 - statistics.median(run.lost / max(run.true, 1) for run in ended)),
            kept, lost, _median(run.seconds for run in ended) + _named(ended)]


def _online_cells(ended: list[Run]) -> Lines:
    if not ended:
        return [NOTHING] * 6
    return [_median(run.error for run in ended), _median(run.numbers['clean'] for run in ended),
            _median(run.numbers['largest'] for run in ended), _ratio(ended, 'kept', 'false'),
            _ratio(ended, 'lost', 'true'), _median(run.seconds for run in ended)]


def _precision(run: Run) -> float:
    believed = run.kept + run.true - run.lost
    return (run.true - run.lost) / believed if believed else 0.0


def _named(ended: list[Run]) -> str:
    """Return what only runs of solvers have that judge the factors."""
    said = {name: [run.numbers[name] for run in ended if name in run.numbers]
            for name in ('named', 'refused', 'clean_lost', 'undecidable')}
    words = [f'; slip named {sum(said["named"])}/{len(said["named"])}' if said['named'] else '',
             f'; refused {sum(said["refused"])}' if any(said['refused']) else '',
             f'; clean lost {max(said["clean_lost"])}' if any(said['clean_lost']) else '',
             f'; undecidable {_percent(statistics.median(said["undecidable"]))}'
             if said['undecidable'] else '']
    return ''.join(words)


def _held(runs: list[Run], field: str) -> str:
    return f'{sum(getattr(run, field) for run in runs)}/{len(runs)}'


def _share(runs: list[Run]) -> str:
    return _held(runs, 'holds') if runs else NOTHING


def _ratio(runs: list[Run], part: str, whole: str) -> str:
    """Return the mean count of a part, of how many."""
    counts = [statistics.mean(getattr(run, field) for run in runs) for field in (part, whole)]
    return '/'.join(f'{count:g}' for count in counts)


def _percent(value: float) -> str:
    return f'{value:.1%}'


def _median(values: Iterable[float | None]) -> str:
    known = [value for value in values if value is not None]
    if not known:
        return NOTHING
    value = statistics.median(known)
    return f'{value:.4f}' if value < 1 else f'{value:.3g}'


def _solvers(runs: Iterable[Run]) -> list[str]:
    """Return the solvers, ours first."""
    names = {run.solver for run in runs}
    return sorted(names, key=lambda name: (not name.startswith('ours'), name))


def _in_order(order: Sequence[str], names: Iterable[str]) -> list[str]:
    there = set(names)
    return [*(name for name in order if name in there), *sorted(there - set(order))]


def _table(header: Sequence[str], body: Iterable[Sequence[str]]) -> Lines:
    rows = [header, ['---'] * len(header), *body]
    return ['| ' + ' | '.join(cells) + ' |' for cells in rows] + ['']
