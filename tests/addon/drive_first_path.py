"""From an empty scene to a planned path, as a new user goes; test_real_blender.py starts it.

FOLDER has scan.ply. Each step presses what the panel's button presses, and waits for its result.
"""

import sys
from pathlib import Path

import bpy

sys.path.insert(0, str(Path(__file__).parent))
from driving import FOLDER, KEY, clear, drive, is_tab_open, override, picture, seen, waited


def jobs():
    return sys.modules[f"{KEY}.jobs"]


def begin():
    clear()
    return True


def press(operator, **keywords):
    def step():
        if jobs().is_running() or not waited(0.3):
            return False
        with override():
            getattr(bpy.ops.limber, operator)("INVOKE_DEFAULT", **keywords)
        return True
    step.__name__ = operator
    return step


def state(stage):
    """Return how far a stage is, as its panel says."""
    return sys.modules[f"{KEY}.panels.steps"].state_of(bpy.context.scene, stage)[0].name


def done(stage):
    """Wait until a stage is done and its result, if it is seen, has been opened."""
    def step():
        if jobs().is_running() or not waited(1.0):
            return False
        error = jobs().current().error
        if error:
            raise RuntimeError(f"{stage}: {error}")
        seen.setdefault("states", {})[stage] = state(stage)
        return state(stage) == "DONE"
    step.__name__ = f"{stage} done"
    return step


def few_samples():
    """The plan samples the energy first: here as few times as it can."""
    bpy.context.scene.limber.energy.samples = 30
    return True


def is_imported():
    seen["points"] = len(bpy.data.objects["scan scan"].data.vertices) if (
        "scan scan" in bpy.data.objects) else 0
    return seen["points"] > 0


def branch():
    return bpy.data.collections.get("scan")


def is_shown():
    """The branch is there, its path too, and it plays; the scan has made way."""
    if jobs().is_running() or not waited(1.0) or branch() is None:
        return False
    names = [thing.name for thing in branch().objects]
    seen["objects"] = sorted(names)
    seen["scan_hidden"] = bpy.data.objects["scan scan"].hide_viewport
    seen["motion"] = "Limber motion" in branch().objects["scan"].modifiers
    return seen["motion"]


def play():
    bpy.context.scene.frame_set(bpy.context.scene.frame_end)
    return True


drive([begin, is_tab_open, picture("1_empty"),
       press("import_cloud", filepath=str(FOLDER / "scan.ply")), is_imported, picture("2_scan"),
       press("reconstruct"), done("reconstruct"), picture("3_branch"),
       few_samples, press("plan", name="first"), done("plan"), done("energy"), is_shown,
       picture("4_path"),
       play, picture("5_bent")], longest=200)
