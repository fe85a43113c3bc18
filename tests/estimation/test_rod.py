"""The rod of virtual pulls: against closed solutions and the tetrahedra."""

from dataclasses import replace

import numpy as np
import pytest

from limber.core.errors import InputError
from limber.estimation.forward.observed_path import MotionWanted
from limber.estimation.rod import Rod
from limber.estimation.settings import PullSpec
from limber.estimation.simulated_pull import simulate_pull
from limber.geometry.skeleton.skeleton import Skeleton

LENGTH, RADIUS, YOUNG, DENSITY = 0.5, 2e-3, 1e9, 900.0
BENDING = YOUNG * np.pi / 4 * RADIUS**4
GRAVITY = np.array([0.0, 0.0, -9.81])
EXACT = PullSpec(position_noise=0.0, force_noise=0.0, torque_noise=0.0, frames=4,
                 duration=6.0, phase=0.5, poisson=0.36)


def straight(twigs=()):
    """Along x; twigs: node of the main path, and offset of the twig's end [m]."""
    nodes = np.zeros((21, 3))
    nodes[:, 0] = np.linspace(0, LENGTH, 21)
    parent, radius = list(range(-1, 20)), [RADIUS] * 21
    for node, offset in twigs:
        nodes = np.vstack([nodes, nodes[node] + offset])
        parent.append(node)
        radius.append(RADIUS)
    return Skeleton.from_edges(nodes, np.array(parent), np.array(radius))


def rod(skeleton=None, gravity=None, *, as_scanned=False, fraction=1.0):
    return Rod.of(skeleton or straight(), lambda points: np.full(len(points), YOUNG), 0.35,
                  DENSITY, np.zeros(3) if gravity is None else gravity, fraction,
                  as_scanned=as_scanned)


def under(weight, made, states=2):
    return made.pulled(MotionWanted(
        kind="weight", point=made.axis[-1], axis=made.axis[-1], travel=0.0, turn=0.0, phase=0.0,
        times=np.linspace(0, 1, states), weight=np.array([0.0, 0.0, -weight])))


@pytest.mark.parametrize(("load", "down", "back"), [
    (0.5, 0.16214358, 0.01591896), (1.0, 0.30172077, 0.05643324)])
def test_it_bends_as_the_elastica(load, down, back):
    """Tip load P L^2 / E I; deflections over the length from elliptic integrals."""
    moved = under(load * BENDING / LENGTH**2, rod(), 4).poses[-1, :3]
    assert -moved[2] / LENGTH == pytest.approx(down, rel=2e-4)
    assert 1 - moved[0] / LENGTH == pytest.approx(back, rel=1e-3)


@pytest.mark.slow
def test_it_sags_under_its_weight_and_hangs_still_as_scanned():
    """A cantilever's q L^4 / 8 E I, for a small sag; a twig adds its weight at its fork."""
    light = GRAVITY / 50
    sag = under(0.0, rod(gravity=light)).poses[-1, 2]
    per_length = DENSITY * np.pi * RADIUS**2 * 9.81 / 50
    assert -sag == pytest.approx(per_length * LENGTH**4 / (8 * BENDING), rel=2e-3)
    twig = straight([(10, (0.0, 0.0, 0.1))])
    more = under(0.0, rod(twig, light)).poses[-1, 2] - sag
    half = LENGTH / 2
    assert -more == pytest.approx(per_length * 0.1 * half**2 / (6 * BENDING) * (3 * LENGTH - half),
                                  rel=5e-3)
    still = under(0.0, rod(twig, GRAVITY, as_scanned=True, fraction=0.9))
    assert still.poses[-1, :3] == pytest.approx([0.9 * LENGTH, 0, 0], abs=1e-6)


@pytest.mark.slow
def test_a_held_pose_needs_the_force_and_torque_that_balance():
    """Held as far as a force bends it, but turned less: the branch resists with a torque."""
    made = rod().pulled(MotionWanted(
        kind="turned", point=np.array([LENGTH, 0, 0]), axis=np.array([1.0, 0, 0]),
        travel=0.2 * LENGTH, turn=0.0, phase=0.0, times=np.linspace(0, 1, 4), weight=np.zeros(3)))
    travel = np.linalg.norm(made.poses[-1, :3] - made.poses[0, :3])
    assert travel == pytest.approx(0.2 * LENGTH, rel=0.05)
    force, torque = made.wrenches[-1, :3], made.wrenches[-1, 3:]
    # The base carries what the gripper does: its moment is that of the root's curvature.
    base = torque + np.cross(made.poses[-1, :3], force)
    step = made.turns[-1, 1] @ made.turns[-1, 0].T
    spacing = LENGTH / (len(made.axis) - 1)
    curvature = np.array([step[2, 1] - step[1, 2], step[0, 2] - step[2, 0],
                          step[1, 0] - step[0, 1]]) / (2 * spacing)
    assert BENDING * curvature == pytest.approx(base, rel=0.01, abs=0.01 * np.linalg.norm(base))
    assert np.linalg.norm(torque) > 0.05 * np.linalg.norm(base)


@pytest.mark.slow
def test_rod_and_tetrahedra_bend_alike_under_a_weight(small):
    """Two models of one branch, a thick one of six sides; the load is the same."""
    truth, settings = small.truth(), EXACT.model_copy(update={"weight": 2.0})
    one, other = (simulate_pull(truth, "pull", settings.model_copy(update={"model": model}))[0]
                  for model in ("rod", "tetrahedra"))
    travel = np.linalg.norm(other.poses[-1, :3] - other.poses[0, :3])
    assert travel > 0.03
    assert np.abs(one.wrenches - other.wrenches).max() < 1e-5
    assert np.abs(one.poses - other.poses)[:, :3].max() < 0.04 * travel
    assert np.abs(one.observations.positions - other.observations.positions).max() < 0.04 * travel


@pytest.mark.parametrize(("chosen", "words"), [
    ({"motion": "dynamic"}, "fast motion"), ({"camera": True}, "--camera")])
def test_what_a_rod_cannot_do_is_refused(small, chosen, words):
    with pytest.raises(InputError, match=words):
        simulate_pull(small.truth(), "pull", EXACT.model_copy(
            update=chosen | {"model": "rod", "gravity": False}))
    with pytest.raises(InputError, match="meshed directly"):
        simulate_pull(replace(small.truth(), is_meshed=True), "pull", EXACT.model_copy(
            update={"model": "rod", "gravity": False}))
