"""Runs the scripts that are asked for in this Blender, one after another; window.py starts it.

FOLDER/case.json names a script and its folder. Each begins with the factory's start-up file.
"""

import json
import sys
from pathlib import Path

import bpy

sys.path.insert(0, str(Path(__file__).parent))
import driving

CASES = driving.FOLDER


def await_case():
    """Begin the case that is asked for, or look again soon."""
    asked = CASES / "case.json"
    if not asked.exists():
        return 0.05
    case = json.loads(asked.read_text())
    asked.unlink()
    bpy.ops.wm.read_homefile(use_factory_startup=True)
    driving.FOLDER = Path(case["folder"])
    driving.seen.clear()
    driving.started.clear()
    driving.seen["error"] = None
    # The window is drawn once before.
    bpy.app.timers.register(lambda: begin(Path(__file__).with_name(case["script"])),
                            first_interval=0.2, persistent=True)
    return None


def begin(script):
    exec(compile(script.read_text(), str(script), "exec"),
         {"__name__": script.stem, "__file__": str(script)})


def wait():
    bpy.app.timers.register(await_case, first_interval=0.05, persistent=True)


driving.leave = wait
wait()
