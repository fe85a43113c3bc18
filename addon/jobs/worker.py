"""Finds the worker: the Python that has `limber`. Nothing here needs Blender."""

import importlib.util
import os
import shutil
import sys
from pathlib import Path


class WorkerNotFound(Exception):
    """There is no Python with Limber's worker; states how to install one."""

    def __init__(self, seen: str):
        super().__init__(
            f"{seen} Limber's worker does all computations. The extension's zip for your system "
            f"and Python {sys.version_info.major}.{sys.version_info.minor} includes the worker, "
            "but this zip does not. Install that zip. Or install the worker in a Python 3.11 or "
            "newer (`pip install PROJECT_FOLDER`, or scripts/setup in a checkout), then choose "
            "that Python in the add-on's preferences or in LIMBER_PYTHON, or put the program "
            "`limber` on the PATH.")


def bundled_command() -> list[str]:
    """Return the command of this Python's own worker, from the extension's wheels or beside a bpy
    package; empty if it has none.
    """
    found = importlib.util.find_spec("limber")
    if found is None or found.origin is None:
        return []
    folder = Path(found.origin).parents[1]
    return [sys.executable, str(Path(__file__).parents[1] / "bundled.py"), str(folder)]


def worker_command(python_path: str = "", bundled: list[str] | None = None) -> list[str]:
    """Return the command that starts `limber`, to be followed by its arguments.

    Args:
        python_path: A Python that the user chose, or empty.
        bundled: Command of the worker of this Python itself, or empty.

    Raises:
        WorkerNotFound: none is set or found on the PATH, or the set one does not exist.
    """
    for chosen, source in ((python_path, "the preferences"),
                           (os.environ.get("LIMBER_PYTHON", ""), "LIMBER_PYTHON")):
        if not chosen:
            continue
        path = Path(chosen).expanduser()
        if not path.is_file():
            raise WorkerNotFound(f"The Python named in {source}, {path}, does not exist.")
        return [str(path), "-m", "limber"]
    if bundled:
        return bundled
    program = shutil.which("limber")
    if program:
        return [program]
    raise WorkerNotFound("No worker was found.")


def worker_environment() -> dict[str, str]:
    """Return the worker's environment: the present one, without Blender's Python settings."""
    environment = dict(os.environ)
    for name in ("PYTHONHOME", "PYTHONPATH", "PYTHONSTARTUP"):
        environment.pop(name, None)
    return environment | {"PYTHONUNBUFFERED": "1", "PYTHONIOENCODING": "utf-8"}
