"""Runs the worker of Blender's own Python, mostly from the extension's wheels.

    python bundled.py FOLDER ARGUMENTS...

FOLDER is where Blender has unpacked the wheels. The worker's child processes find them too. If
Blender's numpy may be too old for them, they bring another one, in a folder that Blender itself
does not search.
"""

import json
import os
import sys


def not_loaded(error: ImportError) -> int:
    """Report that the worker does not load, in its own format; return the exit code."""
    python = f"Python {sys.version_info.major}.{sys.version_info.minor}"
    told = (f"Limber's worker does not load ({error}). Its wheels are incomplete, or are for "
            f"another Blender. Install the extension's zip for this system and {python} again.")
    if "--json" in sys.argv:
        print(json.dumps({"status": "failed", "error": told}), flush=True)
    print(f"error: {told}", file=sys.stderr)
    return 3


if __name__ == "__main__":
    folder = sys.argv.pop(1)
    own_numpy = os.path.join(folder, "limber_numpy")
    searched = [own_numpy, folder] if os.path.isdir(own_numpy) else [folder]
    os.environ["PYTHONPATH"] = os.pathsep.join(searched)
    sys.path[:1] = searched
    try:
        from limber.cli.main import run
    except ImportError as error:
        sys.exit(not_loaded(error))

    sys.exit(run())
