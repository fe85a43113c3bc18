"""How much stress wood bears, to tell how near to breaking a bent branch is."""

import numpy as np

STRENGTH_OVER_YOUNG = 0.006
"""Modulus of rupture over Young's modulus of green wood where no strength is known. The Wood
Handbook (Forest Products Laboratory, 2010, table 5-3) has 0.0049 (Douglas fir) to 0.0067 (white
ash) for green wood, 0.006 in the middle."""


def strength_of(young: np.ndarray, strength: float | None = None) -> np.ndarray:
    """Return the stress [Pa] that breaks wood of these moduli [Pa]: ``strength``, or assumed."""
    young = np.asarray(young, float)
    return STRENGTH_OVER_YOUNG * young if strength is None else np.full(young.shape, strength)
