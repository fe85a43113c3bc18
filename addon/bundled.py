"""Runs the worker that Blender's own Python has, mostly by the extension's wheels.

    python bundled.py FOLDER ARGUMENTS...

FOLDER is where it is: where Blender has unpacked the wheels. What the worker starts finds them too.
"""

import os
import sys

if __name__ == "__main__":
    folder = sys.argv.pop(1)
    os.environ["PYTHONPATH"] = folder
    sys.path[0] = folder
    from limber.cli import run

    run()
