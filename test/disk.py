# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""A disk that fails at any call one likes, and forgets in a power cut what was not synced."""

import errno
import os
from pathlib import Path

_WATCHED = ('fsync', 'replace', 'rename')


class Disk:
    """
    The file system below a folder, as what writes there sees it.

    Every opening of a file to write, fsync and rename is a call; the one numbered `failing`, from
    0, fails. After each `seen` is called, as if the power were cut right then.
    """

    def __init__(self, monkeypatch, folder, failing=None, seen=lambda: None):
        self.failing = failing
        self.seen = seen
        self.calls = []
        self._contents, self._names = {}, {}  # what is on the disk, by inode
        for path in [folder, *folder.rglob('*')]:
            self._sync(path)
        for name in _WATCHED:
            monkeypatch.setattr(os, name, self._watched(name, getattr(os, name)))
        monkeypatch.setattr(Path, 'open', self._open(Path.open))

    def _watched(self, name, real):
        def call(*arguments):
            self._count(name)
            real(*arguments)
            if name == 'fsync':
                self._sync(Path(os.readlink(f'/proc/self/fd/{arguments[0]}')))
            self.seen()
        return call

    def _open(self, real):
        def call(path, mode='r', *arguments, **keywords):
            if not set(mode) & set('wxa'):
                return real(path, mode, *arguments, **keywords)
            self._count('open')
            opened = real(path, mode, *arguments, **keywords)
            self._contents.pop(os.fstat(opened.fileno()).st_ino, None)
            return opened
        return call

    def _count(self, name):
        self.calls.append(name)
        if len(self.calls) - 1 == self.failing:
            raise OSError(errno.EIO, os.strerror(errno.EIO))

    def _sync(self, path):
        inode = path.stat().st_ino
        if path.is_dir():
            self._names[inode] = {child.name: child.stat().st_ino for child in path.iterdir()}
        else:
            self._contents[inode] = path.read_bytes()

    def after_a_power_cut(self, path, folder, early):
        """
        Return what `path`, below `folder`, would hold: bytes; None: there would be no such file.

        early : renamings are on the disk already, as they may be; else only those synced
        """
        if early:
            return self._contents.get(path.stat().st_ino, b'') if path.exists() else None
        inode = folder.stat().st_ino
        for part in path.relative_to(folder).parts:
            inode = self._names.get(inode, {}).get(part)
        return None if inode is None else self._contents.get(inode, b'')
