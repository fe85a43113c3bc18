"""The limits of a plan while the branch is held: shares, colours, and colours that come back."""

from types import SimpleNamespace

import numpy as np
import pytest
from tests.addon.conftest import part


@pytest.fixture()
def limits(worker_here):
    return part("bend.limits")


def test_only_limits_that_are_set_count(bpy, limits):
    """Force 5 of 10 N, strain 3 of 2 %: the most used first; energy has no limit."""
    plan = bpy.context.scene.limber.plan
    frame = SimpleNamespace(force=(3.0, 4.0, 0.0), energy=99.0, strain=0.03)
    assert limits.reached(bpy.context.scene, frame) == []
    plan.use_max_force, plan.max_force = True, 10.0
    plan.use_max_strain, plan.max_strain = True, 0.02
    found = limits.reached(bpy.context.scene, frame)
    assert [(one.title, one.share) for one in found] == [
        ("strain", pytest.approx(1.5)), ("force", pytest.approx(0.5))]
    assert found[0].words == "150 % of the plan's strain"
    assert limits.Reached("force", 31.2).words == "31 times the plan's force"


def test_colours_go_from_green_to_red(limits):
    """Ever less green and more red; at the limit red at once."""
    colours = np.array([limits.colour_of(share) for share in (0.0, 0.35, 0.7, 0.99, 1.0, 5.0)])
    assert (np.diff(colours[:3, 0]) > 0).all() and colours[0, 1] > colours[0, 0]
    np.testing.assert_allclose(colours[2], colours[3])
    assert colours[4, 1] < 0.3 and (colours[4] == colours[5]).all()


@pytest.mark.slow
def test_the_branch_is_red_beyond_a_limit_and_gets_its_colours_back(bpy, limits, beam):
    """Whatever it was coloured by; turning it on or off twice is nothing."""
    bpy.ops.limber.open_result(directory=str(beam.folder))
    branches = part("branch.branches")
    surface = branches.find_surface(bpy.context.scene)
    bpy.ops.limber.color_by(scalar="strain_energy")
    tint, attributes = limits.Tint(surface), surface.data.color_attributes
    for _ in range(2):
        tint.show(True)
        assert attributes.active_color.name == "limber_limit"
        values = part("bridge.meshes").values_of(surface.data, "limber_limit")
        assert (values[:, 0] > 10 * values[:, 1]).all()
    for _ in range(2):
        tint.show(False)
        assert attributes.active_color.name == "strain_energy_color"
        assert "limber_limit" not in attributes


def test_the_frame_rate_is_that_of_the_last_second(addon):
    """Thirty in a second; none a second later."""
    rate = part("bend.frame_rate").FrameRate()
    for number in range(60):
        rate.tick(10.0 + number / 30)
    assert rate.per_second(10.0 + 59 / 30) == 30
    assert rate.per_second(14.0) == 0
