"""Real scans beside the project, as they are and degraded, against skeletons of others."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from scipy.spatial import cKDTree

from benchmarks.scan_files import AS_IT_IS, DATA, SCANS
from benchmarks.table import Asked, Row, Setting
from benchmarks.trial_log import go_on, read_trials, source_digest
from benchmarks.worlds import degraded
from benchmarks.worlds.degraded import DEGRADED
from limber.core.constants import UNIT_METRES
from limber.core.errors import LimberError
from limber.geometry.cloud.cloud import Cloud
from limber.geometry.io.clouds import read_points
from limber.geometry.reconstruction import Reconstruction, reconstruct_cloud
from limber.geometry.settings import ReconstructSettings

REAL = Asked("worlds, real scans with independent skeletons: length within its stated interval; "
             "median error; refused though bare", "90 %; 8 %; 0")
WORSE = Asked("worlds, the same degraded (half, one-sided, cut, noisy)", "90 %; 8 %; 0")
BARE = Asked("worlds, bare real scans: points called leaf or flying pixel", "under 1 % each")
_INSIDE = 0.9  # fraction of lengths that their intervals must hold
_CALLED = 0.01  # fraction of a bare scan's points


@dataclass(frozen=True)
class Scan:
    """A real scan.

    Attributes:
        file: Path under the data's folder.
        settings: What its user states.
        bare: Whether it has no leaves.
        reference: Returns another's skeleton as line segments in the scan's coordinates [m], shape
            [k, 2, 3], each from the root outwards; None: there is none.
    """

    file: str
    settings: dict
    bare: bool
    reference: Callable[[], np.ndarray] | None = None


def _graph(name: str) -> np.ndarray:
    lines = [line.split() for line in (DATA / name).read_text().splitlines()]
    nodes = np.array([line[1:4] for line in lines if line[:1] == ["v"]], float) / 1000
    return nodes[np.array([line[1:3] for line in lines if line[:1] == ["e"]], int)]


def _cylinders(name: str) -> np.ndarray:
    rows = np.genfromtxt(DATA / name, delimiter=",", names=True)
    return np.stack([np.stack([rows[end + axis] for axis in "xyz"], axis=1) for end in "se"], 1)


def _tree(name: str) -> np.ndarray:
    with np.load(DATA / name) as tree:
        return np.stack([tree["nodes"][tree["par"][1:]], tree["nodes"][1:]], axis=1) / 1000


def beyond_ends(found: np.ndarray, reference: np.ndarray) -> float:
    """Length [m] of axes that go on beyond the free ends of another's skeleton.

    It lies nearest to such an end, and less to the side of its last segment than along it.

    Args:
        found, reference: Line segments [m], shape [k, 2, 3] each.
    """
    ends, count = np.unique(np.round(reference.reshape(-1, 3), 6), axis=0, return_counts=True)
    free = cKDTree(ends[count == 1])
    share = (np.arange(10) + 0.5)[:, None] / 10
    here, there = (each[:, None, 0] + share * (each[:, None, 1] - each[:, None, 0])
                   for each in (found, reference))
    away, near = cKDTree(there.reshape(-1, 3)).query(here.reshape(-1, 3))
    segment = reference[near // 10]
    step = np.linalg.norm(found[:, 1] - found[:, 0], axis=1) / 10
    out = np.zeros(len(away), bool)
    for end in (0, 1):
        last = free.query(segment[:, end])[0] < 2e-6
        way = segment[:, end] - segment[:, 1 - end]
        way /= np.maximum(np.linalg.norm(way, axis=1), 1e-300)[:, None]
        offset = here.reshape(-1, 3) - segment[:, end]
        along = np.einsum("kj,kj->k", offset, way)
        out |= last & (along > np.sqrt(0.5) * np.linalg.norm(offset, axis=1))
    return float(np.repeat(step, 10)[out].sum())


_PUU = "reports/09-puu933-bare-branch/"
_KEEP = {"leaves": "keep"}  # the others' skeletons go through leaves
REAL_SCANS = {
    "puu": Scan(_PUU + "puu_933.xyz", SCANS[_PUU + "puu_933.xyz"], True,
                partial(_tree, _PUU + "reference_skeleton.npz")),
    "tomato": Scan("tomato_maize/tomato_03-05.xyz", SCANS["tomato_maize/tomato_03-05.xyz"] | _KEEP,
                   False, partial(_graph, "tomato_maize/tomato_03-05.graph.txt")),
    "tree": Scan("aRchi_tree_1/Tree_1.ply", {}, True,
                 partial(_cylinders, "aRchi_tree_1/Tree_1_cylinders_TreeQSM.csv")),
    "coffee": Scan("coffeetree_branch/branch.xyz", {}, True),
    "maize": Scan("tomato_maize/maize_03-13.ply", SCANS["tomato_maize/maize_03-13.ply"] | _KEEP,
                  False, partial(_graph, "tomato_maize/maize_03-13.graph.txt")),
    "apple 25": Scan("apple_rgbd/frame_00025.ply", SCANS["apple_rgbd/frame_00025.ply"], True),
    "apple 125": Scan("apple_rgbd/frame_00125.ply", SCANS["apple_rgbd/frame_00125.ply"], True)}


@dataclass
class RealRun:
    """Result of one scan, as it is or degraded; lengths [m]. ``failure``: why there is none.

    ``beyond_m``: as of :func:`beyond_ends`.
    """

    scan: str
    change: str
    seed: int
    source: str
    length_m: float = np.nan
    interval_m: list[float] = field(default_factory=list)
    reference_m: float | None = None
    beyond_m: float = 0.0
    called_leaf: float = np.nan
    flying: float = np.nan
    failure: str = ""
    seconds: float = 0.0


def real_scan_rows(setting: Setting) -> list[Row]:
    """Rows of real scans; none where the data are absent."""
    present = [name for name, scan in REAL_SCANS.items() if (DATA / scan.file).is_file()]
    tasks = [(name, AS_IT_IS) for name in present]
    if not setting.quick:
        tasks += [(name, change) for change in DEGRADED for name in present
                  if REAL_SCANS[name].reference is not None]
    kept = setting.kept / "worlds_real.jsonl"
    source = source_digest(("geometry",), __file__, degraded.__file__)
    runs = go_on([run for run in read_trials(RealRun, kept) if run.seed == setting.seed], tasks,
                 lambda run: (run.scan, run.change), partial(
                     _run, seed=setting.seed, source=source), source, kept, setting.budget, None,
                 setting.progress)
    plain = [run for run in runs if run.change == AS_IT_IS]
    return [*_length_row(REAL, plain), *_bare_row(plain),
            *_length_row(WORSE, [run for run in runs if run.change != AS_IT_IS])]


def _run(task: tuple[str, str], seed: int, source: str) -> RealRun:
    name, change = task
    scan, run, began = REAL_SCANS[name], RealRun(name, change, seed, source), time.perf_counter()
    cloud = read_points(DATA / scan.file)
    if change != AS_IT_IS:
        rng = np.random.default_rng([seed, *change.encode()])
        cloud = Cloud(DEGRADED[change](cloud.points, rng))
    other = scan.reference() if scan.reference else None
    reference = None if other is None else float(
        np.linalg.norm(other[:, 1] - other[:, 0], axis=1).sum())
    try:
        made = reconstruct_cloud(cloud, ReconstructSettings(
            **({"leave_out": True, "root": "auto"} | scan.settings)))
    except Exception as error:  # a crash is counted as a refusal is
        text = error.seen if isinstance(error, LimberError) else f"{type(error).__name__}: {error}"
        return replace(run, failure=text, reference_m=reference,
                       seconds=time.perf_counter() - began)
    beyond = 0.0 if other is None else beyond_ends(_segments(made, scan), other)
    return replace(run, **_numbers(made), reference_m=reference, beyond_m=beyond,
                   seconds=time.perf_counter() - began)


def _segments(made: Reconstruction, scan: Scan) -> np.ndarray:
    skeleton = made.meshed.skeleton
    nodes = made.alignment.undo(skeleton.nodes) * UNIT_METRES[scan.settings.get("unit", "m")]
    return np.stack([nodes[skeleton.parent[1:]], nodes[1:]], axis=1)


def _numbers(made: Reconstruction) -> dict:
    counts = made.numbers["dropped_points"]
    leaf = made.cloud.attributes.get("leaf", np.zeros(1))
    return {"length_m": made.numbers["length_m"], "interval_m": made.numbers["length_interval_m"],
            "called_leaf": float(np.mean(leaf)),
            "flying": counts.get("flying", 0) / counts["read"]}


def _length_row(asked: Asked, runs: list[RealRun]) -> list[Row]:
    runs = [run for run in runs if run.reference_m is not None]
    done = [run for run in runs if not run.failure]
    if not runs:
        return []
    refused = [run for run in runs if run.failure and REAL_SCANS[run.scan].bare]
    held = [run.interval_m[0] <= run.reference_m <= run.interval_m[1] for run in done]
    off = [run.length_m / run.reference_m - 1 for run in done]
    each = "; ".join(f"{run.scan} {run.change} {100 * error:+.0f} % ({_to_ends(run):+.0f} % up to "
                     f"the other's ends){'' if inside else ' outside'}"
                     for run, error, inside in zip(done, off, held, strict=True))
    share, middle = (float(np.mean(held)), float(np.median(np.abs(off)))) if done else (0.0, np.inf)
    return [Row(*asked, f"{sum(held)} of {len(done)}; {middle:.1%}; {len(refused)}: {each}"
                + "".join(f"; {run.scan} {run.change}: {run.failure}" for run in runs
                          if run.failure),
                bool(share >= _INSIDE and middle <= 0.08 and not refused), len(runs))]


def _to_ends(run: RealRun) -> float:
    return 100 * ((run.length_m - run.beyond_m) / (run.reference_m or np.nan) - 1)


def _bare_row(runs: list[RealRun]) -> list[Row]:
    bare = [run for run in runs if REAL_SCANS[run.scan].bare]
    if not bare:
        return []
    each = "; ".join(f"{run.scan} {run.failure or f'{run.called_leaf:.1%} / {run.flying:.1%}'}"
                     for run in bare)
    good = all(not run.failure and run.called_leaf < _CALLED and run.flying < _CALLED
               for run in bare)
    return [Row(*BARE, each, good, len(bare))]
