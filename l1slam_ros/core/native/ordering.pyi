"""In which order to eliminate the nodes of a graph, see `symbolic`, so that little fills in."""

import numpy as np
from numpy.typing import NDArray

from l1slam_ros.core.geometry.manifold import Indices

Places = NDArray[np.int32]

def minimum_degree(start: Places, adjacent: Places, stage: Places) -> tuple[Places, float]:
    """
    Return an order (n,) by approximate minimum degree, and the work of its factor.

    stage : (n,) nodes of a higher one come later, whatever their degree; but for those that all
        their neighbours come before, or with
    work : as of `symbolic.lay_out`
    """

def resume(
    start: Places, adjacent: Places, position: Places, first: Places, begin: Indices, rows: Places,
) -> Places:
    """
    Return the order (n,) of a graph that has grown since a layout of it was made.

    position, first, begin, rows : of `symbolic.lay_out`, of fewer nodes or neighbours. Panels that
    have all neighbours of their nodes stay, if all below them do; the others are ordered anew.
    """

def levels(start: Places, adjacent: Places) -> Places:
    """Return stages (n,) for `minimum_degree`: separators by levels come last, the widest cuts."""
