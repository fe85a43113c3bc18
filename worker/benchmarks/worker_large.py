"""Very large and very small scans, and scans in very many pieces: memory and processor time."""

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from benchmarks.table import Asked, Row, Setting
from limber.core.errors import LimberError
from limber.geometry.cloud import preparation
from limber.geometry.cloud.cloud import Cloud
from limber.geometry.reconstruction import reconstruct_cloud
from limber.geometry.settings import ReconstructSettings

_LIMITS = {15_000: (3.0, None), 100_000: (8.0, None), 1_000_000: (45.0, None),
           5_000_000: (150.0, 2.5), 50_000_000: (900.0, 4.0)}
"""Points: processor time [s], and peak memory [GB] if required."""
_QUICK = 1_000_000  # points
_LENGTH, _OFF = 1.29, 0.03  # of the branch [m], and what a result may be off
_PIECES, _PIECES_SECONDS = 2000, 20.0
_AT_ONCE = 1_000_000
_RUN = """
import json, resource, sys
from limber.geometry.warm_up import warm_up
from limber.stages.shape.reconstruct import reconstruct
warm_up()
before = resource.getrusage(resource.RUSAGE_SELF)
result = reconstruct(sys.argv[1], sys.argv[2])
after = resource.getrusage(resource.RUSAGE_SELF)
print(json.dumps({"seconds": after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime,
                  "peak_gb": after.ru_maxrss / 1e6, "length_m": result["length_m"]}))
"""


def _size_asked(count: int) -> Asked:
    seconds, memory = _LIMITS[count]
    return Asked(f"a branch of {count:,} points: processor time" + (
        ", peak memory" if memory else ""), f"{seconds:.0f} s" + (
            f", {memory:g} GB" if memory else ""))


SMALL_ROW = Asked("branches of 60 to 250 points, bare and one-sided: neither a result nor a reason",
                  "0")
PIECES_ROW = Asked(f"{_PIECES:,} pieces without order: processor time",
                   f"{_PIECES_SECONDS:.0f} s")
LARGE_ROWS = (SMALL_ROW, *map(_size_asked, _LIMITS), PIECES_ROW)


def large(setting: Setting) -> list[Row]:
    """Small scans, then larger and larger ones, as far as time allows."""
    found = [_small(setting)]
    counts = [count for count in _LIMITS if not setting.quick or count <= _QUICK]
    for count in setting.budget.items(counts):
        found.append(_sized(count, setting.seed))
    if setting.budget.remaining > 2 * _PIECES_SECONDS:
        found.append(_in_pieces(setting))
    return found


def branch(count: int, rng: np.random.Generator) -> np.ndarray:
    """Points [m] of a 1 m branch with a side branch of 0.29 m, in 0.3 mm of noise: [count, 3]."""
    along, angle = rng.random(count), 2 * np.pi * rng.random(count)
    radius = 0.01 * (1 - 0.5 * along)
    points = np.stack([0.05 * along**2 + np.cos(angle) * radius, np.sin(angle) * radius, along],
                      axis=1)
    x, y, z = points[:count // 4].T
    points[:count // 4] = np.stack([0.25 * z + 0.0125, 0.5 * y, 0.5 + 0.5 * x + 0.15 * z], axis=1)
    return points + rng.normal(scale=3e-4, size=points.shape)


def _small(setting: Setting) -> Row:
    bad, total = [], 0
    for seed in setting.seeds(10, 2):
        rng = np.random.default_rng(seed)
        for count in (60, 100, 150, 250):
            whole = branch(3 * count, rng)
            for points in (whole[::3], whole[whole[:, 1] > 0][:count]):
                total += 1
                try:
                    reconstruct_cloud(Cloud(points), ReconstructSettings())
                except LimberError:
                    continue
                except Exception as error:  # whatever it is: that is what is counted
                    bad.append(f"{count} points, seed {seed}: {type(error).__name__}")
    return Row(*SMALL_ROW, "; ".join([str(len(bad)), *bad[:3]]), not bad, total)


def _sized(count: int, seed: int) -> Row:
    with tempfile.TemporaryDirectory(prefix="limber-bench-") as place:
        scan = Path(place, "branch.ply")
        _write(scan, count, np.random.default_rng(seed))
        run = subprocess.run([sys.executable, "-c", _RUN, scan, Path(place, "a.branch")],
                             capture_output=True, text=True, check=True)
    told: dict[str, Any] = json.loads(run.stdout.splitlines()[-1])
    seconds, memory = _LIMITS[count]
    is_met = told["seconds"] <= seconds and (memory is None or told["peak_gb"] <= memory)
    is_right = abs(told["length_m"] - _LENGTH) < _OFF
    return Row(*_size_asked(count), f"{told['seconds']:.1f} s, {told['peak_gb']:.2f} GB, length "
               f"{told['length_m']:.3f} m for {_LENGTH} m", is_met and is_right)


def _write(path: Path, count: int, rng: np.random.Generator) -> None:
    """A binary PLY file, piece by piece: the bench itself holds no large scan."""
    with open(path, "wb") as stream:
        stream.write((f"ply\nformat binary_little_endian 1.0\nelement vertex {count}\n"
                      + "".join(f"property float {axis}\n" for axis in "xyz")
                      + "end_header\n").encode())
        for start in range(0, count, _AT_ONCE):
            stream.write(branch(min(_AT_ONCE, count - start), rng).astype("<f4").tobytes())


def _in_pieces(setting: Setting) -> Row:
    """Clumps of six points strewn in a box: not a tree, which must be reported in time."""
    rng = setting.generator(1)
    centres = rng.uniform(-0.5, 0.5, (_PIECES, 1, 3))
    points = (centres + rng.normal(scale=1e-3, size=(_PIECES, 6, 3))).reshape(-1, 3)
    began = time.process_time()
    try:
        # The clumps are far apart, but no stray points.
        with mock.patch.object(preparation, "_OUTLIER_RATIO", np.inf):
            reconstruct_cloud(Cloud(points), ReconstructSettings(leaves="keep"))
        told = "a skeleton"
    except LimberError as error:
        told = f"refused: {error.seen}"
    seconds = time.process_time() - began
    return Row(*PIECES_ROW, f"{seconds:.1f} s; {told}", seconds <= _PIECES_SECONDS)
