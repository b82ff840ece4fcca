# SPDX-License-Identifier: Apache-2.0
"""Tables, lists and numbers of a report in Markdown."""

from collections.abc import Iterable, Sequence


def table(header: Sequence[str], rows: Sequence[Sequence[str]], words: int = 1) -> list[str]:
    """Return a table whose first columns hold words, the others numbers."""
    lines = [header, ['---'] * words + ['---:'] * (len(header) - words), *rows]
    return [f'| {" | ".join(cells)} |' for cells in lines]


def bullets(sentences: Iterable[str]) -> list[str]:
    """Return a list, a line for each sentence."""
    return [f'- {sentence}' for sentence in sentences]


def listed(words: Sequence[str]) -> str:
    """Return 'a, b and c'."""
    return ' and '.join(filter(None, (', '.join(words[:-1]), words[-1])))


def cost(value: float) -> str:
    """Return a cost in six digits, as the paper prints them."""
    return f'{value:.6g}'.replace('e+0', 'e')


def percent(part: float) -> str:
    """Return a part as per cent."""
    return f'{100 * part:.2g}%'


def metres(length: float) -> str:
    """Return a length [m] with its unit, to the centimetre."""
    return f'{length:.2f} m'


def milliseconds(seconds: float | None) -> str:
    """Return a time [s] in ms, without the unit."""
    if seconds is None:
        return 'did not finish'
    return f'{1e3 * seconds:.3g}' if seconds < 1 else f'{1e3 * seconds:.0f}'
