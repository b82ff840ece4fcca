"""Nested dissection: which nodes of a graph, see `symbolic`, hold two halves of it together."""

import numpy as np
from numpy.typing import NDArray

Places = NDArray[np.int32]

def dissect(start: Places, adjacent: Places) -> Places:
    """Return stages (n,) for `minimum_degree`: separators come last, those of the whole at all."""
