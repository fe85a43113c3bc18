"""The worlds of the bench `scans`: plants, rays, sensors, and what rows say of their outcomes."""

import numpy as np
import pytest

from benchmarks.real_scans import DEGRADED, beyond_ends
from benchmarks.scan_scores import Outcomes
from benchmarks.scans import source_rows
from benchmarks.trials import Trial
from benchmarks.worlds.plants import Plant, pipe_radii
from benchmarks.worlds.sensors import cast
from benchmarks.worlds.sources import SOURCES, WORLDS
from limber.geometry.skeleton.radii.fit_kernels import nearest_cylinders

_GOOD = {"forks": 2, "forks_found": 2, "forks_false": 0, "twig_m": 1.0, "twig_found_m": 0.97,
         "twig_false_m": 0.0, "radius_bias": 0.01, "volume": 0.02, "covered": 0.95,
         "length_held": True, "recall": 0.97, "right": 0.99}


def _outcomes(scores: list[dict], *failed: str) -> Outcomes:
    return Outcomes([*(Trial("cases", ("round", 1), "now", dict(each)) for each in scores),
                     *(Trial("cases", ("round", 2), "now", {}, why) for why in failed)])


def _bar(length: float = 0.5, radius: float = 0.01) -> Plant:
    nodes = np.stack([np.zeros(20), np.zeros(20), np.linspace(0, length, 20)], axis=1)
    return Plant(nodes, np.arange(-1, 19), np.full(20, radius))


@pytest.mark.parametrize("source", SOURCES)
def test_a_source_grows_a_tree_whose_children_are_no_thicker(source: str) -> None:
    """One root, twigs, radii of some millimetres, and another plant from another seed."""
    plant = SOURCES[source](np.random.default_rng(1))
    inner = plant.parent >= 0
    assert (~inner).sum() == 1 and (plant.parent[inner] < np.flatnonzero(inner)).all()
    assert (plant.radius[inner] <= 1.001 * plant.radius[plant.parent[inner]]).all()
    assert 0.001 < plant.radius.min() and plant.radius.max() < 0.03
    assert len(plant.chains()) > 3
    other = SOURCES[source](np.random.default_rng(2))
    assert len(other.nodes) != len(plant.nodes) or not np.allclose(other.nodes, plant.nodes)


def test_pipes_keep_the_sum_of_their_powers() -> None:
    """Da Vinci's rule at a fork of two, and on through an unforked run."""
    radius = pipe_radii(np.array([-1, 0, 1, 1]), 0.003, 2.0)
    assert radius == pytest.approx([0.003 * 2**0.5, 0.003 * 2**0.5, 0.003, 0.003])


def test_skin_and_volume_of_a_bar() -> None:
    """The polygon of the skin has the circle's area; the volume is the cylinder's."""
    bar = _bar()
    assert bar.volume() == pytest.approx(np.pi * 0.01**2 * 0.5, rel=1e-6)
    corners = bar.skin().reshape(-1, 3)
    middle = np.linalg.norm(corners[np.abs(corners[:, 2] - 0.25) < 0.2, :2], axis=1)
    area = 8 * middle.max()**2 * np.sin(2 * np.pi / 16)
    assert area == pytest.approx(np.pi * 0.01**2, rel=1e-6)


def test_a_ray_meets_the_nearest_triangle() -> None:
    """A small square before a large one: its pixels are nearer, and beside it the steps are edges.
    """
    def square(size: float, depth: float) -> np.ndarray:
        a, b, c, d = (np.array([depth, x * size, z * size]) for x, z in (
            (-1, -1), (1, -1), (1, 1), (-1, 1)))
        return np.array([[a, b, c], [a, c, d]])

    hits = cast(np.concatenate([square(1.0, 2.0), square(0.1, 1.0)]), np.zeros(3),
                np.array([1.0, 0.0, 0.0]), 0.0137)
    near = hits.triangle >= 2
    depth = hits.distance * hits.way[:, 0]
    assert depth[near] == pytest.approx(1.0) and depth[~near] == pytest.approx(2.0)
    assert near.sum() == pytest.approx((0.2 / 0.0137)**2, rel=0.1)
    assert hits.incidence == pytest.approx(hits.way[:, 0])
    inner = near & (np.abs(hits.way[:, 1]) < 0.05) & (np.abs(hits.way[:, 2]) < 0.05)
    assert not hits.edge[inner].any() and hits.edge[near].any()


@pytest.mark.parametrize("name", ["dichotomous:one-sided", "monopodial:round"])
def test_points_of_a_case_lie_on_its_truth(name: str) -> None:
    """In the file's frame, within the noise; a case is the same each time."""
    case = WORLDS[name](4)
    _, residual = nearest_cylinders(case.truth, case.points)
    assert np.median(np.abs(residual)) < 0.0015
    assert np.array_equal(WORLDS[name](4).points, case.points)


def test_one_side_of_a_bar_is_seen() -> None:
    """The inverted hull keeps the half of a tube that faces the station."""
    rng = np.random.default_rng(0)
    angle, height = rng.uniform(0, 2 * np.pi, 4000), rng.uniform(0, 0.5, 4000)
    points = np.stack([0.05 * np.cos(angle), 0.05 * np.sin(angle), height], axis=1)
    seen = DEGRADED["one-sided"](points, rng)
    assert 0.3 < len(seen) / len(points) < 0.6
    assert np.linalg.norm(seen[:, :2].mean(axis=0)) > 0.02
    assert DEGRADED["noisy"](points, rng).shape == points.shape


def test_a_row_is_met_only_if_all_of_it_is() -> None:
    """Intervals that hold too little, or one refused case, are not met."""
    def met(scores: list[dict], failed: tuple[str, ...] = ()) -> bool | None:
        row, = source_rows("opposite", "round", _outcomes(scores, *failed))
        assert row.count == len(scores) + len(failed)
        return row.met

    assert met([_GOOD] * 3) is True
    assert met([_GOOD, _GOOD | {"covered": 0.4}]) is False
    assert met([_GOOD] * 3, ("refused",)) is False
    assert met([_GOOD | {"twig_false_m": 0.2}]) is False


def test_only_what_goes_on_beyond_anothers_ends_is_told_apart() -> None:
    """A stem 50 mm longer at its tip and 20 mm at its root counts; a twig beside its end, and a gap
    of the other within the stem, do not."""
    def line(*z: float) -> np.ndarray:
        nodes = np.outer(z, [0, 0, 1.0])
        return np.stack([nodes[:-1], nodes[1:]], axis=1)
    other = line(0, 0.1, 0.2, 0.3)
    twig = np.array([[[0, 0, 0.3], [0.1, 0, 0.3]], [[0, 0, 0.1], [0, 0.1, 0.1]]])
    found = np.vstack([line(-0.02, 0.15, 0.35), twig])
    assert beyond_ends(found, other) == pytest.approx(0.07, abs=0.02)
    assert beyond_ends(line(0, 0.15, 0.3), other) == pytest.approx(0.0, abs=1e-9)
