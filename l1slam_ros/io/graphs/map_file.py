# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The file of a running map: when it is saved, without ever replacing a file of other programs."""

import filecmp
import os
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from l1slam_ros.core.errors import FileError, OptionError
from l1slam_ros.core.running.backend import Backend
from l1slam_ros.core.running.snapshot import SavedMap
from l1slam_ros.io.files import dated_names, other_kind
from l1slam_ros.io.formats import named
from l1slam_ros.io.graphs.saved_map import before_of, is_map, keep_as, load_map, save_map
from l1slam_ros.io.node_options import NodeOptions

# An autosave begins after this part of its period, so that it has the rest of it to finish: then a
# power cut loses at most one period.
_PART = 0.5
# [bytes] of the end of a file, which tell one map from another: the checksum is in them.
_END = 128


class MapFile:
    """
    Saves and loads the map of a back end; calls from several threads are carried out in turn.

    Parameters
    ----------
    backend : the back end
    options : returns the current options, of which `save_path` and `autosave_period` are used
    warn : called with a sentence for the log

    Attributes
    ----------
    is_saving : whether the map is being saved now

    """

    def __init__(self, backend: Backend, options: Callable[[], NodeOptions],
                 warn: Callable[[str], object]):
        self._backend = backend
        self._options = options
        self._warn = warn
        self.is_saving = False
        self._one = threading.Lock()
        # Names of the robots by number: those of the node, then further ones of a loaded map.
        self._robots = options().names
        # When the last save, or else the node, began; and whether there was a save.
        self._began = time.monotonic()
        self._tried = False
        # Path and revision of the map when it was last saved or loaded.
        self._known = _absolute(options().save_path), backend.revisions.now
        # Of the file that this node wrote or loaded: path, last bytes, and when its graph began.
        # Of the file before it: path and last bytes.
        self._ours: tuple[object, ...] = ()
        self._ours_before: tuple[object, ...] = ()
        # How often a periodic save found that another program had replaced what this node wrote.
        self._replaced: Counter[Path] = Counter()

    def save(self) -> str:
        """Save the map; return a sentence with its path, and the files that were renamed."""
        with self._at_work(), self._backend.calm:
            revision = self._backend.revisions.now
            path = self._path()
            self._replaced.pop(path, None)
            saved = self._backend.saved()
            kept = self._keep_others(path, saved)
            return '; '.join([self._write(path, saved, revision), *kept])

    def autosave(self, taken: Callable[[], None] = lambda: None, periodic: bool = False) -> None:
        """
        Save the map if it has changed; keep a file at its path that this node did not write.

        Parameters
        ----------
        taken : called when the map has been copied; it may be changed from then on
        periodic : another save follows, so this one is refused where another program saves, too

        """
        with self._at_work():
            revision = self._backend.revisions.now
            saved = self._backend.saved() if self._is_to_be_saved() else None
            taken()
            if saved is None:
                return
            path = self._path()
            if periodic:
                self._require_alone(path)
            for sentence in self._keep_others(path, saved):
                self._warn(sentence)
            self._write(path, saved, revision)

    def _require_alone(self, path: Path) -> None:
        """
        Refuse a path where another program keeps replacing what this node saves.

        Once may be a person, who copies a map there. Of two nodes each would keep the file of the
        other in each period, until the disk is full.
        """
        end = _end_of(path)
        if not end or self._ours[:1] != (path,) or self._ours[1] == end:
            return
        self._replaced[path] += 1
        if self._replaced[path] > 1:
            raise FileError(path, 'another program saves there, too; expected a save_path of its '
                            'own. Until then only ~/save and the end of this node save')

    def _keep_others(self, path: Path, saved: SavedMap | None) -> list[str]:
        """Rename files that this node did not write; return a sentence for each."""
        if saved is None:
            return []
        sentences = []
        before = before_of(path)
        end = _end_of(path)
        end_before = _end_of(before)
        if end_before and self._ours_before != (before, end_before):
            sentences += _kept(before, path)
        if end and self._ours != (path, end, saved.graph_began):
            sentences += _kept(path, path)
        return sentences

    @contextmanager
    def _at_work(self) -> Iterator[None]:
        with self._one:
            self._began = time.monotonic()
            self.is_saving = True
            try:
                yield
            finally:
                self.is_saving = False

    def _write(self, path: Path, saved: SavedMap | None, revision: int) -> str:
        self._tried = True
        if saved is not None and self._robots:
            saved = replace(saved, robots=self._robots)
        # A file of others has another name by now. It may hold nonsense, unlike the map before.
        sentence = save_map(path, saved, self._ours[:2] == (path, _end_of(path)))
        self._known = path, revision
        self._ours = path, _end_of(path), saved.graph_began if saved else 0
        self._ours_before = before_of(path), _end_of(before_of(path))
        return sentence

    def load(self) -> str:
        """Load the map; return a sentence that says from where."""
        with self._one:
            sentence, whole = self._loaded()
        if not whole:
            self._warn(sentence)
        return sentence

    def _loaded(self) -> tuple[str, bool]:
        path = self._path()
        end = _end_of(path)
        saved, sentence, whole = load_map(path)
        saved = self._by_name(saved)
        with named(path):
            graph = self._backend.restore(saved)
        self._known = path, self._backend.revisions.now
        # A damaged file may still be of use, and a graph that is not a saved map belongs to a
        # person: neither is replaced.
        self._ours = (path, end, graph) if whole and is_map(path) else ()
        before = before_of(path)
        self._ours_before = (before, _end_of(before)) if is_map(before) else ()
        return sentence, whole

    def _by_name(self, saved: SavedMap) -> SavedMap:
        """Return a loaded map, its robots numbered as their names are in this node."""
        own = self._options().names
        named = len(saved.robots)
        names = self._robots = own + tuple(name for name in saved.robots if name not in own)

        def number(was: int) -> int:
            return names.index(saved.robots[was]) if was < named else was - named + len(names)

        # A map that was saved without names belongs to the first robot.
        if not own or not named:
            return saved
        return replace(saved, builder=saved.builder.renumbered(number))

    def load_at_start(self, tell: Callable[[str], object]) -> None:
        """Load the map if there is one; `tell` what was loaded, or warn of a damaged file."""
        try:
            sentence, well = self._loaded()
        except FileError as error:
            sentence = f'the map begins empty: {error}'
            well = not os.path.exists(self._path())
        (tell if well else self._warn)(sentence)

    def is_due(self) -> bool:
        """
        Return whether to autosave now.

        The first save is due as soon as there is a map: a node that is restarted again and again
        would otherwise lose its map each time. If the path has a file that was not loaded, the
        first save waits for a period, so that a person can still load that file.
        """
        due = self._began + _PART * self._options().autosave_period
        return self._is_to_be_saved() and (time.monotonic() >= due or (
            not self._tried and (bool(self._ours) or not _end_of(self._path()))))

    def _is_to_be_saved(self) -> bool:
        options = self._options()
        return (options.save_path != '' and options.autosave_period > 0
                and self._known != (_absolute(options.save_path), self._backend.revisions.now))

    def _path(self) -> Path:
        path = self._options().save_path
        if not path:
            raise OptionError('the parameter save_path is empty, expected the name of a .g2o file')
        return _absolute(path)


