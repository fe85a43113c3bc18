"""How many clicks a new user needs, in a real Blender's window, from its factory start-up."""

import pytest
from tests.addon.window import colour_count, driven, require_screen

pytestmark = [pytest.mark.real_blender, pytest.mark.slow]


def test_four_clicks_to_a_bent_branch(run, blender, environment, tmp_path):
    """The tab, the example, the grab, the press on the branch; the branch bends under the mouse."""
    require_screen()
    seen = driven("drive_clicks.py", blender, environment, tmp_path, (1280, 720))
    assert seen["category"] == "Limber"
    assert seen["bent_m"] > 0.01
    assert seen["clicks_to_bent"] == 4
    for name in ("tab", "example", "bent"):
        assert colour_count(tmp_path / f"{name}.png") > 50
