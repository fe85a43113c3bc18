"""Wind, fruit, snow and cuts on a straight beam, against the theory of beams."""

import numpy as np
import pytest

from limber.core.errors import InputError
from limber.geometry.skeleton.skeleton import Skeleton
from limber.mechanics.added_masses import PointMass
from limber.mechanics.loads.outdoor import AIR_DENSITY, LoadedOutdoors, Outdoors
from limber.mechanics.model import BranchModel

YOUNG, SIDE, LENGTH, DENSITY = 5e9, 0.008, 0.6, 800.0
INERTIA = SIDE**4 / 12


@pytest.fixture(scope="module")
def axis() -> Skeleton:
    nodes = np.zeros((41, 3))
    nodes[:, 2] = np.linspace(0, LENGTH, 41)
    return Skeleton.from_edges(nodes, np.arange(-1, 40), np.full(41, SIDE / 2))


@pytest.fixture(scope="module")
def lying(slender_beam) -> BranchModel:
    """A beam that stands out sideways from a wall: gravity is across it."""
    return BranchModel(slender_beam, young=YOUNG, poisson=0.3, density=DENSITY,
                       gravity=(-9.81, 0.0, 0.0)).as_scanned()


def _tip(model, displacement):
    return displacement[model.mesh.nodes[:, 2].argmax()]


def test_wind_bends_by_its_drag(lying, axis):
    """w l^4 / (8 E I) with w = 0.5 rho c d v^2; twice the wind, four times as far."""
    moved = []
    for speed in (2.0, 4.0):
        loaded = LoadedOutdoors(lying, axis, Outdoors(wind=(0.0, speed, 0.0), drag=1.2))
        moved.append(_tip(lying, loaded.rest().require().displacement)[1])
    pressure = 0.5 * AIR_DENSITY * 1.2 * SIDE * 2.0**2
    assert moved[0] == pytest.approx(pressure * LENGTH**4 / (8 * YOUNG * INERTIA), rel=0.02)
    assert moved[1] == pytest.approx(4 * moved[0], rel=0.02)


def test_a_fruit_sags_and_slows_the_branch(lying, axis):
    """m g l^3 / (3 E I); the first frequency falls with the mass."""
    loaded = LoadedOutdoors(lying, axis, Outdoors(fruit=(PointMass((0, 0, LENGTH), 0.01),)))
    bent = loaded.bent(loaded.rest().require())
    sag = -_tip(lying, bent.displacement)[0]
    assert sag == pytest.approx(0.01 * 9.81 * LENGTH**3 / (3 * YOUNG * INERTIA), rel=0.02)
    mass = 0.01 + 0.2427 * DENSITY * SIDE**2 * LENGTH
    expected = np.sqrt(3 * YOUNG * INERTIA / LENGTH**3 / mass) / (2 * np.pi)
    assert bent.frequencies[0] == pytest.approx(expected, rel=0.02)


def test_snow_lies_on_the_shadow(lying, axis):
    """Mass is load times the area seen from above, none on a branch that stands upright."""
    loaded = LoadedOutdoors(lying, axis, Outdoors(snow=10.0))
    assert loaded.added_mass == pytest.approx(10.0 * SIDE * LENGTH)
    upright = lying.with_parameters(gravity=(0.0, 0.0, -9.81)).as_scanned()
    assert LoadedOutdoors(upright, axis, Outdoors(snow=10.0)).added_mass == pytest.approx(0.0)


def test_a_cut_lets_the_rest_rise_and_swing_faster(lying, axis):
    """Half the length is left: it swings four times as fast, and its end rises."""
    loaded = LoadedOutdoors(lying, axis, Outdoors(cuts=((0.0, 0.0, 0.3),)))
    bent = loaded.bent(loaded.rest().require())
    base = 1.8751**2 / (2 * np.pi * 0.3**2) * np.sqrt(YOUNG * SIDE**2 / 12 / DENSITY)
    assert bent.frequencies[0] == pytest.approx(base, rel=0.1)
    assert loaded.cut_mass == pytest.approx(DENSITY * SIDE**2 * 0.3, rel=0.05)
    end = np.linalg.norm(lying.mesh.nodes - [0, 0, 0.29], axis=1).argmin()
    assert bent.displacement[end, 0] > 0
    for place, why in (((0.5, 0.0, 0.3), "500 mm away"), ((0.0, 0.0, -0.5), "500 mm away"),
                       ((0.0, 0.0, 0.0), "at the base")):
        with pytest.raises(InputError, match=why):
            LoadedOutdoors(lying, axis, Outdoors(cuts=(place,)))
