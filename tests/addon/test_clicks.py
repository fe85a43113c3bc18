"""How many clicks a new user needs, in a real Blender's window, from its factory start-up."""

import pytest
from tests.addon.window import colour_count, driven, require_screen

pytestmark = [pytest.mark.real_blender, pytest.mark.slow]


def test_four_clicks_to_a_bent_branch(run, blender, environment, tmp_path):
    """The tab, the example, the grab, the press on the branch; the branch bends under the mouse.
    Then the goal is dragged by its handle: it is the plan's."""
    require_screen()
    seen = driven("drive_clicks.py", blender, environment, tmp_path, (1280, 720))
    assert seen["category"] == "Limber"
    assert seen["bent_m"] > 0.01
    assert seen["clicks_to_bent"] == 4
    assert seen["goal_moved_m"] > 0.01 and seen["goal"] == pytest.approx(seen["ball"])
    for name in ("tab", "example", "bent", "goal"):
        assert colour_count(tmp_path / f"{name}.png") > 50
