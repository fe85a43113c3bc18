"""A folder of scans: each becomes a branch folder, and a bad one does not stop the others."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from limber.errors import Cancelled, InputError, LimberError, WorkError
from limber.geometry.cloud.files import READERS
from limber.geometry.reconstruct import ReconstructSettings, reconstruct
from limber.progress import SILENT, Progress


def reconstruct_folder(clouds: Path, folder: Path, settings: ReconstructSettings | None = None, *,
                       force: bool = False, progress: Progress = SILENT,
                       warn: Callable[[str], None] = lambda text: None) -> dict[str, Any]:
    """Reconstruct every cloud in a folder into ``folder/NAME.branch``.

    Args:
        clouds: The folder of scans; files of other kinds in it are passed over.
        folder: Where the branch folders go.
        settings: For all of them.
        force: Run even where nothing has changed.
        progress: Called as it goes.
        warn: Gets each scan's warnings, with its name, and each failure.

    Returns:
        ``done`` and ``failed``: name to result, name to message.

    Raises:
        InputError: there is no scan.
        WorkError: all of them failed.
    """
    paths = sorted(p for p in Path(clouds).iterdir() if p.suffix.lower() in READERS)
    if not paths:
        raise InputError(f"{clouds} has no point clouds.",
                         f"Known are: {' '.join(sorted(READERS))}.", "Name another folder.")
    done: dict[str, Any] = {}
    failed: dict[str, str] = {}
    for number, path in enumerate(paths):
        part = progress.part(number / len(paths), (number + 1) / len(paths))
        try:
            done[path.name] = reconstruct(
                path, Path(folder) / f"{path.stem}.branch", settings, force=force, progress=part,
                warn=lambda text, name=path.name: warn(f"{name}: {text}"))
        except Cancelled:
            raise
        except LimberError as error:
            failed[path.name] = str(error)
            warn(f"{path.name}: {error}")
    if not done:
        raise WorkError(f"None of the {len(paths)} scans could be reconstructed.",
                        next(iter(failed.values())), "See the warnings for each.")
    return {"done": done, "failed": failed, "done_count": len(done), "failed_count": len(failed)}
