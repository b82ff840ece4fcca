# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Saving and loading the map of a back end: a g2o graph, with the rest of the state in its remarks.

The new file takes its place by one rename. The previous one stays beside it, as `<path>.1`.
"""

import glob
import os
import shutil
from collections.abc import Iterable, Iterator
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from l1slam_ros.core.errors import FileError
from l1slam_ros.core.online.builder_state import BuilderState
from l1slam_ros.core.robust.judgement import Doubt, Judgement
from l1slam_ros.core.running.optimised import Optimised
from l1slam_ros.core.running.snapshot import SavedMap
from l1slam_ros.io.bounded import open_regular
from l1slam_ros.io.files import LARGEST, other_kind, put_lines, replacing
from l1slam_ros.io.graphs.graph_file import GraphRecord, graph_lines, read_graph_file
from l1slam_ros.io.graphs.left_out import SUSPECT, left_out_by
from l1slam_ros.io.graphs.saved_builder import (
    FINITE,
    Limits,
    limits_of,
    restored,
    values_of,
)
from l1slam_ros.io.remarks import is_proven, with_remarks, wrong_contents

_Record = TypeVar('_Record', Optimised, Judgement)
_POSITIVE = 1e-30, LARGEST


def save_map(path: Path, saved: SavedMap | None, keep: bool = True) -> str:
    """
    Write a map and return a sentence that says so.

    keep : the file that is replaced becomes the previous map

    Raises
    ------
    FileError : there is none, or the file cannot be written; it is then as it was.

    """
    if saved is None:
        raise FileError(path, 'there is no graph yet to be saved')
    record = GraphRecord(saved.builder.graph, saved.optimised.poses, np.arange(_count(saved)),
                         left_out=_left_out(saved), drift=saved.judgement.drift)
    with replacing(path) as temporary:
        put_lines(temporary, with_remarks(graph_lines(path, record), _remarks(saved)))
        if keep:
            _keep(path)
    _remove_leftovers(path)
    return f'{_count(saved)} keyframes saved to {path}'


def load_map(path: Path) -> tuple[SavedMap, str, bool]:
    """
    Return the map in a file, or the previous one if that file is damaged or missing.

    Returns
    -------
    the map, a sentence that names its file, and whether it is the newer of the two

    Raises
    ------
    FileError : neither file is a map.

    """
    before = before_of(path)
    try:
        saved = _read(path)
        which = f'{path}'
        whole = True
    except FileError as error:
        if not os.path.exists(before):
            raise
        try:
            saved = _read(before)
            which = f'{before}, the map before: {error}'
            whole = False
        except FileError as another:
            raise FileError(path, f'cannot be loaded: {error}; {another}') from another
    return saved, f'{_count(saved)} keyframes loaded from {which}', whole


def keep_as(path: Path, another: Path) -> None:
    """
    Give a file a second name, in place of the file that has this name now.

    Raises
    ------
    FileError : it cannot be.

    """
    with replacing(another) as temporary:
        try:
            os.link(os.path.realpath(path), temporary)
        except OSError:  # not every file system has links
            shutil.copyfile(path, temporary)


def is_map(path: Path) -> bool:
    """Tell whether a file is a saved map, whole, as it was written."""
    try:
        with open_regular(path) as file:
            return is_proven(path, file.read())
    except (FileError, OSError):
        return False


def before_of(path: Path) -> Path:
    """Return the name of the map that was saved before the one at `path`."""
    return path.with_name(f'{path.name}.1')


def _count(saved: SavedMap) -> int:
    return len(saved.optimised.poses)


def _keep(path: Path) -> None:
    """Rename a file to that of the previous map, unless it is damaged and that one is whole."""
    before = before_of(path)
    if os.path.exists(path) and (is_map(path) or not is_map(before)):
        keep_as(path, before)


def _remove_leftovers(path: Path) -> None:
    """Remove temporary files of earlier writers of this file that were killed."""
    path = Path(os.path.realpath(path))
    for leftover in path.parent.glob(f'.{glob.escape(path.name)}*.tmp'):
        leftover.unlink(missing_ok=True)


def _left_out(saved: SavedMap) -> np.ndarray:
    """Return for each factor why it is left out; loops that are not judged yet are suspect."""
    factors = saved.builder.graph.between
    judgement = saved.judgement
    if not saved.robust or not len(judgement.accepted):
        return left_out_by(None, factors)
    words = left_out_by(judgement, factors)
    later = np.arange(len(words)) >= len(judgement.accepted)
    words[later & ~factors.is_odometry & ~factors.struck] = SUSPECT
    return words


def _remarks(saved: SavedMap) -> dict[str, Any]:
    """Return, by name, the values of the state for which g2o has no tag."""
    factors, judgement = saved.builder.graph.between, saved.judgement
    values = {f.name: getattr(record, f.name)
              for record in (saved.optimised, judgement) for f in fields(record)}
    del values['poses']
    names = {'robots': list(saved.robots)} if saved.robots else {}
    return values_of(saved.builder) | values | names | {
        'doubts': [asdict(doubt) for doubt in judgement.doubts], 'robust': saved.robust,
        'trusted': factors.trusted, 'struck': factors.struck}


def _read(path: Path) -> SavedMap:
    if kind := other_kind(path):  # some devices have no end
        raise FileError(path, f'cannot be read: it is {kind}')
    record = read_graph_file(path)
    if record.poses is None or record.stamps is None:
        raise FileError(path, 'has no poses or no stamps; expected a saved map')
    state = BuilderState.of_graph(record.graph, record.poses, record.stamps)
    optimised = Optimised.nothing(record.poses)
    values = dict(record.remarks or {})
    with wrong_contents(path):
        if not values:
            _require_within(limits_of(state))
            return SavedMap(state, optimised, Judgement.nothing(), True)
        doubts = tuple(
            Doubt(**doubt | {'pairs': tuple((i, j) for i, j in doubt.get('pairs', ()))})
            for doubt in values['doubts'])
        # One variance for all numbers, or one for each.
        each = np.ones((2, max(np.size(values.get('meant', 1.0)) // 2, 1)))
        judgement = _restored(replace(Judgement.nothing(), meant=each),
                              values | {'doubts': doubts})
        saved = SavedMap(restored(state, values), _restored(optimised, values), judgement,
                         values['robust'], robots=tuple(values.get('robots', ())))
        _require_within((*limits_of(saved.builder), *_limits(saved)))
    return saved


def _require_within(limits: Iterable[Limits]) -> None:
    """
    Check the sizes and ranges of what a file holds, before a back end goes on with it.

    Raises
    ------
    ValueError : naming a value that cannot be that of a map.

    """
    for name, values, shape, (low, high) in limits:
        if values.shape != shape or not ((values >= low) & (values <= high)).all():
            raise ValueError(f'{name} is no array {shape} of values from {low:g} to {high:g}')


def _limits(saved: SavedMap) -> Iterator[Limits]:
    """Yield the limits of a map and its judgement, see `limits_of`."""
    optimised, judgement, graph = saved.optimised, saved.judgement, saved.builder.graph
    n, m, d = len(optimised.poses), len(graph.between), graph.manifold.TANGENT_SIZE
    judged, size = (min(len(judgement.accepted), m),), (0, np.inf)
    yield 'dual', optimised.dual, (m * d,), FINITE
    yield 'cost', np.array(optimised.cost), (), size
    yield 'accepted', judgement.accepted, judged, (False, True)
    yield 'suspect', judgement.suspect, judged, (False, True)
    yield 'sigmas', np.nan_to_num(judgement.sigmas), judged, size
    yield 'noise', judgement.noise, judged, _POSITIVE
    yield 'variance', judgement.variance, (2,), _POSITIVE
    yield 'meant', judgement.meant, (2, judgement.meant.shape[1]), _POSITIVE
    yield 'drift', np.array(judgement.drift), (), FINITE
    yield 'robust', np.array(saved.robust), (), (False, True)
    yield 'slips', judgement.slips, (len(judgement.slips),), (0, m - 1)
    for doubt in judgement.doubts:
        pairs = np.array([(doubt.first, doubt.last), *doubt.pairs], np.int64)
        yield 'doubts', pairs, (len(pairs), 2), (0, n - 1)


def _restored(record: _Record, values: dict[str, Any]) -> _Record:
    """Return a record with the values that were saved, each converted to the type of its field."""
    return replace(record, **{f.name: _like(getattr(record, f.name), values[f.name])
                              for f in fields(record) if f.name in values})


def _like(kind: Any, value: Any) -> Any:
    if isinstance(kind, np.ndarray):
        return np.array(value, kind.dtype).reshape(-1, *kind.shape[1:])
    return type(kind)(value)
