"""Convergence rate in element size, on the bench's manufactured solution."""

import numpy as np
import pytest

from benchmarks.mechanics_exact import _exact_potential, _manufactured_potential


@pytest.mark.slow
def test_energy_converges_at_fourth_order():
    """The total potential's error falls by nearly 16 as the elements are halved."""
    exact = _exact_potential()
    errors = [_manufactured_potential(n) - exact for n in (2, 4, 8)]
    rates = np.log2(np.divide(errors[:-1], errors[1:]))
    assert rates[1] == pytest.approx(4.0, abs=0.3)
    assert rates[1] > rates[0]
