"""Sparse scans: branches of 300 to 1,500 points with truth, and real ones beside curated axes.

The source that no constant was fitted on comes first; the search was designed looking at scans of
it, of other seeds. The same scans are changed a little: results must change little, and stated
intervals must overlap.
"""

import resource
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from benchmarks.real_scans import AS_IT_IS, CHANGED, SCANS, WHOLE, Back, present, raw_scan, unmoved
from benchmarks.scan_scores import Dense, cylinder_volume, held, seen_part
from benchmarks.table import Asked, Row, Setting
from benchmarks.trials import Trial, sound
from benchmarks.worlds.sources import BARE_VIEWS, NEW, SOURCES, sparse_case
from limber.core.constants import UNIT_METRES
from limber.geometry.cloud.cloud import Cloud
from limber.geometry.reconstruction import reconstruct_cloud
from limber.geometry.settings import ReconstructSettings
from limber.geometry.skeleton.skeleton import Skeleton

_NEAR = {"sparse": 0.010, "real": 0.015}  # [m] from true, and from curated axes
_LENGTH = 0.10  # of the length: right within this
_FOUND, _HELD, _WIDTH, _SECONDS = 0.92, (0.88, 0.99), 4.0, 2.0
_POINTS = (300, 1500)
_MARGIN = 0.006  # [m]: two standard deviations of the worlds' noise
_SEEDS = {NEW: 8, **dict.fromkeys(SOURCES, 1)}  # of each view
_REAL = ("puu", "puu-670")
_THINNED = tuple(f"{name}, thinned" for name in ("tomato in leaf", "maize in leaf", "coffee"))
_DRAWS = 2  # of the thinned ones
_SCANS = 12  # that are changed
_OFF = {"length_m": (0.05, 0.10), "volume_m3": (0.15, 0.30)}  # after a change, and of half


