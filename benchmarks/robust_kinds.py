# SPDX-License-Identifier: Apache-2.0
"""The kinds of lies that the false-loop suite knows, by name; imports nothing."""

# Of `l1slam_ros.core.worlds.false_loops.FALSE_LOOPS`.
LIES = ('random', 'identity', 'grouped')
SHARES = (0.1, 0.3, 0.5, 0.7, 0.9)
CLEAN = 'clean'
ONLINE = 'online-'
TENTH, METRES, DEGREES, HEADING = 'tenth', 'slip-translation', 'slip-rotation', 'heading'
# Odometry drawn anew with so many times the noise that it states.
NOISIER = {'odometry-3': 3.0, 'odometry-10': 10.0}
# What else is wrong, the kind of false loops, and which share of all loops they are.
OWN_SHARE = {
    **{f'{TENTH}-{lie}': (TENTH, lie, 0.5) for lie in LIES},
    **{kind: (kind, 'random', 0.3) for kind in (METRES, DEGREES, HEADING, *NOISIER)},
    **{f'{ONLINE}{lie}': ('', lie, 0.3) for lie in LIES},
}
BATCH = (CLEAN, *LIES, *(kind for kind in OWN_SHARE if not kind.startswith(ONLINE)))
KINDS = (*BATCH, *(kind for kind in OWN_SHARE if kind.startswith(ONLINE)))


def shares_of(kind: str, shares: tuple[float, ...]) -> tuple[float, ...]:
    """Return the shares that a kind is measured at."""
    if kind == CLEAN:
        return (0.0,)
    return (OWN_SHARE[kind][2],) if kind in OWN_SHARE else shares
