"""The bordered front: see `l1slam_ros.core.bordered.front` and `front.hpp`."""

from l1slam_ros.core.geometry.manifold import Array, Indices

def begin(
    l1: Array, l2: Array, fixed: int, usual: float, mu: float, of_odometry: float,
    of_loops: float, longest: int, *factors: object
) -> Front:
    """
    Return the front of a map.

    l1, l2 : (n, p) its poses in the L1 and in the L2 map [m, rad], not to be written to; fixed :
    so many are held; usual : noise of a first factor in the L1 map, mu : where weights turn over;
    of_odometry, of_loops : noise in the L2 map, in units of what they state; longest : keyframes
    on the path to the root of the elimination tree up to which L^-1 e_p is kept; factors :
    `BlockCholesky.factor` of both maps, one after the other
    """

def hang(parent: Indices, turn: Array, shift: Array, steps: Array) -> None:
    """
    Write the steps of new keyframes, the last of all (n, k): x = turn x_parent + shift.

    parent : (b,) before each, below 0: none; turn (b, k, k); shift (b, k)
    """

class Front:
    """Two maps, 0: L1, 1: L2, and what has come since; keyframes are numbered as in the graph."""

    def keyframes(self) -> int:
        """Return how many keyframes there are."""

    def rows(self) -> int:
        """Return how many rows the factors of the border have."""

    def points(self) -> int:
        """Return how many keyframes factors of the border name in the L2 map, or are new."""

    def append_keyframe(self, i: int, j: int, z: Array, root: Array) -> bool:
        """
        Append the next keyframe where the first factor says that sees it; False: it does not say.

        i, j : keyframes, -1 for the world, one is the next; z (p,), root (k, k) : of the factor
        """

    def predict(self, i: int, j: int, z: Array, root: Array) -> tuple[float, float, float]:
        """
        Return NIS, log likelihood and sigmas of a factor between keyframes there are.

        All in the L2 map, NaN: beyond double precision. The log likelihood is without
        -k/2 ln(2 pi), minus infinity where z leaves a component unsaid; sigmas : the square root
        of what the NIS is once the factor is part of the map
        """

    def append(self) -> bool:
        """Append the factor predicted last to both maps; False: beyond double precision."""

    def refuse(self) -> None:
        """Forget the factor predicted last."""

    def poses(self, map: int, keyframes: Indices) -> Array:
        """Return the poses of some keyframes in a map, (m, p) [m, rad]."""

    def covariance(self, keyframe: int, other: int, turn: Array) -> Array:
        """Return the covariance of x_keyframe - turn x_other, -1: none, in the L2 map, (k, k)."""

    def moment(self, map: int) -> tuple[Indices, Array, Indices, Array, Array, Array]:
        """
        Return what a map is now, which later factors do not change.

        The keyframes of H, without those held, that the border pulls at, (o,); A'lambda at them,
        (o, k); of the new keyframes parent (b,), turn (b, k, k) and shift (b, k), see `hang`, and
        where they were put first, (b, p).
        """
