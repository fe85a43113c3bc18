"""Readers of compiled packages in a process of their own: on a mangled file they may abort.

``python -m limber.geometry.io.isolated_readers KIND SOURCE TARGET.npz PARENT`` is what
:func:`read_apart` starts. An abort, a hang or a flood of memory ends that process alone.
"""

import importlib
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from limber.core.errors import InputError, WorkError
from limber.core.files.reading import read_arrays
from limber.core.processes.child_module import run_module
from limber.core.processes.ending import end_by_kernel
from limber.core.processes.limits import Limits

_LEAST_SECONDS, _SECONDS_PER_MB = 8.0, 2.0
_LEAST_MB, _MB_PER_MB = 1500.0, 60.0
_REFUSED = 2

LAS_POINTS = "\0points"
"""Name of a LAS file's coordinates among its dimensions."""


def read_apart(kind: str, path: Path) -> dict[str, np.ndarray]:
    """Return what a reader of ``kind`` finds in a file or folder, as arrays.

    Args:
        kind: One of :data:`KINDS`, or ``module:function`` of Limber.

    Raises:
        InputError: it cannot be read, or takes far more time or memory than its size warrants.
    """
    parts = Path(path).rglob("*") if Path(path).is_dir() else [Path(path)]
    size_mb = sum(part.stat().st_size for part in parts if part.is_file()) / 1e6
    with tempfile.TemporaryDirectory(prefix="limber-read-") as folder:
        target = Path(folder, "read.npz")
        try:
            code, last = run_module(
                __name__, [kind, str(Path(path).resolve()), str(target)], "its reader",
                Limits(_LEAST_SECONDS + _SECONDS_PER_MB * size_mb,
                       _LEAST_MB + _MB_PER_MB * size_mb))
        except WorkError as error:
            trouble = error.seen.rstrip(".")
        else:
            if code == 0 and target.exists():
                return _unpacked(read_arrays(target, "points"))
            trouble = last[:200] or f"it ended with code {code}"
        raise InputError(f"{path} cannot be read ({trouble}).",
                         "It is damaged, cut short, or not what its suffix says.",
                         "Export it again.")


def las_arrays(path: Path) -> dict[str, np.ndarray]:
    """Return coordinates, ``color`` and the other dimensions of a LAS or LAZ file.

    The coordinates are under :data:`LAS_POINTS`, which no dimension can be called.
    """
    import laspy

    content = laspy.read(path)
    attributes = {}
    names = set(content.point_format.dimension_names)
    if {"red", "green", "blue"} <= names:
        color = np.stack([np.asarray(content[c]) for c in ("red", "green", "blue")], axis=1)
        # 16 bits a channel by the standard, though many programs write 8.
        attributes["color"] = color // 257 if color.max(initial=0) > 255 else color
    for name in sorted(names - {"X", "Y", "Z", "red", "green", "blue"}):
        values = np.asarray(content[name])
        if values.ndim == 1 and values.any():
            attributes[name] = values
    return {**attributes, LAS_POINTS: np.asarray(content.xyz, np.float64)}


def _c3d_arrays(path: Path) -> dict[str, np.ndarray]:
    """Return what a C3D file tells of its markers: ``points`` [3, m, n], rate, unit, labels."""
    import ezc3d

    data = ezc3d.c3d(str(path))
    told = data["parameters"]["POINT"]
    labels = [str(label) for label in told["LABELS"]["value"]]
    unit = (told.get("UNITS", {}).get("value") or ["mm"])[0].strip()
    return {"points": np.asarray(data["data"]["points"][:3], float),
            "rate": np.array(float(data["header"]["points"]["frame_rate"])),
            "unit": np.array(unit), "labels": np.array(labels, "U64")}


KINDS: dict[str, Callable[[Path], dict[str, np.ndarray]]] = {"las": las_arrays, "c3d": _c3d_arrays}
"""Name to reader."""


def _main(kind: str, source: str, target: str, parent_id: str) -> int:
    end_by_kernel(int(parent_id))
    try:
        module, _, name = kind.partition(":")
        reader = getattr(importlib.import_module(module), name) if name else KINDS[kind]
        arrays = reader(Path(source))
    except Exception as error:  # each package raises its own
        print(f"{type(error).__name__}: {error}".replace("\n", " "), file=sys.stderr)
        return _REFUSED
    np.savez(target, *arrays.values(), names=np.array(list(arrays)))
    return 0


def _unpacked(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Arrays by their names, which are any text, and would not all do as names within a file."""
    names = arrays["names"].tolist()
    return {name: arrays[f"arr_{k}"] for k, name in enumerate(names)}


if __name__ == "__main__":
    sys.exit(_main(*sys.argv[1:]))
