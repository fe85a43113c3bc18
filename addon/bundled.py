"""Runs the worker that Blender's own Python has, mostly by the extension's wheels.

    python bundled.py FOLDER ARGUMENTS...

FOLDER is where it is: where Blender has unpacked the wheels. What the worker starts finds them too.
Where Blender's numpy may be too old for them, they bring another one, in a folder that Blender
itself does not search.
"""

import os
import sys

if __name__ == "__main__":
    folder = sys.argv.pop(1)
    own_numpy = os.path.join(folder, "limber_numpy")
    searched = [own_numpy, folder] if os.path.isdir(own_numpy) else [folder]
    os.environ["PYTHONPATH"] = os.pathsep.join(searched)
    sys.path[:1] = searched
    from limber.cli.main import run

    run()
