"""Bridges over gaps: ends go on in their own direction, twigs meet their carrier at an angle."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree
from tests.subjects.grown import tube

from benchmarks.scan_cases import one_sided_case
from benchmarks.scan_scores import fork_matches, main_axis_error, seen_part
from limber.core.errors import InputError
from limber.geometry.cloud.cloud import Cloud
from limber.geometry.reconstruction import COLOURS, reconstruct_cloud
from limber.geometry.settings import ReconstructSettings, SkeletonSettings
from limber.geometry.skeleton import bridge_kernels, joining
from limber.geometry.skeleton.bridge_kernels import boxes
from limber.geometry.skeleton.free_ends import free_ends
from limber.geometry.skeleton.joining import filled, hypotheses, join_pieces, second_base
from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.skeleton.skeletonise import skeletonise

Z = np.array([0.0, 0.0, 1.0])


def _dots(start, end, count=12):
    return np.linspace(np.array(start, float), np.array(end, float), count)


def _forest(*chains):
    edges, begin = [], 0
    for chain in chains:
        index = begin + np.arange(len(chain))
        edges.append(np.stack([index[:-1], index[1:]], axis=1))
        begin += len(chain)
    return np.vstack(chains), np.vstack(edges)


def _tied_ends(nodes, edges, thickness, spread=0.0, limit=0.3):
    count = len(nodes)
    return join_pieces(nodes, edges, thickness, np.full(count, 20), np.full(count, spread),
                       gap=0.03, bridge_limit=limit, up=Z, join_plants=False)


def _fork_in_a_gap(gap: float):
    """A stem with a gap, whose twig starts out of it, nearer to each end than these are."""
    low, high = _dots([0, 0, 0], [0, 0, 0.3]), _dots([0, 0, 0.3 + gap], [0, 0, 0.7])
    side = 0.4 * gap
    twig = _dots([side, 0, 0.3 + gap / 2 + side], [side + 0.15, 0, 0.3 + gap / 2 + side + 0.15])
    return low, high, twig


@pytest.mark.parametrize("gap", [0.05, 0.07, 0.1])
def test_the_stem_does_not_go_along_a_twig_and_back(gap: float) -> None:
    """Where a fork is missing, stem joins stem, and the twig joins what fills the gap."""
    low, high, twig = _fork_in_a_gap(gap)
    nodes, edges = _forest(low, high, twig)
    thickness = np.concatenate([np.full(24, 0.008), np.full(12, 0.005)])
    joined = _tied_ends(nodes, edges, thickness)
    assert joined.label.max() == 0
    assert sorted(joined.bridges[0].tolist()) == [11, 12]
    one, other = joined.bridges[1]
    met = other if one >= 24 else one
    # On the line from twig to stem, in the gap or beside it, and not at the twig's far end.
    assert abs(joined.nodes[met, 0]) < 1e-9 and abs(joined.nodes[met, 2] - 0.3 - gap / 2) < 0.03
    assert joined.prices[0] == pytest.approx(1.0, abs=0.05)


def test_an_end_prefers_what_it_points_at() -> None:
    """A twig beside the stem reaches past the nearest node for where its line leads."""
    stem, twig = _dots([0, 0, 0], [0, 0, 0.6], 40), _dots([0.06, 0, 0.36], [0.2, 0, 0.5], 10)
    nodes, edges = _forest(stem, twig)
    label = np.repeat([0, 1], [40, 10])
    found = hypotheses(nodes, edges, np.full(50, 0.005), label, np.array([800, 200]), 0.2,
                       free_ends(nodes, edges, np.full(50, 0.005)))
    best = nodes[found.other[0]] if found.other[0] < 40 else nodes[found.one[0]]
    assert best[2] == pytest.approx(0.30, abs=0.03)
    assert np.all(np.diff(found.price) >= 0)


def test_stems_are_joined_before_twigs() -> None:
    """A thin twig's end does not take the stem's: the stem's bridge is shorter for its thickness.

    The twig points at the lower stem's end, and the upper part of the stem leans away.
    """
    low, high = _dots([0, 0, 0], [0, 0, 0.3]), _dots([0.03, 0, 0.4], [0.13, 0, 0.7])
    twig = _dots([-0.06, 0, 0.36], [-0.18, 0, 0.48])
    nodes, edges = _forest(low, high, twig)
    joined = _tied_ends(nodes, edges, np.repeat([0.01, 0.01, 0.002], 12))
    assert sorted(joined.bridges[0].tolist()) == [11, 12]
    assert joined.label.max() == 0


def test_a_twigs_foot_that_is_nearer_than_the_stems_next_patch_is_not_taken_for_it() -> None:
    """It leaves the patch and the upper stem to come from aside: all together the other way costs
    half."""
    low, patch, high = (_dots([0, 0, 0], [0, 0, 0.3]), _dots([0, 0, 0.342], [0, 0, 0.347], 2),
                        _dots([0, 0, 0.4], [0, 0, 0.7]))
    foot = np.array([0.012, 0, 0.325])
    twig = _dots(foot, foot + 0.2 * np.array([np.sin(0.6), 0, np.cos(0.6)]))
    nodes, edges = _forest(low, patch, high, twig)
    joined = join_pieces(nodes, edges, np.repeat([0.006, 0.004, 0.006, 0.005], [12, 2, 12, 12]),
                         np.full(38, 20), np.zeros(38), gap=0.01, bridge_limit=0.3, up=Z,
                         join_plants=False)
    assert joined.label.max() == 0
    assert {11, 14} in [set(pair) for pair in joined.bridges.tolist()]
    twigs = next(pair for pair in joined.bridges.tolist() if 26 in pair)
    assert np.abs(joined.nodes[twigs, 0]).min() < 1e-9


def test_a_twig_at_a_stems_end_does_not_close_it() -> None:
    """An end that a bridge joined from the side stays one, with its direction; the bridge has none.
    """
    stem, twig = _dots([0, 0, 0.4], [0, 0, 0.8]), _dots([0.02, 0, 0.42], [0.2, 0, 0.55])
    nodes, edges = _forest(stem, twig)
    edges, thickness = np.vstack([edges, [[12, 0]]]), np.repeat([0.008, 0.004], 12)
    closed = free_ends(nodes, edges, thickness)
    assert set(closed.node.tolist()) == {11, 23}
    found = free_ends(nodes, edges, thickness, np.array([[12, 0]]))
    assert set(found.node.tolist()) == {0, 11, 23}
    assert found.direction[found.node == 0][0] == pytest.approx([0, 0, -1])


@pytest.mark.slow
def test_a_stem_goes_on_past_a_twig_at_its_end() -> None:
    """One of the bench's cases, seen from one side: the main axis had gone 5 radii aside, up a twig
    that came to the upper stem's end first."""
    case = one_sided_case(1604433927020)
    truth = seen_part(case.truth, case.points)
    assert main_axis_error(truth, skeletonise(case.points).skeleton) < 1


