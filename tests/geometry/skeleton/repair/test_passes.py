"""Each pass of the list mends what it is there for, on the smallest branch that shows it."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from tests.geometry.skeleton.repair.test_fused_forks import two_in_one, two_limbs
from tests.geometry.skeleton.repair.test_fused_limbs import limbs_side_by_side

from limber.geometry.skeleton.confidence import KINK, turns
from limber.geometry.skeleton.radii.axis_fit import AxisFit
from limber.geometry.skeleton.radii.visible_sides import seen_sides
from limber.geometry.skeleton.repair import PASSES, Pass, Repaired
from limber.geometry.skeleton.skeleton import INTERPOLATED, Skeleton

Z, RADIUS, NOISE = 0.005 * np.arange(81), 0.008, 0.0005
ALONG = np.stack([0 * Z, 0 * Z, Z], axis=1)
Mended = Callable[[Repaired], bool]


def _branch(stem: np.ndarray = ALONG, twig: np.ndarray | None = None, at: int = 40,
            radius: np.ndarray | float = RADIUS, thin: float = 0.004) -> Skeleton:
    """A stem, 0.4 m along z, and a twig of its own nodes that hangs on the stem's node ``at``."""
    twig = np.empty((0, 3)) if twig is None else np.array(twig, float)
    count = len(stem)
    parent = np.concatenate([np.arange(count) - 1, [at, *range(count, count + len(twig) - 1)]])
    thick = np.concatenate([np.broadcast_to(radius, count), np.full(len(twig), thin)])
    return Skeleton.from_edges(np.vstack([stem, twig]), parent[:len(thick)], thick)


def _tube(low: float = 0.0, high: float = 0.4, wide: float = np.pi, radius: float = RADIUS,
          noise: float = NOISE) -> np.ndarray:
    """Points around the stem, or on its side that faces x."""
    rng = np.random.default_rng(0)
    angle, z = rng.uniform(-wide, wide, 2000), rng.uniform(low, high, 2000)
    on = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)
    return on + noise * rng.standard_normal(on.shape)


def _before(skeleton: Skeleton, points: np.ndarray | None = None, **found: object) -> Repaired:
    """What a pass gets after a fit that all points lie on."""
    points = _tube() if points is None else points
    nothing = np.empty((0, 3))
    seen = seen_sides(nothing, nothing, *[np.ones(1)] * 2, np.ones(1), np.zeros(1))
    fit = AxisFit(skeleton, np.zeros(len(points), int), np.zeros(len(points)), NOISE, seen)
    return replace(Repaired(skeleton, points, (1e-4, 0.05), fit=fit), **found)


def _hair(part: slice, thin: float = 4e-4) -> Skeleton:
    radius = np.full(81, RADIUS)
    radius[part] = thin
    return _branch(radius=radius)


def _ends(low: float, high: float, reach: float = 0.003) -> Mended:
    """Whether the stem's two ends are within ``reach`` [m] of these heights."""
    return lambda now: bool(np.abs(now.skeleton.nodes[[0, -1], 2] - [low, high]).max() < reach)


def _thick(now: Repaired) -> bool:
    return float(np.abs(now.skeleton.radius / RADIUS - 1).max()) < 0.3


def _centred(now: Repaired) -> bool:
    return float(np.linalg.norm(now.skeleton.nodes[5:-5, :2], axis=1).max()) < 0.0015


def _one_run(now: Repaired) -> bool:
    return now.skeleton.branch_count == 1


def _aside(by: float = 0.004) -> Skeleton:
    return _branch(ALONG + [by, 0, 0])


def _twig(start: float, count: int = 24, reach: float = 0.0) -> np.ndarray:
    """Nodes of a twig at 45 degrees to the stem that leaves its axis at a height ``start``."""
    along = np.arange(reach, reach + 0.003 * count, 0.003)[:count, None]
    return [0, 0, start] + along * np.array([1, 0, 1]) / np.sqrt(2)


