# SPDX-License-Identifier: Apache-2.0
"""Where a running back end keeps its map: when it is saved, and never over that of another."""

import time
from collections.abc import Callable
from pathlib import Path

from l1slam_ros.core.errors import FileError, OptionError
from l1slam_ros.core.online.backend import Backend
from l1slam_ros.io.graphs.saved_map import keep_as, load_map, save_map
from l1slam_ros.io.node_options import NodeOptions

# An autosave begins after such a part of its period: a busy machine comes late to it, and odometry
# on its way is not in it yet.
_PART = 0.8


class MapFile:
    """
    Saves and loads the map of a back end; one thread at a time may.

    Parameters
    ----------
    backend : whose map
    options : returns `save_path` and `autosave_period` as they are now
    warn : told what a person should know

    Attributes
    ----------
    is_saving : whether a save is under way

    """

    def __init__(self, backend: Backend, options: Callable[[], NodeOptions],
                 warn: Callable[[str], object]):
        self._backend, self._options, self._warn = backend, options, warn
        self.is_saving = False
        self._began, self._took = time.monotonic(), 0.0
        # The version that is in the file, and the file, if what it held before was ours.
        self._version, self._ours = backend.version, Path()

    def save(self) -> str:
        """Save the map; return a sentence that says where."""
        path, self._began, self.is_saving = self._path(), time.monotonic(), True
        try:
            version = self._backend.version
            sentence = save_map(path, self._backend.saved())
            self._version, self._ours = version, path
        finally:
            self._took, self.is_saving = time.monotonic() - self._began, False
        return sentence

    def load(self) -> str:
        """Load the map; return a sentence that says from where."""
        sentence, whole = self._loaded()
        if not whole:
            self._warn(sentence)
        return sentence

    def _loaded(self) -> tuple[str, bool]:
        path = self._path()
        saved, sentence, whole = load_map(path)
        found, expected = saved.growth.graph.manifold, self._backend.manifold
        if found is not expected:
            raise FileError(path, f'is a map of {found.NAME}; expected one of {expected.NAME}')
        self._backend.restore(saved)
        self._version, self._ours = self._backend.version, path
        return sentence, whole

    def load_at_start(self, tell: Callable[[str], object]) -> None:
        """Load the map if there is one; tell so, or warn where there is a damaged one."""
        try:
            sentence, well = self._loaded()
        except FileError as error:
            sentence, well = f'the map begins empty: {error}', not self._path().exists()
        (tell if well else self._warn)(sentence)

    def disown(self) -> None:
        """Let what is in the file be another map than that of the back end from now on."""
        self._ours = Path()

    def seconds_left(self) -> float:
        """Return in how many seconds `autosave` is due, or when to ask again."""
        options = self._options()
        # It is to end within a period of the beginning of the last.
        wait = _PART * options.autosave_period - 2 * self._took
        left = self._began + wait - time.monotonic()
        return max(left, 0.0 if self._is_to_be_saved() else options.update.period)

    def autosave(self) -> None:
        """Save the map if it has changed; what stood in its place, if not its own, is kept."""
        self._began = time.monotonic()
        if not self._is_to_be_saved() or self._backend.saved() is None:
            return
        path = self._path()
        if path != self._ours and path.exists():
            kept = path.with_name(f'{path.stem}.{_time_of(path)}{path.suffix}')
            keep_as(path, kept)
            self._warn(f'{path} held another map: it is kept as {kept}')
        self.save()

    def _is_to_be_saved(self) -> bool:
        options = self._options()
        return (options.save_path != '' and options.autosave_period > 0
                and self._backend.version != self._version)

    def _path(self) -> Path:
        path = self._options().save_path
        if not path:
            raise OptionError('the parameter save_path is empty, expected the name of a .g2o file')
        return Path(path).expanduser().absolute()


def missing_folder(save_path: str) -> str:
    """Return what is wrong with a `save_path` whose folder is not there; else nothing."""
    folder = Path(save_path).expanduser().absolute().parent
    there = not save_path or folder.is_dir()
    return '' if there else f'save_path is {save_path!r}, but there is no folder {folder}'


def _time_of(path: Path) -> str:
    """Return when a file was written, as a part of a name."""
    return time.strftime('%Y-%m-%dT%H-%M-%S', time.localtime(path.stat().st_mtime))