def test_a_tip_beyond_a_gap_is_reached_straight_on() -> None:
    """What is left of a tip is one node: an end that goes straight on to it comes from far."""
    stem, tip = _dots([0, 0, 0], [0, 0, 0.5]), np.array([[0.0, 0.0, 0.6]])
    nodes, edges = np.vstack([stem, tip]), np.stack([np.arange(11), np.arange(1, 12)], axis=1)
    thickness = np.full(13, 0.008)
    assert _tied_ends(nodes, edges, thickness, 0.012, 0.15).label.max() == 0
    aside = nodes + np.outer(np.arange(13) == 12, [0.08, 0, -0.03])
    assert _tied_ends(aside, edges, thickness, 0.012, 0.15).label.max() == 1


def test_a_few_points_at_a_tip_are_reached_by_an_end_as_long_as_the_gap() -> None:
    """Of a patch of skin contraction tells no thickness, and a stray one lies on no end's line."""
    stem, tip = _dots([0, 0, 0], [0, 0, 0.5]), np.array([[0.0, 0.0, 0.62]])
    nodes, edges = np.vstack([stem, tip]), np.stack([np.arange(11), np.arange(1, 12)], axis=1)
    thickness = np.repeat([0.008, 0.0005], [12, 1])
    assert _tied_ends(nodes, edges, thickness, 0.001, 0.15).label.max() == 0
    aside = nodes + np.outer(np.arange(13) == 12, [0.04, 0, 0])
    assert _tied_ends(aside, edges, thickness, 0.001, 0.15).label.max() == 1
    short = nodes[9:]
    assert _tied_ends(short - short[0], edges[:2], thickness[9:], 0.001, 0.15).label.max() == 1


