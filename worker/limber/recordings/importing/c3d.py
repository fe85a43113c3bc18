"""C3D files of motion capture, read in a separate process."""

from pathlib import Path

import numpy as np

from limber.core.errors import InputError
from limber.recordings.tables import LENGTH_UNITS_M, marker_tracks
from limber.recordings.time_series import Stream


def c3d_arrays(path: Path) -> dict[str, np.ndarray]:
    """Return the markers of a C3D file: ``points`` [3, m, n], rate, unit, labels.

    Read by compiled code, which a corrupt file may crash.
    """
    import ezc3d

    data = ezc3d.c3d(str(path))
    parameters = data["parameters"]["POINT"]
    labels = [str(label) for label in parameters["LABELS"]["value"]]
    unit = (parameters.get("UNITS", {}).get("value") or ["mm"])[0].strip()
    return {"points": np.asarray(data["data"]["points"][:3], float),
            "rate": np.array(float(data["header"]["points"]["frame_rate"])),
            "unit": np.array(unit), "labels": np.array(labels, "U64")}


def markers_of_arrays(path: Path, data: dict[str, np.ndarray], **_request: object,
                      ) -> tuple[Stream, list[str]]:
    """Return marker tracks [m] and labels of arrays from :func:`c3d_arrays`.

    Raises:
        InputError: there are no points, no times, or positions that are not finite.
    """
    points, labels = data["points"], [str(label) for label in data["labels"]]
    if not points.size:
        raise InputError(f"{path} has no points.", "Marker tracks were expected.",
                         "Export the trajectories too.")
    scale = LENGTH_UNITS_M.get(str(data["unit"]).lower(), 1e-3)
    rate = float(data["rate"])
    if not (np.isfinite(rate) and rate > 0) or np.isinf(points).any():
        raise InputError(f"{path} has a rate of {rate:g} frames per second, or positions that are "
                         "not finite.",
                         "A motion needs valid times and positions.", "Export it again.")
    positions = np.moveaxis(points, 0, -1).transpose(1, 0, 2) * scale
    times = np.arange(len(positions)) / rate
    return marker_tracks(times, positions), labels[:positions.shape[1]]
