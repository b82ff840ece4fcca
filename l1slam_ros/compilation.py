# SPDX-License-Identifier: Apache-2.0
"""Filling the cache of compiled loops before they are needed."""

from collections.abc import Callable

from l1slam_ros.core.warm_up import STEPS, warm_up


def fill_cache(report: Callable[[int, int], None], stopped: Callable[[], bool]) -> None:
    """
    Compile what is not in the cache yet; returns at once where nothing is missing.

    Parameters
    ----------
    report : called with how many parts are done, and of how many, whenever one is
    stopped : asked now and then; once it says yes, compiling ends and the call returns

    """
    done: list[str] = []

    def count(step: str) -> None:
        done.append(step)
        report(len(done), len(STEPS))

    if not stopped():
        warm_up(count)