def _stem_with_a_knob():
    """A stem, a knob on its side that points past a twig's foot, and that twig."""
    stem, knob = _dots([0, 0, 0], [0, 0, 0.6], 61), _dots([0.004, 0, 0.2], [0.008, 0, 0.21], 2)
    twig = _dots([0.045, 0, 0.31], [0.185, 0, 0.45], 15)
    nodes, edges = _forest(stem, knob, twig)
    return nodes, np.vstack([edges, [[20, 61]]]), np.repeat([0.008, 0.006, 0.001], [61, 2, 15])


def test_what_hangs_beside_a_longer_axis_has_neither_its_thickness_nor_its_direction() -> None:
    """A knob of two nodes tells no direction; the stem's ends, and a leader past a twig, do."""
    nodes, edges, thickness = _stem_with_a_knob()
    ends = free_ends(nodes, edges, thickness)
    knob = ends.node == 62
    assert not ends.direction[knob].any() and ends.radius[knob][0] == pytest.approx(0.006)
    assert ends.radius[ends.node == 60][0] == pytest.approx(0.008)
    assert ends.direction[ends.node == 60][0] == pytest.approx([0, 0, 1])
    # A twig that leaves just under the end of a stem does not make that a knob.
    edges[-1] = [58, 61]
    nodes[61:63] = nodes[58] + [[0.01, 0, 0.01], [0.1, 0, 0.1]]
    ends = free_ends(nodes, edges, thickness)
    assert ends.direction[ends.node == 60][0] == pytest.approx([0, 0, 1], abs=0.05)


@pytest.mark.slow
def test_a_knob_of_the_stem_is_no_foot_of_a_twig() -> None:
    """Seen from one side: a twig had been led to a knob at the next fork, since the stem is thick,
    and not to where its own line meets the stem, at half the price: two forks were false."""
    case = one_sided_case(1409822584023)
    truth = seen_part(case.truth, case.points)
    found = skeletonise(case.points).skeleton
    hits, right = fork_matches(truth, found)
    assert hits == truth.branch_count - 1 and right.all()


def test_a_bridge_bends_as_its_ends_do() -> None:
    """Between two parts of an arc the filled nodes lie on the arc, not on its chord."""
    turn = np.concatenate([np.linspace(0, 0.5, 20), np.linspace(0.7, 1.2, 20)])
    arc = 0.5 * np.stack([1 - np.cos(turn), np.zeros(40), np.sin(turn)], axis=1)
    nodes, edges = _forest(arc[:20], arc[20:])
    thickness = np.full(40, 0.004)
    curve, thick = filled(nodes, thickness, free_ends(nodes, edges, thickness), 19, 20, 0.01)
    off = np.abs(np.linalg.norm(curve - [0.5, 0, 0], axis=1) - 0.5)
    chord = 0.5 * (1 - np.cos(0.1))
    assert len(curve) > 5 and off.max() < 0.4 * chord
    assert thick == pytest.approx(0.004)


def test_a_twig_between_two_stems_has_the_other_stem_as_its_rival() -> None:
    """The nearly even choice gets a rival at about the same price; a clear one a dear rival."""
    ratios = []
    for near in (0.05, 0.025):
        left, right = _dots([0, 0, 0], [0, 0, 0.6], 40), _dots([0.1, 0, 0], [0.1, 0, 0.6], 40)
        base = _dots([0.004, 0, 0], [0.096, 0, 0], 8)
        twig = _dots([near, 0.03, 0.35], [near, 0.2, 0.45], 10)
        nodes, edges = _forest(left, right, base, twig)
        edges = np.vstack([edges, [[0, 80], [87, 40]]])
        joined = _tied_ends(nodes, edges, np.repeat([0.006, 0.006, 0.006, 0.003], [40, 40, 8, 10]))
        bridge = int(np.argmax(joined.lengths()))
        rival = joined.rivals[bridge]
        taken = joined.nodes[joined.bridges[bridge]]
        assert rival.end == pytest.approx(twig[0])
        assert np.linalg.norm(taken - rival.to, axis=1).max() > joined.lengths()[bridge]
        ratios.append(rival.price / (joined.prices[bridge] * joined.lengths()[bridge]))
    assert 0.9 < ratios[0] < 1.2 and ratios[1] > 1.3 * ratios[0]


# Pieces of a scan: what is bridged, what is left away, and when it is two plants.