def unusable_path(save_path: str) -> str:
    """Return a sentence if no file can be written to `save_path`, else an empty one."""
    if not save_path:
        return ''
    path = _absolute(save_path)
    if not os.path.isdir(path.parent):  # `Path.is_dir` raises where a name is too long
        return f'save_path is {save_path!r}, but there is no folder {path.parent}'
    kind = other_kind(path)
    return f'save_path is {save_path!r}, which is {kind}' if kind else ''


def _absolute(path: str) -> Path:
    # Not `Path.expanduser`: that raises where there is no such home.
    return Path(os.path.expanduser(path)).absolute() if path else Path()


def _end_of(path: Path) -> bytes:
    """Return the last bytes of a file; empty if there is none. A saved map ends in a checksum."""
    if not os.path.isfile(path):
        return b''
    with path.open('rb') as file:
        file.seek(max(file.seek(0, os.SEEK_END) - _END, 0))
        return file.read()


def _kept(path: Path, of: Path) -> list[str]:
    """Rename a file after its date; return a sentence, or none if such a copy exists already."""
    for kept in dated_names(path, of):
        if not os.path.lexists(kept):
            break
        if os.path.isfile(kept) and filecmp.cmp(path, kept, shallow=False):
            return []
    keep_as(path, kept)
    return [f'{path} held another map: it is kept as {kept}']
