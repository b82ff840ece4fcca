# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
The file that keeps the machine code of a step: of the loops of one module, or those for space.

A file is the digest of all that follows, a line of JSON, and one object file after the other. It
is read as a whole or not at all: with another digest, or if it was made of other sources, it is as
if it were not there, and so it is to a process that has imported older sources than are there now.

Its name has what else its code depends on: Python, numba, llvmlite, NumPy, settings of numba's,
and the processor. So whoever shares a folder but none of these does not replace what others need.
"""

import functools
import hashlib
import importlib.machinery
import importlib.util
import json
import os
import platform
import sys
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np

KERNELS = Path(__file__).parents[1]
_CORE = __name__.removesuffix('.kernels.kept.objects')
# A step is the path in `kernels` of a module, or the path in `core` of another one; and with this
# at its end: the versions for space of its loops.
SPACE = ':space'
# Extension modules of numba's that hold what its machine code calls: where they are in it.
HELPERS = ('_helperlib', '_dynfunc', 'core/runtime/_nrt_python')
_DIGEST = 64  # [characters]
# Settings of numba's that the code of loops does not depend on: where it is kept, and the threads
# of loops that have more than one, as none of ours has.
_WITHOUT_EFFECT = ('NUMBA_CACHE_DIR', 'NUMBA_NUM_THREADS', 'NUMBA_THREADING_LAYER')
# What a processor is known by, of all that the kernel of Linux says of it.
_PROCESSOR = ('model name', 'flags', 'Features', 'CPU implementer', 'CPU part')


class Kept(NamedTuple):
    """
    One version of a loop.

    takes : of each argument what it is (array, tuple or number), the type of its entries, and how
    many dimensions or entries it has
    entry : the name of the function that takes and returns objects of Python
    environment, constants : where that finds objects, and these: the types of the arrays it makes
    missing : what the code calls that others define
    code : an object file
    """

    takes: list[tuple[str, str, int]]
    entry: str
    environment: str
    constants: list[str]
    missing: list[str]
    code: bytes


def write(step: str, loops: dict[str, list[Kept]], beside: list[str]) -> str:
    """
    Keep the loops of a step, so that a reader finds the whole file or none; return where it is.

    beside : files of numba's cache without which a step is not complete
    """
    index = {name: [[*one[:-1], len(one.code)] for one in versions]
             for name, versions in loops.items()}
    codes = [one.code for versions in loops.values() for one in versions]
    head = json.dumps({'key': key(step), 'beside': beside, 'loops': index}).encode()
    rest = b''.join([head, b'\n', *codes])
    return put(file_name(step), hashlib.sha256(rest).hexdigest().encode() + rest)


def put(name: str, content: bytes) -> str:
    """Write a file where it can be; a reader finds the whole or none. Returns where it is."""
    path = next(filter(is_writable, folders())) / name
    with tempfile.NamedTemporaryFile(dir=path.parent, delete=False) as file:
        file.write(content)
    os.chmod(file.name, 0o644)  # others may read what root has compiled
    os.replace(file.name, path)
    return str(path)


def read(step: str) -> dict[str, list[Kept]]:
    """Return the loops that are kept of a step, by their names; none of a file not sound."""
    _, head, codes = _sound(step)
    loops: dict[str, list[Kept]] = {}
    begin = 0
    for name, versions in head['loops'].items():
        for *facts, size in versions:
            kept = Kept._make([*facts, codes[begin:begin + size]])
            loops.setdefault(name, []).append(kept)
            begin += size
    return loops


def files(step: str) -> list[str]:
    """Return the files that keep a step; none if one of them is missing or not sound."""
    path, head, _ = _sound(step)
    return [path, *head['beside']] if path and all(map(os.path.exists, head['beside'])) else []


def _sound(step: str) -> tuple[str, dict, bytes]:
    """Return a sound file of a step, the first line of it, and what follows."""
    for folder in folders() if all(map(is_as_imported, _sources(step))) else ():
        path = folder / file_name(step)
        try:
            whole = path.read_bytes()
        except OSError:
            continue
        if hashlib.sha256(whole[_DIGEST:]).hexdigest().encode() == whole[:_DIGEST]:
            head, _, codes = whole[_DIGEST:].partition(b'\n')
            facts = json.loads(head)
            if facts['key'] == key(step):
                return str(path), facts, codes
    return '', {'loops': {}}, b''


def folders() -> list[Path]:
    """Return where files may be: where numba would keep what it compiles, the first first."""
    user = os.environ.get('XDG_CACHE_HOME') or os.path.join(os.path.expanduser('~'), '.cache')
    usual = [KERNELS / '__pycache__', Path(user) / 'numba']
    if own := os.environ.get('NUMBA_CACHE_DIR'):
        # Only there, as numba; of one that is read-only what it has, and the rest elsewhere.
        return [Path(own), *(() if is_writable(Path(own)) else usual)]
    return usual


def is_writable(folder: Path) -> bool:
    """Tell whether files can be made in a folder, which is made if it can be."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def file_name(end: str) -> str:
    """Return the name of a file: one for each place of the package, and its surroundings."""
    facts = os.fsencode(KERNELS) + surroundings().encode()
    return (f'l1slam-{sys.implementation.cache_tag}-{hashlib.sha256(facts).hexdigest()[:16]}.'
            f'{end.replace(":", ".")}')