@dataclass(frozen=True)
class Subject:
    """A scan and what is known of it.

    Attributes:
        cloud: In the file's unit.
        settings: What its user states.
        axes: Points on the true or curated axes [m], a millimetre apart, shape [k, 3], or None.
        length: Of these [m]. volume: Of the wood that is seen [m^3], or None.
        truth: The true axes of what is seen, if they are known.
        root: Where the axes begin [m], shape [3], if that is known.
    """

    cloud: Cloud
    settings: dict[str, Any]
    axes: np.ndarray | None = None
    length: float | None = None
    volume: float | None = None
    truth: Skeleton | None = None
    root: np.ndarray | None = None

    @property
    def near(self) -> float:
        return _NEAR["real" if self.truth is None else "sparse"]

    def off(self, places: np.ndarray, radius: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """By how much radii at places are too large [m], 0 where none is known, and which places
        are near the axes, shape [k] each.
        """
        away, place = cKDTree(self.axes).query(places)
        true = radius if self.truth is None else Dense.of(self.truth).radius[place]
        return radius - true, away < self.near


def subject(name: str, seed: int) -> Subject:
    """Return a scan by name: ``SOURCE:VIEW`` of a world, or a real one, which may be thinned."""
    if ":" in name:
        case = sparse_case(seed, *name.split(":"))
        truth = seen_part(case.truth, case.points[~case.leaf], _MARGIN)
        share = cylinder_volume(truth) / cylinder_volume(case.truth)
        return Subject(Cloud(case.points), case.settings, Dense.of(truth).points, truth.length,
                       share * case.volume, truth, truth.nodes[0])
    real, _, thin = name.partition(", thin")
    cloud, settings = raw_scan(real)
    if thin:
        rng = np.random.default_rng([seed, *real.encode()])
        count = int(np.exp(rng.uniform(*np.log(_POINTS))))
        cloud = Cloud(cloud.points[rng.permutation(len(cloud))[:count]])
    other = (SCANS | WHOLE)[real].reference
    if other is None:
        return Subject(cloud, settings)
    segments = other()
    places, _ = along(segments)
    return Subject(cloud, settings, places, 0.001 * len(places),
                   root=segments[0, 0] if real in _REAL else None)


def along(segments: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points every millimetre of segments [m], shape [k, 2, 3], and how many of each."""
    length = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1)
    count = np.maximum(np.round(length / 0.001).astype(int), 1)
    share = np.concatenate([(np.arange(n) + 0.5) / n for n in count])[:, None]
    low, high = (np.repeat(segments[:, end], count, axis=0) for end in (0, 1))
    return low + share * (high - low), count


# --- changes ----------------------------------------------------------------------------------


def _two_less(cloud: Cloud, settings: dict, rng: np.random.Generator) -> tuple[Cloud, dict, Back]:
    chosen = np.sort(rng.permutation(len(cloud))[2:])
    return Cloud(cloud.points[chosen]), settings, unmoved


def _noisier(cloud: Cloud, settings: dict, rng: np.random.Generator) -> tuple[Cloud, dict, Back]:
    """By half the median distance of a point to its nearest."""
    spacing = float(np.median(cKDTree(cloud.points).query(cloud.points, k=2)[0][:, 1]))
    return Cloud(cloud.points + rng.normal(0, 0.5 * spacing / np.sqrt(3), cloud.points.shape)
                 ), settings, unmoved


PERTURBED: dict[str, Callable[[Cloud, dict, np.random.Generator], tuple[Cloud, dict, Back]]] = {
    "two less": _two_less, "noise": _noisier,
    **{name: CHANGED[name] for name in ("outliers", "half", "shuffle", "turn")}}


# --- trials -----------------------------------------------------------------------------------


def runs(setting: Setting, tasks: Sequence[tuple[str, str, int]]) -> list[Trial]:
    """Trials of scans and changes, as many as there is time for; a crash is a failure too."""
    return setting.trials("sparse scans", tasks, measured, "geometry", workers=None,
                          catch=Exception)


def measured(task: tuple[str, str, int]) -> dict[str, Any]:
    """Reconstruct a scan, as it is or changed: sizes, intervals, processor time, and errors."""
    name, change, seed = task
    known = subject(name, seed)
    cloud, settings = known.cloud, known.settings
    if change != AS_IT_IS:
        cloud, settings, _ = PERTURBED[change](cloud, settings, np.random.default_rng(
            [seed, *change.encode()]))
    _warm()
    began = _processor_seconds()
    made = reconstruct_cloud(cloud, ReconstructSettings(
        **{"leave_out": True, "root": "auto"} | settings))
    numbers = made.numbers
    found = {"cpu_s": _processor_seconds() - began, "points": len(cloud),
             "length_m": numbers["length_m"], "length_interval_m": numbers["length_interval_m"],
             **({"volume_m3": numbers["mesh_volume_m3"],
                 "volume_interval_m3": numbers["volume_interval_m3"]}
                if numbers["mesh_volume_m3"] is not None else {})}
    if change != AS_IT_IS or known.axes is None:
        return found
    skeleton = made.meshed.skeleton
    axes = skeleton.moved(made.alignment.undo(skeleton.nodes)
                          * UNIT_METRES[settings.get("unit", "m")])
    here = Dense.of(axes)
    found |= compared(known, here.points, here.radius)
    if known.truth is None:
        return found
    off, near = known.off(here.points, here.radius)
    inside = (np.abs(off) < 1.96 * axes.radius_sigma[here.high])[near]
    return found | {
        "true_volume_m3": known.volume,
        "radius_held": float(inside.mean()) if len(inside) else 0.0,
        "root_m": float(np.linalg.norm(axes.nodes[0] - known.truth.nodes[0]))}


def compared(known: Subject, places: np.ndarray, radius: np.ndarray) -> dict[str, float]:
    """Fractions found and own, and the median radius error, of axes given as points [m] a
    millimetre apart, shape [k, 3], and radii [m], shape [k].
    """
    off, near = known.off(places, radius)
    found = cKDTree(places).query(known.axes)[0] < known.near
    compared = {"true_length_m": known.length, "found": float(found.mean()),
                "own": float(near.mean())}
    if known.truth is not None:
        compared["radius_bias"] = float(np.nanmedian((off / (radius - off))[near])) if (
            np.isfinite(off[near]).any()) else np.nan
    return compared


@cache
def _warm() -> None:
    """Load the compiled kernels: their time is not that of a scan."""
    case = sparse_case(0, NEW, "round")
    reconstruct_cloud(Cloud(case.points), ReconstructSettings(root="auto", **case.settings))


def _processor_seconds() -> float:
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime


# --- rows -------------------------------------------------------------------------------------

GROUPS = {f"{NEW} (no fit, but looked at)": (NEW,), "the six sources of the worlds": tuple(SOURCES)}


def _axes_asked(name: str, near: float) -> Asked:
    return Asked(f"{name}: axes found / own within {1000 * near:.0f} mm; length within 10 %",
                 f"{_FOUND:.0%} / {_FOUND:.0%}; 80%")


def _held_asked(name: str) -> Asked:
    return Asked(f"{name}: stated intervals hold length, volume, radii; volume's upper over lower, "
                 "median", f"88-99 % each; {_WIDTH:.0f}")


def _time_asked(name: str) -> Asked:
    return Asked(f"{name}: processor time, median / worst", f"{_SECONDS:.0f} s")


SPARSE = tuple(asked(f"sparse, {name}") if asked is not _axes_asked else asked(
    f"sparse, {name}", _NEAR["sparse"]) for name in GROUPS for asked in (
    _axes_asked, _held_asked, _time_asked))
REAL = (_axes_asked("sparse real scans", _NEAR["real"]), _held_asked("sparse real scans"),
        _time_asked("sparse real scans"))
PERTURBATIONS = Asked(f"{_SCANS} sparse scans, two points less, 1 % outliers, noise of half the "
                      "spacing, shuffled, turned; half: change of length; of volume; intervals "
                      "overlap", "5 % (half 10); 15 % (half 30); all")


def world_tasks(setting: Setting) -> list[tuple[str, str, int]]:
    """Sparse scans of worlds."""
    start = 1000 * setting.seed
    return [(f"{source}:{view}", AS_IT_IS, start + k) for source, count in _SEEDS.items()
            for k in range(setting.at_most(count, 1)) for view in BARE_VIEWS]


def real_tasks(setting: Setting) -> list[tuple[str, str, int]]:
    """Real scans that are sparse, or thinned; none without data."""
    start = 1000 * setting.seed
    return [*((name, AS_IT_IS, start) for name in present(_REAL)),
            *((name, AS_IT_IS, start + k) for k in range(setting.at_most(_DRAWS, 1))
              for name in _thinned())]


def sparse_rows(setting: Setting) -> list[Row]:
    """Sparse scans of worlds."""
    done = runs(setting, world_tasks(setting))
    return [row for number, sources in enumerate(GROUPS.values()) for row in _rows(
        SPARSE[3 * number:3 * number + 3],
        [run for run in done if run.task[0].split(":")[0] in sources])]


def real_rows(setting: Setting) -> list[Row]:
    """Real scans that are sparse, or thinned."""
    return _rows(REAL, runs(setting, real_tasks(setting)), told=True)


def _thinned() -> list[str]:
    return [name for name in _THINNED if present((name.partition(", thin")[0],))]


def _rows(asked: Sequence[Asked], trials: list[Trial], told: bool = False) -> list[Row]:
    """Axes, intervals and time of some scans; with what each one gave if ``told``."""
    done = sound(trials)
    failed = [f"{run.task[0]} {run.task[2]}: {_why(run)}" for run in trials if run.failure]
    compared = [run for run in done if "found" in run.values]
    if not compared:
        return [Row(*each, "none reconstructed: " + "; ".join(failed), False, len(trials))
                for each in asked] if trials else []
    found, own = (100 * np.mean([run[key] for run in compared]) for key in ("found", "own"))
    ratio = np.array([run["length_m"] / run["true_length_m"] for run in compared])
    right = float(np.mean(np.abs(ratio - 1) < _LENGTH))
    root = [run["root_m"] for run in compared if "root_m" in run.values]
    texts = [f"; {run.task[0]} {run['points']} points: {100 * run['found']:.0f} / "
             f"{100 * run['own']:.0f}, length {100 * (each - 1):+.0f} %"
             for run, each in zip(compared, ratio, strict=True)] if told else []
    lost = f"; {len(failed)} refused: {'; '.join(failed[:2])}" if failed else ""
    roots = f"; root within 20 mm {np.mean(np.array(root) < 0.02):.0%}" if root else ""
    return [
        Row(*asked[0], f"{found:.0f} / {own:.0f} %; {right:.0%} (ratio {np.median(ratio):.2f}, "
            f"{ratio.min():.2f} to {ratio.max():.2f}){roots}{lost}{''.join(texts)}",
            bool(min(found, own) >= 100 * _FOUND and right >= 0.8 and not failed), len(trials)),
        _held_row(asked[1], compared, done),
        Row(*asked[2], " / ".join(f"{value:.1f} s" for value in (
            np.median([run["cpu_s"] for run in done]), max(run["cpu_s"] for run in done))),
            bool(max(run["cpu_s"] for run in done) <= _SECONDS), len(done))]


def _why(trial: Trial) -> str:
    """The first sentence of a failure."""
    return trial.failure.splitlines()[0].partition(". ")[0]


def _held_row(asked: Asked, compared: list[Trial], done: list[Trial]) -> Row:
    stated = [run for run in done if "volume_m3" in run.values]
    known = [run for run in stated if "true_volume_m3" in run.values]
    length = float(np.mean([held(run["length_interval_m"], run["true_length_m"])
                            for run in compared]))
    width = np.median([run["volume_interval_m3"][1] / max(run["volume_interval_m3"][0], 1e-300)
                       for run in stated]) if stated else np.inf
    shares, text = [length], f"{length:.0%}"
    if known:
        volume = float(np.mean([held(run["volume_interval_m3"], run["true_volume_m3"])
                                for run in known]))
        radius = float(np.mean([run["radius_held"] for run in known]))
        ratio = np.array([run["volume_m3"] / run["true_volume_m3"] for run in known])
        shares += [volume, radius]
        text += (f", {volume:.0%}, {radius:.0%} (volume ratio {np.median(ratio):.2f}, "
                 f"{ratio.min():.2f} to {ratio.max():.2f})")
    told = "-" if not stated else "over 1,000" if width > 1000 else f"{width:.1f}"
    return Row(*asked, f"{text}; {told}; {len(done) - len(stated)} of {len(done)} state no volume",
               bool(min(shares) >= _HELD[0] and width <= _WIDTH), len(compared))


def perturbation_rows(setting: Setting) -> list[Row]:
    """The same scans, changed: by how much lengths and volumes change, and whether intervals meet.
    """
    start = 1000 * setting.seed
    chosen = [(name, start) for name in [*present(_REAL), *_thinned()]]
    worlds = [(f"{source}:{BARE_VIEWS[(k + number) % 2]}", start + k) for k in range(4)
              for number, source in enumerate([NEW, *SOURCES] if k % 2 else [NEW])]
    chosen = (chosen + worlds)[:setting.at_most(_SCANS, 2)]
    done = runs(setting, [(name, change, seed) for name, seed in chosen
                          for change in (AS_IT_IS, *PERTURBED)])
    first = {(run.task[0], run.task[2]): run for run in sound(done) if run.task[1] == AS_IT_IS}
    failed = [f"{run.task[0]} {run.task[1]}: {_why(run)}" for run in done if run.failure]
    pairs = [(run, first[run.task[0], run.task[2]]) for run in sound(done)
             if run.task[1] != AS_IT_IS and (run.task[0], run.task[2]) in first]
    if not pairs:
        return []
    texts, good = [], not failed
    for key, limits in _OFF.items():
        for is_half in (False, True):
            off = np.array([abs(run[key] / other[key] - 1) for run, other in pairs
                            if (run.task[1] == "half") == is_half
                            and key in run.values and key in other.values])
            if len(off):
                good &= bool(off.max() <= limits[is_half])
                texts.append(f"{'half ' if is_half else ''}{key.partition('_')[0]}: median "
                             f"{np.median(off):.1%}, worst {off.max():.0%}, "
                             f"{int((off <= limits[is_half]).sum())} of {len(off)} within")
    apart = [f"{run.task[0]} {run.task[1]} ({key.partition('_')[0]})" for run, other in pairs
             for key in ("length_interval_m", "volume_interval_m3")
             if key in run.values and key in other.values
             and max(run[key][0], other[key][0]) > min(run[key][1], other[key][1])]
    one_only = sum(("volume_m3" in run.values) != ("volume_m3" in other.values)
                   for run, other in pairs)
    return [Row(*PERTURBATIONS, "; ".join([
        *texts, f"{len(apart)} of {2 * len(pairs)} intervals do not overlap{': ' if apart else ''}"
        + ", ".join(apart), f"{one_only} of {len(pairs)} state a volume in one of both only",
        *failed]), good and not apart and not one_only, len(pairs))]
