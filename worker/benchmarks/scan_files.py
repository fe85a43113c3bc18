"""Real scans in the bench `scans`: the same tree gives the same result; tubes without points."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from benchmarks.scan_cases import one_sided_case, round_case
from benchmarks.scan_scores import Dense
from benchmarks.table import Row
from limber.errors import LimberError
from limber.geometry.cloud.cloud import Cloud
from limber.geometry.cloud.files import read_points
from limber.geometry.reconstruct import Reconstruction, ReconstructSettings, reconstruct_cloud
from limber.geometry.skeleton.skeleton import BRIDGED
from limber.progress import Progress

DATA = Path(__file__).resolve().parents[2].parent / "shared" / "data"
SCANS = {"coffeetree_branch/branch.xyz": {}, "aRchi_tree_1/Tree_1.ply": {},
         "apple_rgbd/frame_00025.ply": {"unit": "mm", "up": (0.0, -1.0, 0.0)},
         "apple_rgbd/frame_00125.ply": {"unit": "mm", "up": (0.0, -1.0, 0.0)},
         "tomato_maize/tomato_03-05.xyz": {"unit": "mm"},
         "tomato_maize/maize_03-13.ply": {"unit": "mm"}}
_LEAFY = {"unexplained": 1.0, "leave_out": True}


def changes(cloud: Cloud, settings: dict, seed: int) -> dict[str, tuple[Cloud, dict]]:
    """The same scan in another unit, moved, turned about its up, shuffled, and half of it."""
    rng = np.random.default_rng(seed)
    points = cloud.points
    unit = settings.get("unit", "m")
    other, factor = ("mm", 1000.0) if unit == "m" else ("m", 0.001)
    up = np.array(settings.get("up", (0.0, 0.0, 1.0)))
    angle = rng.uniform(0, 2 * np.pi)
    cross = np.array([[0, -up[2], up[1]], [up[2], 0, -up[0]], [-up[1], up[0], 0]])
    turn = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    shift = rng.uniform(-5, 5, 3) * float(np.ptp(points, axis=0).max())
    order = rng.permutation(len(points))
    return {"unit": (Cloud(points * factor), settings | {"unit": other}),
            "shift": (Cloud(points + shift), settings),
            "turn": (Cloud(points @ turn.T), settings),
            "shuffle": (Cloud(points[order]), settings),
            "half": (Cloud(points[np.sort(order[:len(points) // 2])]), settings)}


def metamorphic_rows(quick: bool, seed: int, progress: Progress) -> list[Row]:
    """Length and volume of each changed scan against the scan itself."""
    subjects = {"round": (Cloud(round_case(seed).points), {}),
                "one-sided": (Cloud(one_sided_case(seed + 1).points), {})}
    if DATA.is_dir():
        for name in list(SCANS)[:1] if quick else SCANS:
            subjects[Path(name).stem] = (read_points(DATA / name), dict(SCANS[name]))
    worst, crashes, notes = 0.0, [], []
    half = 0.0
    for number, (name, (cloud, settings)) in enumerate(subjects.items()):
        try:
            first = _made(cloud, settings)
        except LimberError as error:
            crashes.append(f"{name}: {error.seen}")
            continue
        for change, (changed, other) in changes(cloud, settings, seed).items():
            try:
                made = _made(changed, other)
            except Exception as error:
                crashes.append(f"{name}, {change}: {error}")
                continue
            off = max(abs(made.numbers[key] / first.numbers[key] - 1)
                      for key in ("length_m", "mesh_volume_m3"))
            if change == "half":
                half = max(half, off)
            else:
                worst = max(worst, off)
            if off > (0.10 if change == "half" else 0.03):
                notes.append(f"{name} {change} {off:.0%}")
        progress((number + 1) / len(subjects), "same tree", scan=name)
    return [Row(f"{len(subjects)} scans in another unit, shifted, turned, shuffled; halved: length "
                "and volume", "3 %; 10 %; no crash",
                f"worst {worst:.1%}; {half:.1%}; {len(crashes)} crashes"
                + "".join(f"; {text}" for text in (notes + crashes)[:8]),
                worst < 0.03 and half < 0.10 and not crashes)]


def real_rows(quick: bool, progress: Progress, out: Path | None) -> list[Row]:
    """Share of tube length more than a radius off any point, bridges aside."""
    if not DATA.is_dir():
        return [Row("real scans", "all", "not measured: no ../shared/data", None)]
    shares, failed = {}, []
    for number, (name, settings) in enumerate(SCANS.items()):
        if quick and number not in (0, 2):
            continue
        try:
            made = _made(read_points(DATA / name), settings)
        except LimberError as error:
            failed.append(f"{Path(name).stem}: {error.seen}")
            continue
        shares[Path(name).stem] = off_any_point(made)
        if out is not None:
            from benchmarks.geometry_pictures import draw_reconstruction

            draw_reconstruction(out / f"{Path(name).stem}.png", made.cloud.points,
                                made.meshed.skeleton, made.meshed.surface, Path(name).stem)
        progress((number + 1) / len(SCANS), Path(name).stem)
    text = ", ".join(f"{name} {share:.0%}" for name, share in shares.items())
    return [Row("real scans: tube length more than a radius off any point, bridges aside",
                "under 8 %", text + "".join(f"; refused: {one}" for one in failed),
                bool(shares and max(shares.values()) < 0.08))]


def off_any_point(made: Reconstruction) -> float:
    """Share of the axes' length whose surface is more than a radius from all points."""
    skeleton = made.meshed.skeleton
    here = Dense.of(skeleton, step=0.25 * float(np.median(skeleton.radius)))
    distance, _ = cKDTree(made.cloud.points).query(here.points)
    asked = skeleton.radius_state[here.high] != BRIDGED
    return float((distance > 2 * here.radius)[asked].mean())


def _made(cloud: Cloud, settings: dict) -> Reconstruction:
    return reconstruct_cloud(replace(cloud), ReconstructSettings(**(_LEAFY | settings)))
