"""The compiled core; each module lists its functions with shapes and units."""

from . import blocks as blocks
from . import cholesky as cholesky
from . import front as front
from . import interior_point as interior_point
from . import noise as noise
from . import ordering as ordering
from . import poses as poses
from . import scans as scans
from . import se2 as se2
from . import se3 as se3
from . import substitution as substitution
from . import symbolic as symbolic

LEVELS: tuple[str, ...]
level: str
