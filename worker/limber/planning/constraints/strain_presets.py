"""How much strain green wood bears: presets for the limit of a branch that nobody has broken.

Modulus of rupture over Young's modulus of green, clear, straight-grained pieces in bending: Wood
Handbook, FPL-GTR-190 (Kretschmann 2010), table 5-3b. That is the strain at rupture if wood stayed
linear; it yields before and bears more, so that the ratio is on the safe side. A branch has knots,
forks and younger wood: half of it is allowed.
"""

_GREEN = {  # modulus of rupture [psi], Young's modulus [million psi]
    "ash": (9500, 1.44), "cherry": (8000, 1.31), "maple": (7700, 1.39), "oak": (8300, 1.35),
    "walnut": (9500, 1.42)}
"""White ash, black cherry, red maple, northern red oak, black walnut."""

SAFETY = 2.0
"""How many times the strain that is allowed the wood is said to bear."""


def strain_limit(wood: str) -> float:
    """Return the largest principal strain that a branch of a wood is allowed.

    Raises:
        KeyError: no such wood.
    """
    rupture, young = _GREEN[wood]
    return rupture / (1e6 * young) / SAFETY
