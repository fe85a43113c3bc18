"""Readers of compiled packages in a separate process: on a corrupt file they may abort.

:func:`read_apart` starts ``python -m limber.geometry.io.isolated_readers READER SOURCE TARGET.npz
PARENT``. An abort, a hang or a flood of memory ends only that process.
"""

import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from limber.core.errors import InputError, WorkError
from limber.core.files.reading import read_arrays
from limber.core.optional import loaded
from limber.core.processes.child import run_module
from limber.core.processes.end_with_parent import end_by_kernel
from limber.core.processes.process_limits import Limits

_LEAST_SECONDS, _SECONDS_PER_MB = 8.0, 2.0
_IDLE_SECONDS = 120.0
_LEAST_MB, _MB_PER_MB = 1500.0, 60.0
_REFUSED = 2


def read_apart(reader: Callable[[Path], dict[str, np.ndarray]], path: Path,
               ) -> dict[str, np.ndarray]:
    """Return arrays that a module's function reads from a file or folder in another process.
    InputError if it cannot, or takes far more time or memory than the file's size warrants."""
    parts = Path(path).rglob("*") if Path(path).is_dir() else [Path(path)]
    size_mb = sum(part.stat().st_size for part in parts if part.is_file()) / 1e6
    with tempfile.TemporaryDirectory(prefix="limber-read-") as folder:
        target = Path(folder, "read.npz")
        try:
            code, last = run_module(
                "limber.geometry.io.isolated_readers",
                [f"{reader.__module__}:{reader.__qualname__}", str(Path(path).resolve()),
                 str(target)], "its reader",
                Limits(computed_seconds=_LEAST_SECONDS + _SECONDS_PER_MB * size_mb,
                       idle_seconds=_IDLE_SECONDS, memory_mb=_LEAST_MB + _MB_PER_MB * size_mb))
        except WorkError as error:
            raise InputError(f"{path} cannot be read: {error.seen}", "A file of this size does "
                             f"not need that. {error.why}",
                             "Export it again, or in another format.") from error
        if code == 0 and target.exists():
            return _unpacked(read_arrays(target, "points"))
        trouble = last[:200] or f"the reader ended with code {code}"
        raise InputError(f"{path} cannot be read ({trouble}).",
                         "The file is damaged, truncated, or does not have the format of its "
                         "suffix.", "Export it again.")


def _main(reader: str, source: str, target: str, parent_id: str) -> int:
    end_by_kernel(int(parent_id))
    try:
        arrays = loaded(reader)(Path(source))
    except Exception as error:  # each package raises its own
        print(f"{type(error).__name__}: {error}".replace("\n", " "), file=sys.stderr)
        return _REFUSED
    np.savez(target, *arrays.values(), names=np.array(list(arrays)))
    return 0


def _unpacked(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Arrays by their names, which may be any text, even invalid as a name within a file."""
    names = arrays["names"].tolist()
    return {name: arrays[f"arr_{k}"] for k, name in enumerate(names)}


if __name__ == "__main__":
    sys.exit(_main(*sys.argv[1:]))
