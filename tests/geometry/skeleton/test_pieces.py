"""Pieces of a scan: what is bridged, what is left away, and when it is two plants."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree
from tests.subjects.grown import tube

from limber.core.errors import InputError
from limber.geometry.cloud.cloud import Cloud
from limber.geometry.reconstruction import COLOURS, reconstruct_cloud
from limber.geometry.settings import ReconstructSettings, SkeletonSettings
from limber.geometry.skeleton.joining import join_pieces, second_base
from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.skeleton.skeletonise import skeletonise

Z = np.array([0.0, 0.0, 1.0])


def _tube(start, end, radius, count, seed=0):
    return tube(start, end, radius, count, np.random.default_rng(seed))


def _plant(x, height=0.6, seed=0):
    return np.vstack([_tube([x, 0, 0], [x, 0, height], 0.01, 3000, seed),
                      _tube([x, 0, 0.3], [x, 0.2, 0.45], 0.006, 900, seed + 1)])


def _joined(*chains, **options):
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


def _line(start, end, count):
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
    place = [float(part) for part in
             re.search(r"at \(([^)]*)\)", str(refusal.value))[1].split(",")]
    assert (cloud.min(axis=0) <= place).all() and (place <= cloud.max(axis=0)).all()


def test_warnings_have_places_in_the_coordinates_of_the_file():
    """What a gap's warning names lies in it; the root is named by its place, not as an origin."""
    cloud = _tube([0, 0, 0], [0, 0, 0.6], 0.01, 3000)
    cloud = cloud[np.abs(cloud[:, 2] - 0.3) > 0.015]
    result = skeletonise(cloud)
    told = [text for text in result.warnings_at(lambda place: 1000 * (place + [5, 0, 0]))
            if "gap" in text]
    place = [float(part) for part in re.search(r"\(([^)]*)\)", told[0])[1].split(",")]
    assert place == pytest.approx([5000, 0, 300], abs=60)
    odd = replace(result, root_ends=[{"at": result.skeleton.nodes[end], "probability": 0.5}
                                     for end in (0, -1)])
    text = next(text for text in odd.warnings_at(lambda place: place + [5, 0, 0])
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
    joined = _joined(_line([0, 0, 0], [0, 0, 0.3], 20), _line([0, 0, 0.37], [0, 0, 0.8], 30))
    assert len(joined.bridges) == 1
    assert len(joined.plants) == 0
    assert set(joined.bridges[0]) == {19, 20}


def test_a_stray_clump_is_left_away():
    """A clump far away has no length that would speak for a bridge; a twig as far away has."""
    stem = _line([0, 0, 0], [0, 0, 1.0], 60)
    clump = _line([0.25, 0, 0.5], [0.27, 0, 0.5], 3)
    twig = _line([-0.25, 0, 0.5], [-0.5, 0, 0.6], 15)
    joined = _joined(stem, clump, twig)
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
