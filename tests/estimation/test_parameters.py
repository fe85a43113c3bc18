"""The free vector."""

import numpy as np
import pytest

from limber.estimation.parameters import ParameterSpace, Values

VALUES = Values(np.array([1e7, 2e7, 3e7, 4e7]), 0.33, 800.0, (0.5, 0.002))


def test_pack_and_unpack_undo_each_other():
    """All kinds of parameters come back; what is not free keeps its value."""
    space = ParameterSpace.separate(VALUES, ("poisson", "density", "alpha", "beta"))
    again = space.unpack(space.pack(VALUES))
    assert np.allclose(again.young, VALUES.young)
    assert (again.poisson, again.density) == pytest.approx((0.33, 800.0))
    assert again.damping == pytest.approx((0.5, 0.002))
    fixed = ParameterSpace.separate(VALUES).unpack(np.log([1e6, 1e6, 1e6, 1e6]))
    assert fixed.poisson == 0.33 and fixed.damping == (0.5, 0.002)


def test_ties_share_one_modulus():
    """Members of a group get one value, the geometric mean at the start; names say so."""
    space = ParameterSpace(VALUES, (0, 1, 1, 2))
    assert space.groups == (0, 1, 1, 2) and space.size == 3
    assert space.names == ["E1", "E2=E3", "E4"]
    young = space.unpack(space.pack(VALUES)).young
    assert young[1] == young[2] == pytest.approx(np.sqrt(2e7 * 3e7))


def test_bounds_are_named():
    """A modulus at its bound is named."""
    space = ParameterSpace.separate(VALUES)
    free = space.pack(VALUES)
    assert space.on_bound(free) == []
    free[2] = space.bounds()[1][2]
    assert space.on_bound(free) == ["E3"]
