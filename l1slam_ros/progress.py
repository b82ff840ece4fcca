# SPDX-License-Identifier: Apache-2.0
"""Progress on standard error: a bar on a terminal, nothing elsewhere or when asked to be quiet."""

from types import TracebackType


class Progress:
    """
    A bar that counts to a total; a context manager.

    Parameters
    ----------
    total : how many steps there are at most
    unit : what one step is called
    quiet : show nothing, even on a terminal
    label : what is being done
    delay : [s] show nothing of what is done sooner

    """

    def __init__(self, total: float, unit: str, quiet: bool = False, label: str = '',
                 delay: float = 0.0):
        from tqdm import tqdm

        # None: tqdm looks whether standard error is a terminal.
        self._bar = tqdm(total=total, unit=unit, disable=True if quiet else None, leave=False,
                         desc=label or None, delay=delay)

    def __enter__(self) -> 'Progress':
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        self._bar.close()

    def advance(self, steps: float = 1) -> None:
        """Count some steps."""
        self._bar.update(steps)

    def report(self, iteration: int, cost: float) -> None:
        """Count one iteration of a solver and show its cost."""
        self._bar.set_postfix_str(f'cost {cost:.6g}', refresh=False)
        self._bar.update(1)
