"""A slowly drawn view loses its anti-aliasing for the time of a grab, a fast one does not."""


import pytest
from tests.addon.conftest import part


@pytest.fixture()
def view(bpy, addon):
    module = part("bend.lighter_view")
    bpy.context.preferences.system.viewport_aa = "8"
    bpy.context.preferences.is_dirty = False
    return module.LighterView(bpy.context.preferences)


def draw(view, seconds, count=20):
    for number in range(count):
        view.shown(now=float(number))
        view.turned(now=number + seconds)
        view.turned(now=number + 0.9)


def test_a_slow_view_is_lightened_and_restored(bpy, view):
    """The user's setting is back at the end, and is not saved as if it had been changed."""
    system = bpy.context.preferences.system
    draw(view, 0.2)
    assert view.is_on and system.viewport_aa == "OFF"
    view.end()
    view.end()
    assert not view.is_on and system.viewport_aa == "8"
    assert not bpy.context.preferences.is_dirty


def test_a_fast_view_stays(bpy, view):
    """Also with a few slow frames, as at the first drawing."""
    draw(view, 0.2, count=3)
    draw(view, 0.02)
    assert not view.is_on and bpy.context.preferences.system.viewport_aa == "8"