def _tube(start, end, radius, count, seed=0):
    return tube(start, end, radius, count, np.random.default_rng(seed))


def _plant(x, height=0.6, seed=0):
    return np.vstack([_tube([x, 0, 0], [x, 0, height], 0.01, 3000, seed),
                      _tube([x, 0, 0.3], [x, 0.2, 0.45], 0.006, 900, seed + 1)])


def _tied(*chains, **options):
    nodes = np.vstack(chains)
    edges, begin = [], 0
    for chain in chains:
        index = begin + np.arange(len(chain))
        edges.append(np.stack([index[:-1], index[1:]], axis=1))
        begin += len(chain)
    count = len(nodes)
    return join_pieces(nodes, np.vstack(edges), np.full(count, 0.01), np.full(count, 20),
                       np.full(count, 0.01),
                       **({"gap": 0.03, "bridge_limit": 0.3, "up": Z, "join_plants": False}
                          | options))


def _string(start, end, count):
    return np.linspace(np.array(start, float), np.array(end, float), count)


@pytest.mark.slow
@pytest.mark.parametrize("distance", [0.07, 0.1, 0.25])
def test_two_plants_are_refused_however_near(distance):
    """Two stems side by side: refused, although their gap is short enough for a bridge."""
    cloud = np.vstack([_plant(0), _plant(distance, seed=5)])
    with pytest.raises(InputError, match=r"two plants.*--plants largest"):
        skeletonise(cloud)


@pytest.mark.slow
@pytest.mark.parametrize("second", [_plant(0.1, seed=5), _plant(0.9, seed=5) + [0, 0, 0.4]])
def test_places_are_told_in_the_coordinates_of_the_file(second):
    """Two plants, near or far apart, in millimetres far from the origin; shown in two colours."""
    first, shown = _plant(0), []
    cloud = 1000 * (np.vstack([first, second]) + [5000.0, 300.0, 20.0])
    with pytest.raises(InputError, match="in the scan's coordinates") as refusal:
        reconstruct_cloud(Cloud(cloud), ReconstructSettings(unit="mm"), show=shown.append)
    nearest = cKDTree(cloud / 1000).query(shown[0].points)[1]
    apart = shown[0].attributes["class"] == list(COLOURS).index("another plant")
    assert 0.3 < apart.mean() < 0.7
    for plant in (nearest < len(first), nearest >= len(first)):
        assert apart[plant].mean() < 0.01 or apart[plant].mean() > 0.99
    place = [float(part) for part in re.search(r"at \(([^)]*)\)", str(refusal.value))[1].split(",")]
    assert (cloud.min(axis=0) <= place).all() and (place <= cloud.max(axis=0)).all()


def test_warnings_have_places_in_the_coordinates_of_the_file():
    """What a gap's warning names lies in it; the root is named by its place, not as an origin."""
    cloud = _tube([0, 0, 0], [0, 0, 0.6], 0.01, 3000)
    cloud = cloud[np.abs(cloud[:, 2] - 0.3) > 0.015]
    result = skeletonise(cloud)
    told = [text for text in result.moved(lambda place: 1000 * (place + [5, 0, 0])).warnings
            if "gap" in text]
    place = [float(part) for part in re.search(r"\(([^)]*)\)", told[0])[1].split(",")]
    assert place == pytest.approx([5000, 0, 300], abs=60)
    odd = replace(result, root_ends=[{"at": result.skeleton.nodes[end], "probability": 0.5}
                                     for end in (0, -1)])
    text = next(text for text in odd.moved(lambda place: place + [5, 0, 0]).warnings
                if "--root" in text)
    assert "origin" not in text and text.count("(5.0") + text.count("(4.9") == 2


@pytest.mark.slow
def test_largest_of_two_plants():
    """On request the larger one alone, with what was left away told."""
    cloud = np.vstack([_plant(0), _plant(0.1, height=0.4, seed=5)])
    result = skeletonise(cloud, SkeletonSettings(plants="largest"))
    assert np.abs(result.skeleton.nodes[:, 0]).max() < 0.02
    assert result.skeleton.length == pytest.approx(0.85, rel=0.08)
    assert any("were discarded" in text for text in result.warnings)


@pytest.mark.slow
def test_two_plants_joined_on_request():
    """Also on request they are bridged, and the second base is told."""
    cloud = np.vstack([_plant(0), _plant(0.08, seed=5)])
    result = skeletonise(cloud, SkeletonSettings(plants="joined"))
    assert result.skeleton.length > 1.4
    assert any("second base" in text for text in result.warnings)


