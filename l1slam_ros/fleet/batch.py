# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
A folder of recordings -> maps, a log, and a table.

In: what `l1slam batch` was asked. Out: in the folder of the results

    maps/<recording>.g2o   as `l1slam solve --output` writes it
    log.jsonl              a line for each recording: its row, and what it took
    table.csv              a row for each recording, by name; table.parquet, where pyarrow is there
"""

import os
import re
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from l1slam_ros.core.errors import FileError
from l1slam_ros.fleet import cluster, isolated
from l1slam_ros.fleet.child import Values
from l1slam_ros.fleet.finding import Recording, find
from l1slam_ros.fleet.isolated import Job, Limits, Work
from l1slam_ros.fleet.journal import Journal, journal
from l1slam_ros.fleet.table import Row, as_csv, as_parquet
from l1slam_ros.io.files import replacing, reported
from l1slam_ros.io.progress import Progress

MAPS = 'maps'
LOG = 'log.jsonl'
TABLE = 'table'
FAILED = 'failed'
# What a process that was killed amid writing left beside its file, see `files.replacing`.
_LEFTOVER = re.compile(r'\..+\.[0-9a-f]{8}\.tmp')


@dataclass(frozen=True)
class Batch:
    """
    What is to be done.

    folder, output : of recordings and of results; arguments : how each is solved, as words of a
    command; about : what the results depend on, values of JSON; limits : what one may take;
    resume : whether to take up what was begun; again : whether then to try once more what failed.
    """

    folder: Path
    output: Path
    arguments: tuple[str, ...]
    about: dict[str, Any]
    limits: Limits
    resume: bool = False
    again: bool = False


def run(batch: Batch, work: Work, workers: int, scheduler: str | None) -> list[Row]:
    """
    Do what is not done yet, and return the rows of the table, which is written by then.

    work : solves a recording; workers : how many do so at once on this machine, if scheduler, the
    address of a cluster's, is None.

    Raises
    ------
    FileError : there are no recordings, or the results cannot be written where they should be.

    """
    recordings = find(batch.folder, batch.output)
    _require_own(batch)
    with journal(batch.output / LOG, batch.about, batch.resume) as log:
        for path in (_csv(batch), _parquet(batch)):
            log.refuse_other_table(path)
        fingerprints = {one.name: one.fingerprint() for one in recordings}
        missing = [one for one in recordings
                   if not _is_done(batch, one, fingerprints[one.name], log.ended(one.name))]
        for folder in {_map(batch, one).parent for one in missing}:
            with reported(folder):
                folder.mkdir(parents=True, exist_ok=True)
        if missing:
            _solve(batch, work, workers, scheduler, missing, fingerprints, log)
        for file in _leftovers(batch.output / MAPS):
            os.unlink(file)
        rows = [line['row'] for one in recordings if (line := log.ended(one.name))]
        _write_table(batch, rows, log)
    return rows


def _solve(batch: Batch, work: Work, workers: int, scheduler: str | None,
           missing: list[Recording], fingerprints: dict[str, list[list[int]]],
           log: Journal) -> None:
    jobs = (Job(one.name, os.path.abspath(one.path), os.path.abspath(_map(batch, one)),
                batch.arguments) for one in missing)
    limits = batch.limits
    results = (isolated.results(work, jobs, limits, workers) if scheduler is None else
               cluster.results(scheduler, partial(_on_worker, work, limits), jobs,
                               limits.retries, limits.stall))
    # Closed before anything else happens, so that an interrupt leaves no process behind.
    with closing(results), Progress(len(missing), 'recording', label='solving') as progress:
        failures = 0
        for job, ended in results:
            row = ended['row']
            if row['status'] != FAILED:
                row['map'] = f'{MAPS}/{job.name}.g2o'
            failures += row['status'] == FAILED
            log.add({'recording': job.name, **ended, 'read': fingerprints[job.name],
                     'at': time.strftime('%Y-%m-%dT%H:%M:%SZ', time.gmtime())})
            progress.advance(1, f'{failures:,} failed' if failures else '')


def _on_worker(work: Work, limits: Limits, job: Job) -> Values:
    """Do one job on a worker of a cluster, which only waits for the process that does it."""
    [(_, ended)] = isolated.results(work, [job], limits, 1)
    return ended


def _require_own(batch: Batch) -> None:
    """Refuse a folder that holds anything else, and make it where there is none."""
    output = batch.output
    if batch.resume:
        return
    if os.path.lexists(output) and not output.is_dir():
        raise FileError(output, 'expected a folder, or a name that is free')
    with reported(output):
        output.mkdir(exist_ok=True)
        found = sorted(os.listdir(output))
    if LOG in found:
        raise FileError(output, 'holds the results of a batch; expected --resume, or another name')
    if found:
        raise FileError(output, f'is not empty, it holds {found[0]}; expected an empty folder, or '
                        'a name that is free')


def _is_done(batch: Batch, recording: Recording, fingerprint: list[list[int]],
             line: Values | None) -> bool:
    """Tell whether a recording, as it is now, has its map or its sentence."""
    if line is None or line['read'] != fingerprint:
        return False
    if line['row']['status'] == FAILED:
        return not batch.again
    return _map(batch, recording).is_file()


def _write_table(batch: Batch, rows: list[Row], log: Journal) -> None:
    for path, content in ((_csv(batch), as_csv(rows)), (_parquet(batch), as_parquet(rows))):
        if content is not None:
            log.announce_table(path.name, content)
            with replacing(path) as temporary, open(temporary, 'wb') as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())


def _leftovers(folder: Path) -> Iterator[str]:
    for here, _, names in os.walk(folder):
        yield from (os.path.join(here, name) for name in names if _LEFTOVER.fullmatch(name))


def _map(batch: Batch, recording: Recording) -> Path:
    return batch.output / MAPS / recording.map_name


def _csv(batch: Batch) -> Path:
    return batch.output / f'{TABLE}.csv'


def _parquet(batch: Batch) -> Path:
    return batch.output / f'{TABLE}.parquet'
