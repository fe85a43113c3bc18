"""Equilibria of a rod: elements, a banded factorisation, Newton's iteration.

Sections have positions ``r`` [N + 1, 3] and unit quaternions ``q`` [N + 1, 4] (w first); the first
is clamped. With the middle's rotation R of an element, its rest vector d and its stiffness K,

    e = (R^T (r2 - r1) - d,  log(R1^T R2)),      energy = e . K e / 2 + w . e,

``w`` carries the weight in the scanned shape (Crisfield and Jelenic 1999 for e, which no rigid
motion changes). Unknowns are spatial rotation and displacement, six a section. A ``rod`` is the
tuple of d [N, 3], K [N, 6, 6], w [N, 6], loads [N + 1, 3] and their arms [N + 1, 3].
"""

import numpy as np

from limber.kernels import Kernel

BAND = 12
"""Entries of a row of the lower band: column ``j`` of row ``i`` is at ``11 - (i - j)``."""
_ROD = ("rest float64[elements, 3]", "stiff float64[elements, 6, 6]",
        "carried float64[elements, 6]", "loads float64[sections, 3]", "arms float64[sections, 3]")
_newton = Kernel("rod_newton", "out r float64[sections, 3]", "out q float64[sections, 4]", *_ROD,
                 "asked float64[3]", "held int", returns="int")
_known_at = Kernel(
    "rod_known_at", "r float64[sections, 3]", "q float64[sections, 4]", *_ROD,
    "out force float64[3]", "out stress float64[elements, 6]", "out changes float64[unknowns, 3]",
    "out end_stiffness float64[3, 3]", returns="float")
assembled = Kernel(
    "rod_assembled", "r float64[sections, 3]", "q float64[sections, 4]", *_ROD,
    "out grad float64[unknowns]", "out band float64[unknowns, 12]",
    "out stress float64[elements, 6]", "curved int", returns="float")
"""Return the energy; write its gradient [6 N], lower band [6 N, 12] and stresses [N, 6]."""


def newton(r: np.ndarray, q: np.ndarray, rod: tuple, asked: np.ndarray, held: bool,
           ) -> tuple[bool, bool]:
    """Iterate with the end at the position ``asked`` [3] if ``held``, else under that force;
    whether it converged, and to a stable state."""
    ending = _newton(r, q, *rod, asked, held)
    return ending > 0, ending == 2


def known_at(r: np.ndarray, q: np.ndarray, rod: tuple,
             ) -> tuple[float, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return energy, force on the end [3], stresses [N, 6], changes of the unknowns with the end's
    position [6 N, 3] and the end's stiffness [3, 3]."""
    count = len(r) - 1
    found = np.empty(3), np.empty((count, 6)), np.empty((6 * count, 3)), np.empty((3, 3))
    return _known_at(r, q, *rod, *found), *found
