# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Jobs on the workers of a cluster of dask.

In: the address of a scheduler, and jobs. Out: what each returned, as they end. Only this module
sees dask; without a cluster nothing of it is needed.
"""

import asyncio
import logging
import os
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Any
from uuid import uuid4

from l1slam_ros.core.errors import L1SlamError, OptionError, optional_libraries
from l1slam_ros.fleet.child import Values
from l1slam_ros.fleet.isolated import Ended, Job, failed
from l1slam_ros.io.files import counted
from l1slam_ros.io.progress import say

if TYPE_CHECKING:
    from distributed import Client, Future

# [s] How long a scheduler may take to answer, and its first worker to come.
_PATIENCE = 30
# So many jobs wait for each thread of a worker: enough that none is idle, few enough that a
# million do not fill the scheduler's memory. A cluster that grows is looked at so often [s].
_WAITING = 4
_LOOK = 10.0
_SECURE = 'tls://'
_RESUME = ', and what is done is kept; expected --resume, with a scheduler and workers that stay'
# So many characters of what dask says are shown.
_LONGEST = 200


def results(scheduler: str, work: Callable[[Job], Values], jobs: Iterable[Job], retries: int,
            stall: float) -> Ended:
    """
    Yield each job and what `work` returned of it, in the order in which they end.

    A job whose worker died is given to another one; after so many retries its row is that it
    failed. Where no worker works on anything for `stall` seconds, all jobs are given out again.

    Raises
    ------
    MissingError : dask.distributed is not installed.
    OptionError : nobody answers at that address, or no worker is there.
    L1SlamError : the scheduler ended, or its workers did.

    """
    with optional_libraries():
        import dask
        import distributed  # noqa: F401

    quiet = {'distributed.comm.timeouts.connect': f'{_PATIENCE} s'}
    with dask.config.set(quiet), _silent(), _client(scheduler) as client, _in_one_line():
        yield from _results(client, work, jobs, retries, stall)


@contextmanager
def _client(scheduler: str) -> Iterator['Client']:
    from distributed import Client

    try:
        asyncio.run(_reach(scheduler))  # as a client that cannot comes to no end
        client = Client(scheduler, timeout=_PATIENCE, set_as_default=False)
    except Exception as error:  # of whatever kind, by how far it came
        raise OptionError(f'--scheduler {scheduler}: nobody answers ({_line(error)}); expected '
                          'the address of a dask scheduler, as tls://HOST:8786') from error
    with client:
        if not scheduler.startswith(_SECURE):
            say(f'--scheduler {scheduler}: not {_SECURE}, so whoever reaches the scheduler or '
                'a worker over the network can run code there, and here')
        try:
            client.wait_for_workers(1, timeout=_PATIENCE)
        except Exception as error:
            raise OptionError(f'--scheduler {scheduler}: no worker is there; expected at least '
                              'one, `dask worker ADDRESS`') from error
        yield client


async def _reach(scheduler: str) -> None:
    """Connect to a scheduler, with what dask's configuration says of certificates."""
    from distributed import Security
    from distributed.comm import connect

    comm = await connect(scheduler, timeout=_PATIENCE,
                         **Security().get_connection_args('client'))
    await comm.close()


class _Given:
    """The jobs that a scheduler has been given."""

    def __init__(self, client: 'Client', work: Callable[[Job], Values], retries: int):
        self._client, self._work, self._retries = client, work, retries
        self._by_key: dict[Any, tuple[Job, int, Future]] = {}
        self._ended: SimpleQueue[Future] = SimpleQueue()

    def __len__(self) -> int:
        return len(self._by_key)

    def give(self, job: Job, attempt: int = 1) -> None:
        """Have the scheduler find a worker."""
        future = self._client.submit(self._work, job, key=f'l1slam-{uuid4().hex}', pure=False)
        self._by_key[future.key] = job, attempt, future
        future.add_done_callback(self._ended.put)

    def next(self, patience: float) -> tuple[Job, Values] | None:
        """Return the next job that ends and how it did; None: none did so soon [s]."""
        try:
            future = self._ended.get(timeout=patience)
        except Empty:
            return None
        if future.key not in self._by_key:  # of one that was given out again
            return None
        job, attempt, _ = self._by_key.pop(future.key)
        if future.status == 'cancelled':
            raise L1SlamError(f'the scheduler is gone{_RESUME}')
        error = future.exception()
        if error is None:
            ended: Values = future.result()
            return job, ended
        if attempt > self._retries:
            return job, _lost(job, error, attempt)
        self.give(job, attempt + 1)
        return None

    def give_again(self) -> None:
        """Give all jobs to the scheduler as if it had none."""
        before = list(self._by_key.values())
        self._by_key.clear()
        for job, attempt, future in before:
            future.release()
            self.give(job, attempt)


def _results(client: 'Client', work: Callable[[Job], Values], jobs: Iterable[Job], retries: int,
             stall: float) -> Ended:
    waiting = iter(jobs)
    given = _Given(client, work, retries)
    period = min(_LOOK, stall / 2)
    looked = at_work = time.monotonic()
    room = max(_threads(client, stall)[0], 1) * _WAITING
    stalls = 0
    while True:
        while len(given) < room and (job := next(waiting, None)) is not None:
            given.give(job)
        if not given:
            return
        if found := given.next(period):
            at_work, stalls = time.monotonic(), 0
            yield found
        if (now := time.monotonic()) < looked + period:
            continue
        looked = now
        threads, busy = _threads(client, stall)
        room = max(threads, 1) * _WAITING
        if busy:
            at_work = now
        elif now > at_work + stall:
            stalls, at_work = stalls + 1, now
            stalled = f'no worker has been at work for {stall:g} s'
            if stalls > retries:
                raise L1SlamError(f'{stalled}, {counted(stalls, "time")}{_RESUME}')
            say(f'{stalled}; all jobs are given out again')
            given.give_again()


def _threads(client: 'Client', patience: float) -> tuple[int, int]:
    """Return how many threads the workers have, and how many jobs are being done; 0: unknown."""
    try:
        seen = client.sync(client.scheduler.identity, callback_timeout=min(patience, _PATIENCE))
    except Exception:  # gone, or it does not answer, which dask says in many ways
        return 0, 0
    workers = seen['workers'].values()
    return (sum(worker['nthreads'] for worker in workers),
            sum(worker['metrics'].get('task_counts', {}).get('executing', 0)
                for worker in workers))


@contextmanager
def _in_one_line() -> Iterator[None]:
    """Say in a sentence what dask has to say."""
    try:
        yield
    except L1SlamError:
        raise
    except Exception as error:  # it has no kind of its own
        raise L1SlamError(f'dask: {_line(error)}{_RESUME}') from error


@contextmanager
def _silent() -> Iterator[None]:
    """Let dask write nothing to standard error: what matters is raised."""
    before = logging.root.manager.disable
    logging.disable()
    try:
        yield
    finally:
        logging.disable(before)


def _line(error: BaseException) -> str:
    return f'{type(error).__name__}: {" ".join(str(error).split())[:_LONGEST]}'


def _lost(job: Job, error: BaseException, attempts: int) -> Values:
    """Return the row of a job that no worker brought to an end."""
    # Dask's own sentence names places and times, which differ from run to run.
    row = failed(None, f'no worker could do it, {attempts} times: {type(error).__name__}')
    return {'row': {'recording': job.name, **row}, 'attempts': attempts, 'seconds': 0.0,
            'cpu_seconds': 0.0, 'peak_bytes': 0, 'worker': os.uname().nodename}