def key(step: str) -> str:
    """Return what changes with the sources of a step, and with what LLVM says of the processor."""
    from llvmlite import binding

    processor = binding.get_host_cpu_name(), sorted(binding.get_host_cpu_features().items())
    facts = processor, step, [path.read_bytes() for path in _sources(step)]
    return hashlib.sha256(repr(facts).encode()).hexdigest()


def step_of(module: str, space: bool) -> str:
    """Return the step that has the loops of a module, those for space or the others."""
    name = module.removeprefix(f'{_CORE}.').removeprefix('kernels.')
    return name + SPACE if space else name


def module_of(step: str) -> str:
    """Return the full name of the module that has the loops of a step."""
    name = step.removesuffix(SPACE)
    is_elsewhere = '.' in name and not (KERNELS / name.partition('.')[0]).is_dir()
    return f'{_CORE}.{name}' if is_elsewhere else f'{_CORE}.kernels.{name}'


def sources() -> dict[str, tuple[int, int]]:
    """Return time of change [ns] and size of all sources of loops, and of what keeps them."""
    elsewhere = KERNELS.parent.glob('*/*kernels.py')
    return {str(path): _state(path) for path in sorted((*KERNELS.rglob('*.py'), *elsewhere))}


def note_import(source: Path) -> None:
    """Note the state of a source as this process imports it."""
    if source not in _imported:
        _imported[source] = _state(source)


def is_as_imported(source: Path) -> bool:
    """Tell whether a source is what this process runs, or would; it is not after an upgrade."""
    now = _state(source)
    return _imported.get(source, now) == now


def _state(path: Path) -> tuple[int, int]:
    with suppress(OSError):
        stat = path.stat()
        return stat.st_mtime_ns, stat.st_size
    return 0, 0


def _sources(step: str) -> list[Path]:
    path = module_of(step).removeprefix(f'{_CORE}.').replace('.', '/')
    return [KERNELS.parent / f'{path}.py', *_SHARED]


def surroundings() -> str:
    """Return all but the sources that compiled loops depend on; imports neither numba nor LLVM."""
    settings = sorted(pair for pair in os.environ.items()
                      if pair[0].startswith('NUMBA_') and not pair[0].startswith(_WITHOUT_EFFECT))
    own = Path('.numba_config.yaml')
    return repr((settings, own.read_bytes() if own.exists() else b'', _machine_and_libraries()))


@functools.cache
def _machine_and_libraries() -> str:
    parts = [folder / part for name in ('numba', 'llvmlite', 'numpy')
             if (folder := folder_of(name)) for part in ('__init__.py', '_version.py')]
    parts += [path for path in helpers().values() if path]
    parts += sorted((folder_of('llvmlite') or KERNELS).glob('binding/libllvmlite*'))
    stats = [(str(path), stat.st_mtime_ns, stat.st_size)
             for path in parts if path.exists() for stat in [path.stat()]]
    return repr((sys.version, platform.machine(), np.__version__, _processor(), stats))


def helpers() -> dict[str, Path | None]:
    """Return where each of `HELPERS` is, by its name; None: nowhere."""
    folder = folder_of('numba')
    return {f'numba.{part}'.replace('/', '.'): next(
        (path for suffix in importlib.machinery.EXTENSION_SUFFIXES
         if folder and (path := folder / f'{part}{suffix}').exists()), None) for part in HELPERS}


def folder_of(package: str) -> Path | None:
    """Return where a package is, which is not imported."""
    spec = importlib.util.find_spec(package)
    return Path(spec.origin).parent if spec and spec.origin else None


def _processor() -> list[str]:
    try:
        first = Path('/proc/cpuinfo').read_bytes().decode().split('\n\n')[0]
    except OSError:
        return [platform.processor()]
    return [line for line in first.splitlines() if line.startswith(_PROCESSOR)]


_SHARED = [KERNELS / 'compiled.py', *sorted(Path(__file__).parent.glob('*.py'))]
_imported: dict[Path, tuple[int, int]] = {}
for _source in _SHARED:
    note_import(_source)
