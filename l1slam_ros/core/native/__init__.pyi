"""The compiled core; each module lists its functions with shapes and units."""

from . import blocks as blocks
from . import branch_and_bound as branch_and_bound
from . import cholesky as cholesky
from . import dissection as dissection
from . import front as front
from . import halpern as halpern
from . import interior_point as interior_point
from . import likelihood_field as likelihood_field
from . import noise as noise
from . import ordering as ordering
from . import poses as poses
from . import prediction as prediction
from . import ray_casting as ray_casting
from . import scan_matching as scan_matching
from . import scan_points as scan_points
from . import se2 as se2
from . import se3 as se3
from . import spanning_tree as spanning_tree
from . import substitution as substitution
from . import symbolic as symbolic
from . import voxel_grid as voxel_grid

LEVELS: tuple[str, ...]
level: str