def _of_pass(name: str) -> tuple[Repaired, Mended]:
    """A branch with what the pass repairs, and how to tell that it is repaired."""
    strip = _tube(wide=1.2)
    folded = np.vstack([ALONG, [[0.004, 0, 0.398], [0.006, 0, 0.39], [0.007, 0, 0.38]]])
    blank = replace(_hair(slice(20, 40)), radius_state=np.where(
        np.isin(np.arange(81), range(20, 40)), INTERPOLATED, 0).astype(np.int8))
    gap = _tube()[np.abs(_tube()[:, 2] - 0.15) > 0.055]
    cases: dict[str, Callable[[], tuple[Repaired, Mended]]] = {
        "steady radii": lambda: (_before(_hair(slice(20, 40)), gap), _thick),
        "fit coarsely": lambda: (_before(_aside()), _centred),
        "fit unpinched": lambda: (
            _before(_hair(slice(0, 40), 0.001), strip, pinched=_hair(slice(0, 40), 0.001)),
            lambda now: float(np.median(now.skeleton.radius[:20])) > 0.006),
        "attach twigs": lambda: (
            _before(_branch(twig=np.vstack([_twig(0.2, 1, 0.004) - [0, 0, 0.01],
                                            _twig(0.14, reach=0.018)]), at=39)),
            lambda now: abs(now.skeleton.nodes[now.skeleton.forks()[0], 2] - 0.14) < 0.011),
        "drop bare ends": lambda: (_before(_branch(), _tube(0.05, 0.35)), _ends(0.05, 0.35, 0.006)),
        "lengthen ends": lambda: (_before(_branch(ALONG[10:70])), _ends(0.0, 0.392)),
        "prune spurs": lambda: (_before(_branch(twig=_twig(0.2, 4, 0.003))), _one_run),
        "drop duplicate axes": lambda: (_before(_branch(twig=ALONG[42:60] + [0.003, 0, 0])),
                                        _one_run),
        "unpinch radii": lambda: (_before(_hair(slice(0, 40)), strip, pinched=_branch()), _thick),
        "limit radii": lambda: (_before(_branch(radius=0.3)),
                                lambda now: bool((now.skeleton.radius == 0.05).all())),
        "separate fused forks": lambda: (_before(two_in_one(0.2), two_limbs()), lambda now: float(
            now.skeleton.nodes[now.skeleton.forks()[0], 2]) < 0.17),
        "split limbs": lambda: (_before(*limbs_side_by_side()),
                                lambda now: now.skeleton.branch_count == 2),
        "fit finely": lambda: (_before(_aside()), _centred),
        "settle": lambda: (_before(_aside(), duplicates=1), _centred),
        "draw ends back": lambda: (_before(_branch(np.vstack([
            [0, 0, -0.012], ALONG[1:-1], [0, 0, 0.412]]))), _ends(0.0, 0.4)),
        "find the likeliest axes and radii": lambda: (_before(blank, gap), _thick),
        "mend kinks": lambda: (_before(_branch(folded, radius=0.005)), lambda now: bool(
            turns(now.skeleton, now.skeleton.runs()[0]).max() <= KINK)),
    }
    return cases[name]()


@pytest.mark.parametrize("each", dict.fromkeys(PASSES), ids=lambda each: each.name)
def test_each_pass_mends_its_own_case(each: Pass) -> None:
    """What is wrong before is right after."""
    before, mended = _of_pass(each.name)
    assert not mended(before)
    assert mended(each.run(before))


def test_passes_have_names_of_their_own_and_say_what_they_repair() -> None:
    """A name stands for one pass, even where that runs several times; work only goes on."""
    passes = list(dict.fromkeys(PASSES))
    assert len({each.name for each in passes}) == len(passes)
    assert all(each.repairs.endswith(".") for each in passes)
    until = [each.until for each in PASSES if each.until is not None]
    assert until == sorted(until) and until[-1] == 1.0


def test_passes_for_hidden_stems_leave_others_alone() -> None:
    """Where all sides were seen, or leaves, no radius is widened."""
    before = _before(_hair(slice(0, 40)))
    for each in PASSES:
        if each.name in ("fit unpinched", "unpinch radii"):
            assert each.run(before) is before