def test_a_cut_stem_is_no_second_plant():
    """The upper half stands on the lower one's end, not on the ground."""
    joined = _tied(_string([0, 0, 0], [0, 0, 0.3], 20), _string([0, 0, 0.37], [0, 0, 0.8], 30))
    assert len(joined.bridges) == 1
    assert len(joined.plants) == 0
    assert set(joined.bridges[0]) == {19, 20}


def test_a_stray_clump_is_left_away():
    """A clump far away has no length that would speak for a bridge; a twig as far away has."""
    stem = _string([0, 0, 0], [0, 0, 1.0], 60)
    clump = _string([0.25, 0, 0.5], [0.27, 0, 0.5], 3)
    twig = _string([-0.25, 0, 0.5], [-0.5, 0, 0.6], 15)
    joined = _tied(stem, clump, twig)
    assert len(joined.bridges) == 1
    assert joined.label[0] == joined.label[-1] != joined.label[60]


@pytest.mark.slow
def test_the_root_belongs_to_the_plant():
    """A stray clump below the stem is reported, and draws neither root nor bridge."""
    stray = np.random.default_rng(1).normal(0, 0.006, (60, 3)) + [0.16, 0, -0.12]
    result = skeletonise(np.vstack([_plant(0, height=0.8), stray]))
    assert np.linalg.norm(result.skeleton.nodes[0]) < 0.02
    assert sum(piece["points"] for piece in result.split_off) >= 50


def test_second_base_of_touching_plants():
    """An arch stands on the ground twice; a tip that hangs down does not."""
    angle = np.linspace(0, np.pi, 60)
    arch = np.stack([0.5 * (1 - np.cos(angle)), 0 * angle, np.sin(angle)], axis=1)
    parent = np.arange(60) - 1
    found = second_base(Skeleton.from_edges(arch, parent, np.full(60, 0.02)), Z)
    np.testing.assert_allclose(found, [1, 0, 0], atol=1e-9)
    thinning = Skeleton.from_edges(arch, parent, np.linspace(0.02, 0.005, 60))
    assert second_base(thinning, Z) is None


# A crown in very many pieces: joined in few rounds, and as if nothing had been remembered.


def _crown(twigs, seed=0):
    """Chains of a stem and its twigs with gaps, some askew: nodes, edges and radii."""
    rng = np.random.default_rng(seed)
    nodes, edges, radii = [], [], []

    def chain(line, radius):
        begin, count = sum(map(len, nodes)), len(line)
        nodes.append(line)
        radii.append(np.full(count, radius))
        edges.append(begin + np.stack([np.arange(count - 1), np.arange(1, count)], axis=1))

    height = np.arange(0, 2, 0.01)
    stem = np.stack([0.03 * np.sin(3 * height), 0.02 * height, height], axis=1)
    for part in np.array_split(stem, 4):
        chain(part[:-6], 0.02)
    for k in range(twigs):
        way = rng.normal(size=3) * [1, 1, 0.3] + [0, 0, 0.6]
        way /= np.linalg.norm(way)
        start = stem[int(len(stem) * (0.15 + 0.8 * k / twigs))]
        along = np.arange(0.05, 0.4, 0.01)[:, None]
        line = start + along * way + 0.1 * along**2 * rng.normal(size=3)
        for part in np.array_split(line, 2):
            chain(part[:-5] + rng.normal(size=3) * 0.012, 0.006)
    return np.vstack(nodes), np.vstack(edges), np.concatenate(radii)


def _crowned(twigs, seed=0):
    nodes, edges, radius = _crown(twigs, seed)
    return join_pieces(nodes, edges, radius, np.full(len(nodes), 20), radius, gap=0.03,
                       bridge_limit=0.3, up=Z, join_plants=True)


@pytest.fixture
def priced_bridges(monkeypatch) -> list[int]:
    """The number of bridges that each round of joining prices."""
    counts, price = [], joining.hypotheses

    def counted(*arguments):
        found = price(*arguments)
        counts.append(len(found.one))
        return found

    monkeypatch.setattr(joining, "hypotheses", counted)
    return counts


