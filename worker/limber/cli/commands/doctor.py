"""Show what is installed, what is missing, and what does not work without it."""

import importlib
import importlib.util
import os
import platform
import shutil
from collections.abc import Mapping
from importlib import metadata
from typing import TYPE_CHECKING, Any

from limber.core.optional import how_to_install
from limber.core.progress import SILENT, Progress
from limber.stages.stage import About, Tool

if TYPE_CHECKING:
    from limber.core.files.caches import Cache

_LEAST_FREE_BYTES = 200e6

# Module, distribution, what does not work without it (None: nothing works), and the extra that
# brings it, if it is optional.
PARTS = [
    ("numpy", "numpy", None, ""),
    ("scipy", "scipy", None, ""),
    ("cvxopt", "cvxopt",
     "fast factorisation; without it SuperLU is used, about 4 times slower", ""),
    ("robust_laplacian", "robust_laplacian", "skeletons of scans", ""),
    ("pytetwild", "pytetwild", "fTetWild meshes; without it the sweep mesher is used", ""),
    ("manifold3d", "manifold3d", "unions of tubes at forks", ""),
    ("ompl", "ompl",
     "OMPL's RRT*; without it our own planner is used (no wheel for Windows)", "planning"),
    ("rtde_control", "ur-rtde", "motion of a UR robot", "robot"),
    ("laspy", "laspy", "LAS and LAZ scans", ""),
    ("pypcd4", "pypcd4", "PCD scans", ""),
    ("ezc3d", "ezc3d", "C3D motion capture", ""),
    ("distributed", "distributed", "work on more than one machine", "cluster"),
    ("websockets", "websockets", "robots behind ROS 2", "ros"),
    ("cv2", "opencv-python-headless", "calibration by pictures", "camera"),
    ("fsspec", "fsspec", "addresses such as s3:// in job files", "remote"),
    ("h5py", "h5py", "MAT files of version 7.3", "matlab"),
    ("rosbags", "rosbags", "MCAP, rosbag2 and ROS 1 bags", "bags"),
    ("mcap", "mcap", "`limber export-pull`", "bags"),
    ("matplotlib", "matplotlib", "`limber report`", "report"),
    ("jinja2", "jinja2", "`limber report`", "report"),
    ("pxr", "usd-core", "`limber export` to USD", "usd"),
    ("bpy", "bpy", "`limber scene` without a real Blender", "blender"),
    ("ultralytics", "ultralytics", "masks by a YOLO model of your own (optional)", ""),
]


def _packages(values: Mapping[str, Any]) -> str:
    missing = values["missing"]
    return "\n".join([
        f"{len(PARTS) - len(missing)} of {len(PARTS)} packages are installed.",
        *(f"{module} is {values['packages'][module]}" for module in missing)])


class Doctor(Tool):
    """Installed and missing packages, and what does not work without them."""

    about = About("doctor", found=("Python {python}, {cores} cores, {system}.", _packages,
                                   "Blender: {blender}"))

    def run(self, progress: Progress = SILENT) -> dict[str, Any]:
        return report()


def report() -> dict[str, Any]:
    """Return what is installed and what is missing."""
    parts = {}
    missing = []
    for module, distribution, cost, extra in PARTS:
        if importlib.util.find_spec(module) is not None:
            parts[module] = _version(distribution)
            continue
        missing.append(module)
        parts[module] = f"missing: {cost or 'nothing works without it'}." + (
            f" {how_to_install(extra)}" if extra else "")
    from limber.core.files.caches import known_caches

    return {
        "caches": {one.name: _cache_summary(one) for one in known_caches()},
        "python": platform.python_version(), "system": platform.platform(),
        "cores": os.cpu_count(), "blender": _blender(), "packages": parts, "missing": missing,
    }


def _cache_summary(cache: "Cache") -> str:
    """Size of a cache and its faults."""
    parts = [f"{cache.file_count} files, {cache.byte_count / 1e6:.0f} MB"]
    if not os.access(cache.folder, os.W_OK):
        parts.append(f"{cache.folder} cannot be written: nothing is kept, every run computes it")
    elif (free := shutil.disk_usage(cache.folder).free) < _LEAST_FREE_BYTES:
        parts.append(f"its disk has {free / 1e6:.0f} MB left (`limber cache --clear` frees some)")
    if cache.empty_count:
        parts.append(f"{cache.empty_count} of them empty, as after a power cut: each is made again "
                     "when needed (`limber cache --clear` removes all)")
    return "; ".join(parts)


def _version(distribution: str) -> str:
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return "present"


def _blender() -> str:
    path = os.environ.get("LIMBER_BLENDER") or shutil.which("blender")
    return path or ("none found (LIMBER_BLENDER or the PATH); scripts/provision_blender installs "
                    "one")
