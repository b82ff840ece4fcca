"""SE(2), one row a factor; see `l1slam_ros.core.geometry.se2`."""

from l1slam_ros.core.geometry.manifold import Array

def retract(pose: Array, step: Array) -> Array:
    """Return pose v2t(step), (n, 3); step (n, 3) [m, m, rad]."""

def residual(z: Array, x_i: Array, x_j: Array) -> Array:
    """Return t2v(Z^-1 Xi^-1 Xj), (n, 3) [m, m, rad]; z, x_i, x_j (n, 3)."""

def jacobians(z: Array, x_i: Array, x_j: Array) -> Array:
    """Return J_r_i and J_r_j, (n, 2, 3, 3)."""

def curvature(z: Array, x_i: Array, x_j: Array, dual: Array) -> Array:
    """Return the rows of turns of the Hessian of dual'e, (n, 2, 1, 6); dual (n, 3)."""
