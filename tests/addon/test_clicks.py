"""How many clicks a new user needs, in a real Blender's window, from its factory start-up."""

import os
from pathlib import Path

import pytest
from tests.addon.window import colour_count, driven, require_screen

from limber.geometry.generated import generate_branch

pytestmark = [pytest.mark.real_blender, pytest.mark.slow]


@pytest.mark.parametrize("size", [
    (1280, 720), pytest.param((1600, 900), marks=pytest.mark.campaign)])
def test_four_clicks_to_a_bent_branch(run, blender, environment, tmp_path, size):
    """The tab, the example, the grab, the press on the branch; the branch bends under the mouse.
    Then the goal is dragged by its handle: it is the plan's."""
    require_screen()
    environment = environment | {"XDG_CACHE_HOME": str(tmp_path / "caches")}
    seen = driven("drive_clicks.py", blender, environment, tmp_path, size)
    assert seen["answer_s"] < 10.0
    assert seen["category"] == "Limber"
    assert seen["bent_m"] > 0.01
    assert seen["clicks_to_bent"] == 4
    assert seen["goal_moved_m"] > 0.01 and seen["goal"] == pytest.approx(seen["ball"])
    for name in ("tab", "example", "bent", "goal"):
        assert colour_count(tmp_path / f"{name}.png") > 50


def test_an_own_scan_to_a_planned_path(run, blender, environment, tmp_path):
    """The tab, import, the file and its confirmation, the branch, its grasp dragged to a goal, the
    plan. The goal is where it was dragged to.

    Planning takes minutes, so the last click is made only where LIMBER_TEST_FIRST_PATH is set."""
    require_screen()
    home, is_planned = tmp_path / "home", bool(os.environ.get("LIMBER_TEST_FIRST_PATH"))
    home.mkdir()
    if is_planned:
        (tmp_path / "plan").touch()
    scan = generate_branch(5, length=0.4, fork_count=0, point_spacing=0.004).cloud
    scan.write_ply(home / "scan.ply")
    caches = environment.get("XDG_CACHE_HOME", str(Path.home() / ".cache"))
    seen = driven("drive_own_scan.py", blender,
                  environment | {"HOME": str(home), "XDG_CACHE_HOME": caches}, tmp_path,
                  (1280, 720), seconds=500)
    assert seen["clicks"] == 6 + is_planned
    assert seen["points"] == len(scan.points)
    assert seen["scan_beside_branch_m"] < 0.01, "the scan lies on the branch made of it"
    assert seen["file"] == "scan.ply" and seen["goal_from_grasp_m"] > 0.03
    assert seen["goal"] == pytest.approx(seen["ball"], abs=1e-6)
    for name in ("browser", "chosen", "scan", "branch", "goal"):
        assert colour_count(tmp_path / f"{name}.png") > 50
    if is_planned:
        assert seen["state"] == "DONE" and seen["paths"]
        assert colour_count(tmp_path / "path.png") > 50
