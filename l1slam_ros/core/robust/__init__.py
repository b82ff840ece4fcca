# SPDX-License-Identifier: Apache-2.0
"""
Which factors to rely on: the model, of which the modules here are the inference.

Noise
    What a file states of its noise may be off by a constant, one for odometry and one for loops:
    `gating.noise_variance` finds both from the loops themselves (expectation and maximisation),
    `rounds` measures them again as the map grows. In the last rounds factors may be as noisy as
    they say, so that none is refused for being worse than its like.
A true loop
    measures where its keyframes are, with normal noise. Predicted by the map without it, its
    innovation r has a covariance C from samples of the map (`innovation`), and r'C^-1 r stays
    below the gate for all but one in a thousand.
A lie
    claims anything: its innovation is uniform over as much as the map is wide, with any rotation.
    How many of the loops lie is not assumed: the odds come from the loops (empirical Bayes). A
    loop is accepted where it and all accepted with it lie with a probability of 1% at most.
A place
    is what loops near each other are of, in metres along the way (`places`). Lies of one place
    may be one mistake: together they have one vote, unless the lies that were refused show that
    neighbours hardly ever agree. Votes of several places count, each by itself
    (`pairwise_consistency`).
A slip
    is an odometry factor that says nothing; a gap, or the seam of two sessions, is one whose place
    is known. The sides of it are right in themselves, so the true loops across agree with each
    other. A slip is one explanation of loops that do not fit, lies are the other: `slips` compares
    what each costs, chi2 for factors and a gate for a place.
A part
    is what accepted factors tie together. Parts are joined where loops of two places agree.
A doubt
    is a rival explanation nearly as good as the one that won: `judgement` names it.

In order: `batch` (the whole course, at once or while the map grows), `rounds`, `gating`,
`innovation`, `places`, `pairwise_consistency`, `slips`, `judgement`. No loop is factored before it
is accepted, so none bends what it is judged by.
"""
