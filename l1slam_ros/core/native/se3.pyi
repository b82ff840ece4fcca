"""SE(3), one row a factor; see `l1slam_ros.core.geometry.se3`."""

from l1slam_ros.core.geometry.manifold import Array

def retract(pose: Array, step: Array) -> Array:
    """Return pose (rho, exp omega), (n, 7); step (n, 6) [m, rad]."""

def residual(z: Array, x_i: Array, x_j: Array) -> Array:
    """Return (t, 2 q_v) of Z^-1 Xi^-1 Xj, (n, 6) [m, rad]; z, x_i, x_j (n, 7)."""

def jacobians(z: Array, x_i: Array, x_j: Array) -> Array:
    """Return J_r_i and J_r_j, (n, 2, 6, 6)."""

def curvature(z: Array, x_i: Array, x_j: Array, dual: Array) -> Array:
    """Return the rows of turns of the Hessian of dual'e, (n, 2, 3, 12); dual (n, 6)."""
