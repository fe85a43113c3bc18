"""Leaves are told from stems by shape, cut off, and hang on the stems as mass."""

import json
import re
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.scan_cases import leafy_case
from limber.core.errors import InputError
from limber.core.progress import Progress
from limber.geometry.cloud.cloud import Cloud
from limber.geometry.cloud.leaves import Leaf, find_leaves
from limber.geometry.cloud.preparation import Prepared, prepare
from limber.geometry.cloud.surroundings import Part
from limber.geometry.generated import generate_branch
from limber.geometry.io.clouds import read_cloud
from limber.geometry.leaf_removal import _on_round_axes, check_agreed, show_leaves, without_leaves
from limber.geometry.reconstruction import (
    COLOURS,
    _most_off,
    reconstruct_cloud,
    shown_if_refused,
)
from limber.geometry.settings import ReconstructSettings
from limber.geometry.skeleton.skeletonise import skeletonise
from limber.stages.shape.edit_skeleton import ReviewSkeleton
from limber.stages.shape.reconstruct import Reconstruct
from limber.store import Branch
from limber.store.loading import load_point_masses

LONG, WIDE = 0.07, 0.02


def _leaf(foot: np.ndarray, way: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A drooping blade, bent along and across, of noisy points 1.4 mm apart."""
    way = way / np.linalg.norm(way)
    across = np.cross(way, [0.0, 0.3, 1.0])
    across /= np.linalg.norm(across)
    u, v = rng.uniform(0, 1, 2200), rng.uniform(-1, 1, 2200)
    inside = np.abs(v) < np.sin(np.pi * u)
    u, v = u[inside, None], v[inside, None]
    blade = (foot + LONG * u * way + WIDE * v * across
             - (0.3 * LONG * u**2 - 0.1 * WIDE * v**2) * np.cross(across, way))
    return blade + rng.normal(0, 3e-4, blade.shape)


@pytest.fixture(scope="module")
def seedling():
    """Stems of 2 to 4 mm radius with a leaf at each tip; which points are leaf; area of leaves."""
    rng = np.random.default_rng(11)
    branch = generate_branch(31, length=0.3, radius_root=0.004, radius_tip=0.002, bend=0.4,
                             fork_count=2, noise=3e-4, point_spacing=0.0017, occlusion=0.05)
    stems = branch.skeleton
    leaves = [_leaf(stems.nodes[tip], stems.nodes[tip] - stems.nodes[stems.parent[tip]], rng)
              for tip in stems.tips()]
    points = np.vstack([branch.cloud.points, *leaves])
    on_leaf = np.arange(len(points)) >= len(branch.cloud)
    return branch, points, on_leaf, len(leaves) * LONG * WIDE * 4 / np.pi


def test_leaves_are_told_from_stems(seedling) -> None:
    """Nearly all of the leaves, of the stems little but at their feet; number and area."""
    branch, points, on_leaf, area = seedling
    leaves = find_leaves(points)
    found = np.zeros(len(points), bool)
    for leaf in leaves:
        found[leaf.points] = True
    assert found[on_leaf].mean() > 0.97 and found[~on_leaf].mean() < 0.2
    assert len(branch.skeleton.tips()) <= len(leaves) <= len(branch.skeleton.tips()) + 2
    assert sum(leaf.area for leaf in leaves) == pytest.approx(area, rel=0.3)


@pytest.mark.slow
def test_leaves_are_the_same_however_the_file_is_sorted_and_turned(seedling) -> None:
    """Shuffled, turned and moved: the same points lie on leaves."""
    _, points, _, _ = seedling
    rng = np.random.default_rng(8)
    order = rng.permutation(len(points))
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    first, again = (np.isin(np.arange(len(points)), np.concatenate(
        [leaf.points for leaf in find_leaves(some)]))
        for some in (points, (points @ turn.T + [3.0, -2.0, 7.0])[order]))
    assert np.mean(again != first[order]) < 1e-3


@pytest.mark.slow
def test_a_leafy_plant_is_its_stems_with_the_leaves_mass(seedling, tmp_path) -> None:
    """Stems found, none in leaves; leaves weigh on the model, also after edits."""
    branch, points, on_leaf, area = seedling
    scan, folder = tmp_path / "scan.ply", tmp_path / "a.branch"
    Cloud(points).write_ply(scan)
    result = Reconstruct(cloud=scan, output=folder, leave_out=True, leaves="cut").run()
    assert result["length_m"] == pytest.approx(branch.skeleton.length, rel=0.15)
    assert any("leaves" in text and "detected and removed" in text for text in result["warnings"])
    assert result["leaf_mass_kg"] == pytest.approx(0.2 * area, rel=0.3)
    opened = Branch.open(folder)
    cloud = read_cloud(opened.path("cloud.ply"))
    assert len(cloud) == result["point_count"] > 0.95 * len(points)
    assert cloud.attributes["leaf"].mean() == pytest.approx(on_leaf.mean(), abs=0.1)
    hung = sum(mass.mass for mass in load_point_masses(opened))
    assert hung == pytest.approx(result["leaf_mass_kg"] + result["left_out_mass_kg"])
    edits = tmp_path / "edits.json"
    edits.write_text("[]")
    ReviewSkeleton(branch_folder=folder, edits=edits).run()
    again = json.loads((folder / "point_masses.json").read_text())
    assert sum(mass["mass_kg"] for mass in again if mass.get("kind") == "leaf") == (
        pytest.approx(result["leaf_mass_kg"]))


@pytest.mark.slow
def test_leaves_are_not_cut_off_unasked(seedling, tmp_path) -> None:
    """Over a tenth of the points: refused, with the share and a place in the file's coordinates."""
    _, points, on_leaf, _ = seedling
    scan = tmp_path / "scan.ply"
    moved = 1000 * points + [700.0, -300.0, 2000.0]
    Cloud(moved).write_ply(scan)
    with pytest.raises(InputError, match=r"--leaves cut.*--leaves keep") as refused:
        Reconstruct(cloud=scan, output=tmp_path / "a.branch", unit="mm").run()
    share, *place = re.search(
        r"^(\d+) % of the points.*? at \((.*?), (.*?), (.*?)\)", str(refused.value)).groups()
    assert float(share) == pytest.approx(100 * on_leaf.mean(), abs=10)
    away = np.linalg.norm(moved[on_leaf] - np.array(place, float), axis=1)
    assert away.min() < 0.1
    assert not (tmp_path / "a.branch" / "mesh.vtu").exists()
    shown = read_cloud(tmp_path / "a_points.ply")
    assert np.abs(shown.points - moved / 1000).max() < 0.01 or len(shown) < len(moved)
    assert (shown.attributes["class"] == 1).mean() == pytest.approx(on_leaf.mean(), abs=0.1)


def test_who_keeps_leaves_is_not_refused_for_them() -> None:
    """Where axes go through leaves that the user keeps, any share of points may lie beside them;
    not where leaves are still asked for, no leaf was found, or a pot stands below."""
    for leaves, leafy, supports, most in (
            ("keep", True, [], 1.0), ("ask", True, [], 0.25), ("keep", False, [], 0.25),
            ("keep", True, ["pot"], 0.25)):
        settings = ReconstructSettings(leaves=leaves, unexplained=0.25)
        assert _most_off(SimpleNamespace(leafy=leafy), settings, supports) == most


def test_few_leaves_need_no_consent() -> None:
    """Up to a tenth of the points passes, more does not."""
    cloud = Cloud(np.random.default_rng(0).random((1000, 3)))
    prepared = prepare(cloud, 1.0, ReconstructSettings(keep=("sheets",)))
    check_agreed(prepared, [Leaf(np.arange(len(prepared.cloud) // 10), 1e-3)])
    with pytest.raises(InputError, match="11 % of the points look like 1 leaf"):
        check_agreed(prepared, [Leaf(np.arange(110), 1e-3)])


def test_a_refusal_shows_its_points_by_class(tmp_path, monkeypatch) -> None:
    """Wood brown, leaves green, a stake blue, the rest red, in the file's coordinates; after
    success none."""
    cloud = Cloud(np.random.default_rng(0).random((60, 3)) + 100.0)
    prepared = prepare(cloud, 1.0, ReconstructSettings(keep=("sheets",)))
    seen: list[Cloud] = []
    with shown_if_refused(seen.append, prepared, [], []):
        pass
    off = np.arange(len(prepared.cloud) - 10) < 5

    def refuse(raw: Cloud, settings: ReconstructSettings, *, show, **_: object) -> None:
        with shown_if_refused(show, prepared, [Leaf(np.arange(10), 1e-3)],
                              [Part("stake", np.array([59]), 1.0)], off):
            raise InputError("leaves")
    monkeypatch.setattr("limber.geometry.reconstruction.reconstruct_cloud", refuse)
    cloud.write_ply(tmp_path / "scan.ply")
    told: list[str] = []
    with pytest.raises(InputError, match="leaves"):
        Reconstruct(cloud=tmp_path / "scan.ply",
                    output=tmp_path / "a.branch").run(Progress(on_warning=told.append))
    assert any(str(tmp_path / "a_points.ply") in text for text in told)
    shown = read_cloud(tmp_path / "a_points.ply")
    assert not seen and np.allclose(shown.points, prepared.cloud.points + prepared.origin)
    assert shown.attributes["class"].tolist() == (
        [1] * 10 + [2] * 5 + [0] * (len(shown) - 16) + [list(COLOURS).index("stake")])
    assert shown.attributes["color"][0].tolist() == list(COLOURS["leaf"])
    assert not (tmp_path / "a.branch").exists()


def _tube(start, end, radius: float, spacing: float, rng: np.random.Generator,
          view=None) -> np.ndarray:
    """Points of a round rod [m]; of a ``view`` as many as a sensor there gets off the surface."""
    start, way = np.array(start, float), np.subtract(end, start).astype(float)
    length = np.linalg.norm(way)
    count = int(2 * np.pi * radius * length / spacing**2)
    along, turn = rng.random((count, 1)), rng.uniform(0, 2 * np.pi, count)
    first = np.cross(way, [0.3, 1.0, 0.2])
    first /= np.linalg.norm(first)
    normal = np.cos(turn)[:, None] * first + np.sin(turn)[:, None] * np.cross(way / length, first)
    points = start + along * way + radius * normal
    return points if view is None else points[normal @ view > rng.random(count)]


def _spray(seed: int, spacing: float) -> np.ndarray:
    """Twigs that fork in one plane, scanned about as coarsely as they are thick."""
    rng, parts = np.random.default_rng(seed), []

    def grow(start: np.ndarray, turn: float, length: float, radius: float, forks: int) -> None:
        end = start + length * np.array([np.cos(turn), 0.05 * rng.normal(), np.sin(turn)])
        parts.append(_tube(start, end, 0.85 * radius, spacing, rng))
        for _ in range(3 * (forks > 0)):
            share, aside = rng.uniform(0.3, 1), rng.choice([-1, 1]) * rng.uniform(0.4, 0.9)
            grow(start + share * (end - start), turn + aside, length * rng.uniform(0.4, 0.7),
                 0.6 * radius, forks - 1)
    grow(np.zeros(3), np.pi / 2, 0.5, 0.01, 3)
    points = np.vstack(parts)
    return points + rng.normal(0, 1e-3, points.shape)


@pytest.mark.parametrize(("seed", "spacing"), [(3, 0.010), (2, 0.016)])
def test_twigs_that_fork_in_one_plane_are_no_leaf(seed: int, spacing: float) -> None:
    """Of these bare branches 40 and 87 % were leaves: a plane of lines is no sheet."""
    assert find_leaves(_spray(seed, spacing)) == []


@pytest.mark.slow
def test_a_stem_seen_from_one_side_is_no_leaf() -> None:
    """Its skeleton shows it round, though half of its points lie on a strip that is flat."""
    rng = np.random.default_rng(0)
    view = np.array([0.97, 0.1, -0.2])
    stem = np.vstack([_tube([0, 0, 0], [0.05, 0.1, 3], 0.1, 0.01, rng, view),
                      _tube([0, 0, 1.8], [0.3, 0.2, 2.0], 0.01, 0.01, rng, view)])
    stem += rng.normal(0, 3e-3, stem.shape)
    prepared = prepare(Cloud(stem), 1.0, ReconstructSettings(), up=np.array([0.0, 0.0, 1.0]))
    found = skeletonise(prepared.cloud.points)
    assert _on_round_axes(found, prepared.cloud.points).mean() > 0.5
    assert without_leaves(prepared, found)[1] == []


@pytest.mark.parametrize("count", [1, 3, 39, 40, 60, 100, 250])
def test_few_points_are_searched_for_leaves(count: int) -> None:
    """No point may have a neighbour at the finest scale; it ended in a traceback."""
    rng = np.random.default_rng(count)
    flat = rng.random((count, 3)) * [1, 1, 0]
    for points in (rng.random((count, 3)), flat, np.outer(rng.random(count), [0.2, 0.1, 1.0]),
                   np.repeat(rng.random((count // 3 + 1, 3)), 3, axis=0)):
        assert isinstance(find_leaves(points), list)


@pytest.mark.parametrize("count", [60, 250])
def test_a_random_cloud_is_refused_plainly(count: int) -> None:
    with pytest.raises(InputError):
        reconstruct_cloud(Cloud(np.random.default_rng(count).random((count, 3))),
                          ReconstructSettings())


def test_lines_in_a_plane_fill_no_sheet() -> None:
    """A comb of sparse twigs in one plane is lines; a blade of as many points is a sheet."""
    rng = np.random.default_rng(2)
    foot, along = np.repeat(np.arange(3) * 0.12, 50), rng.uniform(0, 0.3, 150)
    comb = np.stack([foot + rng.normal(0, 0.002, 150), along, np.zeros(150)], axis=1)
    assert find_leaves(comb) == []
    leaf, = find_leaves(_leaf(np.zeros(3), np.array([1.0, 0.2, 0.0]), rng))
    assert len(leaf.points) > 0.9 * 1400


def test_specks_go_with_the_nearest_leaf() -> None:
    """A few points that look like a leaf are one's rim where there is one, and else none; so is a
    doubtful one where there are few."""
    grid = 0.001 * np.stack(np.meshgrid(range(10), range(10), [0.0]), axis=-1).reshape(-1, 3)
    points = np.vstack([grid, grid[:9] + [0.02, 0, 0], grid + [0.1, 0, 0]])
    assert sorted(len(leaf.points) for leaf in find_leaves(points, np.full(209, 2.0))) == [100, 109]
    only, = find_leaves(points, np.where(np.arange(209) < 109, -2.0, 2.0))
    assert sorted(only.points) == list(range(109, 209))
    assert find_leaves(points[100:], np.where(np.arange(109) < 9, 2.0, -2.0)) == []
    twigs = np.vstack([points, 0.001 * np.arange(15_000).reshape(-1, 3)])  # a doubtful one is wood
    assert find_leaves(twigs, np.repeat([-2.0, 0.5, -4.0], [109, 100, 5000])) == []


@pytest.mark.slow
def test_points_off_all_axes_are_asked_whether_they_are_leaves() -> None:
    """Those of a seedling's leaves show leaves, those of its stems and of noise do not."""
    case = leafy_case(3)
    prepared = Prepared(Cloud(case.points), np.zeros(3))
    assert show_leaves(prepared, case.leaf)
    assert not show_leaves(prepared, ~case.leaf)
    assert not show_leaves(prepared, np.zeros(len(case.points), bool))
    rng = np.random.default_rng(4)
    noise = np.column_stack([rng.normal(0, 0.005, (400, 2)), rng.uniform(0, 0.5, 400)])
    assert not show_leaves(Prepared(Cloud(noise), np.zeros(3)), np.ones(400, bool))
