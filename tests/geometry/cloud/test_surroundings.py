"""Pots, stakes, posts and wires are found by their shape, and named; no plant is one."""

import numpy as np
import pytest
from tests.subjects.leafy import curved_leaves

from limber.core.errors import InputError
from limber.geometry.cloud.cloud import Cloud
from limber.geometry.cloud.preparation import PreparationSettings, Prepared, prepare
from limber.geometry.cloud.surroundings import (
    find_ground,
    find_supports,
    named_if_refused,
    supports_text,
)
from limber.geometry.generated import generate_branch
from limber.geometry.leaf_removal import without_leaves
from limber.geometry.reconstruction import COLOURS
from limber.geometry.settings import OPEN

UP = np.array([0.0, 0.0, 1.0])


def _rod(radius: float, top: float, tip: float | None = None, bend: float = 0.0,
         at: tuple[float, float] = (0.0, 0.0), count: int = 4000) -> np.ndarray:
    """Points of a rod from the ground, which thins to ``tip`` and bends by ``bend`` [m]."""
    rng = np.random.default_rng(0)
    angle, z = rng.uniform(0, 2 * np.pi, count), rng.uniform(0, top, count)
    thick = radius + ((radius if tip is None else tip) - radius) * z / top
    points = np.stack([at[0] + thick * np.cos(angle) + bend * (z / top)**2,
                       at[1] + thick * np.sin(angle), z], axis=1)
    return points + 0.0003 * rng.standard_normal(points.shape)


def _wire(long: float, sag: float, tip: float = 0.0015, bend: float = 0.0,
          count: int = 1500) -> np.ndarray:
    """Points of a wire along x at a height of 0.5 m, which thins to ``tip`` and bends aside."""
    rng = np.random.default_rng(1)
    angle, t = rng.uniform(0, 2 * np.pi, count), rng.uniform(0, 1, count)
    thick = 0.0015 + (tip - 0.0015) * t
    points = np.stack([long * (t - 0.5), 0.05 + bend * t**2 + thick * np.cos(angle),
                       0.5 - 4 * sag * t * (1 - t) + thick * np.sin(angle)], axis=1)
    return points + 0.0003 * rng.standard_normal(points.shape)


@pytest.mark.filterwarnings("error")
def test_two_stakes_and_nothing_else_are_two_stakes() -> None:
    """No point is left to search for wires, and nothing warns of that."""
    found = find_supports(np.vstack([_rod(0.006, 0.4), _rod(0.006, 0.4, at=(0.3, 0.0))]), UP)
    assert [each.kind for each in found] == ["stake", "stake"]


@pytest.mark.slow
def test_pot_and_stake_of_a_potted_plant_are_named() -> None:
    """With nearly all of their points and few of the plant's, and the pot's side is no leaf; the
    plant without them has none."""
    stem, soil = _rod(0.01, 1.0, tip=0.004, bend=0.1), _rod(0.08, 1e-6, tip=0.0, count=1500)
    scan = np.vstack([stem, soil, _rod(0.08, 0.1, tip=0.096) - [0, 0, 0.08],
                      _rod(0.006, 0.7, at=(0.04, 0))])
    found = find_supports(scan, UP)
    assert {each.kind for each in found if each.probability >= OPEN} == {"pot", "stake"}
    named = np.concatenate([each.points for each in found])
    assert (named >= len(stem)).mean() > 0.9 and len(named) > 0.9 * (len(scan) - len(stem))
    prepared = Prepared(Cloud(scan), np.zeros(3))
    assert without_leaves(prepared)[1] and not without_leaves(prepared, supports=found)[1]
    assert find_supports(stem, UP) == []


def test_an_even_stem_that_carries_all_leaves_is_no_stake() -> None:
    """It is as straight and as even as one; but nothing else leads down from what it carries."""
    assert find_supports(curved_leaves(21_000)[0], UP) == []


@pytest.mark.slow
def test_a_stake_is_straight_and_even_and_a_stem_is_not() -> None:
    """A rod beside a stem is a stake, one of 30 mm radius a post; a tapered or bent rod is wood."""
    stem = _rod(0.01, 1.0, tip=0.004, bend=0.1)
    for thick, kind in ((0.006, "stake"), (0.03, "post")):
        scan = np.vstack([stem, _rod(thick, 0.8, at=(0.0, 0.15))])
        found = find_supports(scan, UP)
        assert [each.kind for each in found] == [kind]
        assert (found[0].points >= len(stem)).mean() > 0.95
    for wood in (_rod(0.006, 0.8, tip=0.003, at=(0.0, 0.15)),
                 _rod(0.006, 0.8, bend=0.15, at=(0.0, 0.15))):
        assert find_supports(np.vstack([stem, wood]), UP) == []


