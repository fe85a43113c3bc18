"""Natural frequencies against the theory of beams."""

import numpy as np
import pytest

from limber.mechanics.dynamics.motion import lowest_modes
from limber.mechanics.model import BranchModel


def test_a_cantilevers_lowest_frequencies(slender_beam):
    """Euler-Bernoulli: (1.8751)^2 and (4.6941)^2 over 2 pi l^2, times sqrt(E I / (rho A))."""
    young, density, side, length = 1e9, 800.0, 0.008, 0.6
    model = BranchModel(slender_beam, young=young, poisson=0.3, density=density, gravity=None)
    modes = lowest_modes(model, 3)
    base = np.sqrt(young * side**2 / 12 / density) / (2 * np.pi * length**2)
    assert modes.frequencies[0] == pytest.approx(1.8751**2 * base, rel=0.01)
    assert modes.frequencies[2] == pytest.approx(4.6941**2 * base, rel=0.01)
    modal = np.einsum("kni,kni->k", modes.shapes,
                      np.array([model.mass_times(shape) for shape in modes.shapes]))
    np.testing.assert_allclose(modal, 1.0, rtol=1e-6)
