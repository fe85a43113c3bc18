"""The kernels that compute the tangent stiffness and scatter it into the factor's pattern.

The layout comes from :mod:`limber.mechanics.linear.equations`; the element within its batch of
LANES is the last axis. ``worker/kernels/mechanics/stiffness.cpp`` has the equations.
"""

from limber.kernels import Kernel

LANES = 4
"""Elements per batch: the kernels compute as many at once."""

tangent_stiffness = Kernel(
    "tangent_stiffness", "displacement float64[nodes, 3]", "increment float64[moved, 3]",
    "gradients float64[batches, points, corners, 3, 4]", "weights float64[batches, points, 4]",
    "lame_lambda float64[batches, 4]", "lame_mu float64[batches, 4]",
    "nodes int32[batches, corners, 4]",
    "memory float64[remembered, points, 6, 4]", "slots int32[batches, pairs, 4]",
    "lengths int32[batches, pairs, 4]", "out values float64[values]", "material int",
    "growth float")
"""Add all elements' tangent stiffness [N/m] to the values."""

moduli_stiffness = Kernel(
    "moduli_stiffness", "displacement float64[nodes, 3]",
    "gradients float64[batches, points, corners, 3, 4]", "weights float64[batches, points, 4]",
    "moduli float64[batches, points, 36, 4]", "nodes int32[batches, corners, 4]",
    "slots int32[batches, pairs, 4]", "lengths int32[batches, pairs, 4]",
    "out values float64[values]")
"""Add the integral of B^T C B [N/m] of all elements, for the moduli C [Pa] of any law. Stress needs
no kernel of its own: Hooke's takes that of any law as the corresponding strain. 21 numbers per
point take about five times as long as Hooke's two; a law's own formulas in numpy take longer."""