@pytest.mark.slow
@pytest.mark.parametrize("sag", [0.0, 0.04])
def test_a_wire_hangs_from_border_to_border_or_from_its_posts(sag: float) -> None:
    """Straight or sagging; one that thins, bends, sags up or ends in the air is likelier wood."""
    stem = _rod(0.01, 1.0, tip=0.004, bend=0.1)
    scan = np.vstack([stem, _wire(1.2, sag)])
    found = find_supports(scan, UP)
    assert [each.kind for each in found] == ["wire"]
    assert (found[0].points >= len(stem)).mean() > 0.95 and len(found[0].points) > 1400
    posts = [_rod(0.03, 0.9, at=(x, 0.05)) for x in (-0.6, 0.6)]
    beyond = [_rod(0.004, 0.9, tip=0.002, bend=0.1, at=(x, 0.1)) for x in (-0.8, 0.8)]
    found = find_supports(np.vstack([stem, *posts, *beyond, _wire(1.2, sag)]), UP)
    assert sorted(each.kind for each in found) == ["post", "post", "wire"]
    assert {"post", "wire"} < COLOURS.keys()
    for wood in ([_wire(1.2, sag, tip=0.0004)], [_wire(1.2, sag, bend=0.1)],
                 [_wire(1.2, -0.04)], [_wire(0.5, sag), *beyond]):
        assert all(each.probability < 0.5 for each in find_supports(np.vstack([stem, *wood]), UP))


@pytest.mark.slow
def test_supports_of_a_dense_scan_have_all_of_their_points() -> None:
    """More points than are looked at: the others follow the nearest of these."""
    scan = np.vstack([_rod(0.01, 1.0, tip=0.004, bend=0.1, count=160_000),
                      _rod(0.006, 0.8, at=(0.0, 0.15), count=60_000)])
    found = find_supports(scan, UP)
    assert [each.kind for each in found] == ["stake"]
    assert len(found[0].points) == pytest.approx(60_000, rel=0.02)


def test_a_refusal_names_the_supports() -> None:
    """Kind, share and place; other refusals stay as they are."""
    scan = np.vstack([_rod(0.01, 1.0, tip=0.004, bend=0.1), _rod(0.006, 0.8, at=(0.0, 0.15))])
    text = supports_text(find_supports(scan, UP), scan).moved(lambda place: 1000 * np.array(place))
    assert "a stake (50 % of the points) at (" in text and "--crop" in text
    for added in (text, ""):
        with pytest.raises(InputError) as caught, named_if_refused(added):
            raise InputError("Too flat.", "Wood is round.", "Crop it.")
        assert str(caught.value) == " ".join(
            part for part in ("Too flat.", added, "Wood is round.", "Crop it.") if part)


# Ground, rough and on a slope, is cut out of a scan; what has no ground loses nothing.


def scene(slope: float, bump: float, size: float = 0.9) -> tuple[np.ndarray, np.ndarray]:
    """Points of a plant on ground, and which are ground's."""
    rng = np.random.default_rng(4)
    plant = generate_branch(7, length=0.6, fork_count=3, point_spacing=0.004).cloud.points
    flat = rng.uniform(-size / 2, size / 2, (9000, 2))
    waves = rng.normal(0, 12.0, (8, 2))
    height = bump * np.sin(flat @ waves.T + rng.uniform(0, 6, 8)).mean(axis=1) * 2
    height += np.tan(np.deg2rad(slope)) * flat[:, 0] + rng.normal(0, 0.2 * bump + 1e-3, len(flat))
    ground = np.column_stack([flat, height + 0.005])
    return np.vstack([plant, ground]), np.arange(len(plant) + 9000) >= len(plant)


@pytest.mark.parametrize(("slope", "bump"), [(0, 0.0), (0, 0.015), (20, 0.015), (30, 0.005)])
def test_rough_ground_on_a_slope_goes_and_the_plant_stays(slope: float, bump: float) -> None:
    """Over 97 % of the ground, and of the plant nothing but its foot."""
    points, truth = scene(slope, bump)
    found = find_ground(points, UP)
    assert found.log_odds > 0 and np.isin(np.flatnonzero(truth), found.points).mean() > 0.97
    foot = points[:, 2] < 0.08
    assert not (~truth & ~foot)[found.points].any()
    prepared = prepare(Cloud(points), 1.0, PreparationSettings(), up=UP)
    cut = prepared.counts.get("ground", 0) + prepared.counts.get("sheets", 0)
    assert 0.95 * truth.sum() < cut < truth.sum() + foot[~truth].sum()
    assert any("were removed" in text for text in prepared.warnings)


def test_plants_without_ground_lose_nothing() -> None:
    """A branch, a bush of many, and a wide flat crown have none."""
    rng = np.random.default_rng(0)
    one = generate_branch(7, length=0.6, fork_count=5, point_spacing=0.004).cloud.points
    bush = np.vstack([one @ np.linalg.qr(rng.normal(size=(3, 3)))[0].T for _ in range(6)])
    crown = rng.uniform([-0.5, -0.5, 0.3], [0.5, 0.5, 0.6], (20_000, 3))
    for points in (one, bush, np.vstack([one, crown])):
        assert find_ground(points, UP).probability < 1 - OPEN
