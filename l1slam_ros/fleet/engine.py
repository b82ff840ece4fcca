# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Many jobs at once, on workers of dask: of this machine, or of a cluster.

In: jobs, one after the other. Out: what each returned, as they end. Only this module sees dask.
"""

import asyncio
import os
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any
from uuid import uuid4

from l1slam_ros.core.errors import L1SlamError, OptionError, optional_libraries
from l1slam_ros.fleet.isolated import TOOK_NOTHING, Job, failed
from l1slam_ros.fleet.starter import Values

if TYPE_CHECKING:
    from distributed import Client

# [s] How long a scheduler may take to answer, and its first worker to come.
_PATIENCE = 30
# So many jobs wait for each thread of a worker: enough that none is idle, few enough that a
# million do not fill the scheduler's memory. A cluster that grows is looked at so often [s].
_WAITING = 4
_LOOK = 10.0


@contextmanager
def engine(workers: int, scheduler: str | None) -> Iterator['Client']:
    """
    Yield a client of some workers.

    Parameters
    ----------
    workers : how many processes of this machine; not looked at with a scheduler
    scheduler : its address, or None

    Raises
    ------
    MissingError : dask.distributed is not installed.
    OptionError : nobody answers at that address, or no worker is there.

    """
    with optional_libraries():
        import dask
        from distributed import Client, LocalCluster

    quiet = {'distributed.worker.profile.enabled': False, 'distributed.logging.distributed':
             'critical', 'distributed.comm.timeouts.connect': f'{_PATIENCE} s'}
    with dask.config.set(quiet):
        if scheduler is not None:
            with _client(scheduler) as client:
                yield client
            return
        # A worker only waits for the process that works, so its own memory needs no watching.
        with LocalCluster(n_workers=workers, threads_per_worker=1, processes=True, memory_limit=0,
                          host='127.0.0.1', dashboard_address=None, silence_logs=50) as cluster, \
                Client(cluster) as client:
            yield client


@contextmanager
def _client(scheduler: str) -> Iterator['Client']:
    from distributed import Client

    try:
        client = Client(scheduler, timeout=_PATIENCE, set_as_default=False)
    except (OSError, ValueError) as error:
        raise OptionError(f'--scheduler {scheduler}: nobody answers; expected the address of a '
                          'dask scheduler, as tcp://127.0.0.1:8786') from error
    with client:
        try:
            client.wait_for_workers(1, timeout=_PATIENCE)
        except (OSError, asyncio.TimeoutError) as error:
            raise OptionError(f'--scheduler {scheduler}: no worker is there; expected at least '
                              'one, `dask worker ADDRESS`') from error
        yield client


def results(client: 'Client', work: Callable[[Job], Values], jobs: Iterable[Job],
            retries: int) -> Iterator[tuple[Job, Values]]:
    """
    Yield each job and what `work` returned of it, in the order in which they end.

    A job whose worker died is given to another one; after so many retries its row is that it
    failed.

    Raises
    ------
    L1SlamError : the scheduler ended.

    """
    from distributed import as_completed

    waiting = iter(jobs)
    run = uuid4().hex
    attempts: dict[Any, tuple[Job, int]] = {}
    running = as_completed(loop=client.loop)

    def start(job: Job, attempt: int) -> None:
        future = client.submit(work, job, key=f'{run}-{job.name}-{attempt}', pure=False)
        attempts[future.key] = job, attempt
        running.add(future)

    def fill(room: int) -> None:
        while len(attempts) < room and (job := next(waiting, None)) is not None:
            start(job, 0)

    room = _room(client)
    looked = time.monotonic()
    fill(room)
    for future in running:
        job, attempt = attempts.pop(future.key)
        if future.status == 'cancelled':
            raise L1SlamError('the scheduler is gone, and what is done is kept; expected '
                              '--resume, with a scheduler that is there')
        error = future.exception()
        if error is None:
            yield job, future.result()
        elif attempt < retries:
            start(job, attempt + 1)
        else:
            yield job, _lost(job, error, attempt + 1)
        future.release()
        if time.monotonic() > looked + _LOOK:
            room = _room(client)
            looked = time.monotonic()
        fill(room)


def _room(client: 'Client') -> int:
    """Return how many jobs may be with the scheduler."""
    with suppress(OSError):
        return _WAITING * max(sum(client.nthreads().values()), 1)
    return _WAITING


def _lost(job: Job, error: BaseException, attempts: int) -> Values:
    """Return the row of a job that no worker brought to an end."""
    # Dask's own sentence names places and times, which differ from run to run.
    row = failed(None, f'no worker could do it, {attempts} times: {type(error).__name__}')
    return {'row': {'recording': job.name, **row}, 'attempts': attempts, **TOOK_NOTHING,
            'worker': os.uname().nodename}
