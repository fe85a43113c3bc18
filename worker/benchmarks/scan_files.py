"""Real scans in the bench `scans`: tubes without points."""

import time
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from benchmarks.scan_scores import Dense
from benchmarks.table import Asked, Row, Setting
from benchmarks.trial_log import go_on, read_trials, source_digest
from limber.core.errors import LimberError
from limber.geometry.cloud.cloud import Cloud
from limber.geometry.io.clouds import read_points
from limber.geometry.reconstruction import Reconstruction, ReconstructSettings, reconstruct_cloud
from limber.geometry.skeleton.skeleton import BRIDGED

DATA = Path(__file__).resolve().parents[2].parent / "shared" / "data"
SCANS = {"coffeetree_branch/branch.xyz": {}, "aRchi_tree_1/Tree_1.ply": {},
         "apple_rgbd/frame_00025.ply": {"unit": "mm", "up": (0.0, -1.0, 0.0)},
         "apple_rgbd/frame_00125.ply": {"unit": "mm", "up": (0.0, -1.0, 0.0)},
         "tomato_maize/tomato_03-05.xyz": {"unit": "mm"},
         "tomato_maize/maize_03-13.ply": {"unit": "mm"},
         "reports/09-puu933-bare-branch/puu_933.xyz": {
             "unit": "mm", "root": (-900.0, 793.0, 2060.0)}}
AS_IT_IS = "as it is"
_LEAFY = {"unexplained": 1.0, "leave_out": True, "leaves": "cut"}


@dataclass
class ScanRun:
    """Result of one real scan; ``failure`` if it was not reconstructed.

    ``source`` (digest of the sources) identifies the code. ``off_points`` is the fraction of
    :func:`off_any_point`.
    """

    scan: str
    source: str
    off_points: float = np.nan
    failure: str = ""
    seconds: float = 0.0


REAL_ROW = Asked("real scans: tube length more than a radius off any point, bridges aside",
                 "under 8 %")


def real_rows(setting: Setting) -> list[Row]:
    """Fraction of tube length more than a radius off any point, bridges excluded."""
    if not DATA.is_dir():
        return [Row(*REAL_ROW, "not measured: no ../shared/data", None, 0)]
    names = [Path(name).stem for name in SCANS]
    names = [names[0], names[2]] if setting.quick else names
    kept, source = setting.kept / "real.jsonl", source_digest(("geometry",), __file__)
    done = go_on(read_trials(ScanRun, kept), names, lambda run: run.scan, partial(
        _run, source=source, out=setting.out), source, kept, setting.budget, None,
        setting.progress)
    failed = [run for run in done if run.failure]
    shares = {run.scan: run.off_points for run in done if not run.failure}
    text = ", ".join(f"{name} {share:.1%}" for name, share in shares.items())
    return [Row(*REAL_ROW, text + "".join(f"; {run.scan}: {run.failure}" for run in failed),
                bool(shares and max(shares.values()) < 0.08 and not failed), len(done))]


def _run(name: str, source: str, out: Path | None) -> ScanRun:
    run, began = ScanRun(name, source), time.perf_counter()
    try:
        made = reconstruct_cloud(*real_scan(name))
    except Exception as error:  # a crash is a failure too
        seen = error.seen if isinstance(error, LimberError) else f"{type(error).__name__}: {error}"
        return replace(run, failure=seen, seconds=time.perf_counter() - began)
    seconds = time.perf_counter() - began
    if out is not None:
        from benchmarks.geometry_pictures import draw_reconstruction

        draw_reconstruction(out / f"{name}.png", made.cloud.points, made.meshed.skeleton,
                            made.meshed.surface, name)
    return replace(run, off_points=off_any_point(made), seconds=seconds)


def real_scan(name: str) -> tuple[Cloud, ReconstructSettings]:
    """A real scan by the stem of its file, and its settings."""
    file = next(file for file in SCANS if Path(file).stem == name)
    return read_points(DATA / file), ReconstructSettings(
        **({"root": "auto"} | _LEAFY | SCANS[file]))


def off_any_point(made: Reconstruction) -> float:
    """Fraction of the axes' length whose surface is more than a radius from all points."""
    skeleton = made.meshed.skeleton
    here = Dense.of(skeleton, step=0.25 * float(np.median(skeleton.radius)))
    distance, _ = cKDTree(made.cloud.points).query(here.points)
    asked = skeleton.radius_state[here.high] != BRIDGED
    return float((distance > 2 * here.radius)[asked].mean())

