"""Finds the worker: the Python that has `limber`. Nothing here needs Blender."""

import os
import shutil
from pathlib import Path


class WorkerNotFound(Exception):
    """There is no Python with Limber's worker; says how to bring one."""

    def __init__(self, seen: str):
        super().__init__(
            f"{seen} Everything is computed by Limber's worker, which this extension does not "
            "bring along yet. Install it (a Python 3.11 or newer: `pip install PROJECT_FOLDER`, or "
            "scripts/setup in a checkout), then name that Python in the add-on's preferences or "
            "in LIMBER_PYTHON, or put the program `limber` on the PATH.")


def worker_command(python_path: str = "", fallback: str = "") -> list[str]:
    """Return how to start `limber`, to be followed by its arguments.

    Args:
        python_path: A Python that the user chose, or nothing.
        fallback: A Python to try last: that of the bpy package.

    Raises:
        WorkerNotFound: none is set, found on the PATH, or the one that is set does not exist.
    """
    for chosen, source in ((python_path, "the preferences"),
                           (os.environ.get("LIMBER_PYTHON", ""), "LIMBER_PYTHON")):
        if not chosen:
            continue
        path = Path(chosen).expanduser()
        if not path.is_file():
            raise WorkerNotFound(f"The Python named in {source}, {path}, does not exist.")
        return [str(path), "-m", "limber"]
    program = shutil.which("limber")
    if program:
        return [program]
    if fallback:
        return [fallback, "-m", "limber"]
    raise WorkerNotFound("No worker was found.")


def worker_environment() -> dict[str, str]:
    """Return the environment for the worker: ours, less what would bend its Python to Blender's."""
    environment = dict(os.environ)
    for name in ("PYTHONHOME", "PYTHONPATH", "PYTHONSTARTUP"):
        environment.pop(name, None)
    return environment | {"PYTHONUNBUFFERED": "1", "PYTHONIOENCODING": "utf-8"}