def test_a_crown_of_many_pieces_is_joined_in_few_rounds(priced_bridges):
    """Every trial without a bridge once joined all pieces again, pricing all of them each time."""
    state = _crowned(22)
    assert state.label.max() == 0 and len(state.bridges) == 47
    assert len(priced_bridges) < 60 and sum(priced_bridges) < 500_000


def _sticks(count, seed=5):
    """Short sticks in all directions, each of three nodes: nodes and edges."""
    rng = np.random.default_rng(seed)
    way = rng.normal(size=(count, 1, 3))
    way /= np.linalg.norm(way, axis=2, keepdims=True)
    nodes = rng.uniform(0, 1, (count, 1, 3)) + np.linspace(0, 0.01, 3)[:, None] * way
    first = 3 * np.arange(count)
    return nodes.reshape(-1, 3), np.stack(
        [np.r_[first, first + 1], np.r_[first + 1, first + 2]], axis=1)


@pytest.mark.campaign
def test_strewn_sticks_take_no_more_rounds_than_a_crown(priced_bridges) -> None:
    """A bridge for each of 300 short sticks, and few trials without one."""
    nodes, edges = _sticks(300)
    radius = np.full(len(nodes), 0.002)
    state = join_pieces(nodes, edges, radius, np.full(len(nodes), 20), radius, gap=0.03,
                        bridge_limit=0.5, up=Z, join_plants=False)
    assert state.label.max() == 0
    assert len(priced_bridges) < 60 and sum(priced_bridges) < 3_000_000


def test_boxes_leave_out_no_path() -> None:
    """The search over boxes keeps the paths that one over all nodes keeps."""
    nodes, edges = _sticks(60)
    radius, label = np.full(len(nodes), 0.002), np.repeat(np.arange(60), 3)
    ends = free_ends(nodes, edges, radius)
    end_of = np.full(len(nodes), -1)
    end_of[ends.node] = np.arange(len(ends.node))
    given = (nodes, radius, np.zeros_like(nodes), np.zeros(len(nodes), bool), label, ends.node,
             ends.direction, ends.radius, end_of, 0.4)
    whole = (np.arange(len(nodes)), np.array([[0, len(nodes)]]), nodes.min(axis=0)[None],
             nodes.max(axis=0)[None], np.array([-1]))
    kept = bridge_kernels.priced(*given, boxes(nodes, label))
    for one, other in zip(kept, bridge_kernels.priced(*given, whole), strict=True):
        np.testing.assert_array_equal(one, other)
    assert len(kept[0]) < len(ends.node) * 177
    for one, other in zip(*(bridge_kernels.nearest_others(
            nodes, label, np.arange(len(nodes)), 0.4, 3, tree) for tree in (
                boxes(nodes, label), whole)), strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_stem_takes_many_twigs_in_a_round():
    """One twig a round once made rounds as many as twigs, each as dear as all pieces."""
    state = _crowned(8)
    assert state.label.max() == 0 and len(state.bridges) == 19
    assert len(state.rounds) < 10


def test_trials_without_a_bridge_end(monkeypatch):
    """However many pieces there are, they do no more work than allowed."""
    tried = []
    without = joining._without

    def counted(state, pair, *further):
        tried.append(sum(past.work for past in state.rounds[joining._start(state, pair):]))
        return without(state, pair, *further)

    monkeypatch.setattr(joining, "_without", counted)
    _crowned(8)
    all_tried = sum(tried)
    assert all_tried
    tried.clear()
    monkeypatch.setattr(joining, "_MOST_WORK", all_tried - 1)
    _crowned(8)
    assert sum(tried) < all_tried


@pytest.mark.slow
def test_what_is_remembered_changes_nothing(monkeypatch):
    """Rounds taken over and ends known from before give what joining all anew gives."""
    states = [_crowned(8, seed) for seed in range(4)]
    tried = []

    def anew(state, pair, rules, refused, dearest):
        tried.append(pair)
        return joining._joined(state.rounds[0].before.copy([]), rules, refused | {pair}, dearest)

    monkeypatch.setattr(joining, "_without", anew)
    monkeypatch.setattr(joining.Joined, "ends", lambda state: joining.free_ends(
        state.nodes, state.edges, state.thickness, state.joints))
    for seed, state in enumerate(states):
        again = _crowned(8, seed)
        for name in ("nodes", "edges", "bridges", "prices", "joints", "label"):
            np.testing.assert_array_equal(getattr(again, name), getattr(state, name))
    assert tried
