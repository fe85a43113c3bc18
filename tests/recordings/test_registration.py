"""Markers onto their nominal places, and what is refused."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from limber.core.errors import InputError
from limber.recordings.import_request import BranchFrame, require_on_branch
from limber.recordings.recording import GraspEntry
from limber.recordings.registration import register

NOMINAL = np.array([[0, 0, 0], [0.3, 0, 0.02], [0.1, 0.12, 0], [0.2, 0.05, 0.15], [0, 0.1, 0.2]])
LABELS = ["a", "b", "c", "d", "e"]
TURN = Rotation.from_rotvec([0.3, -1.0, 0.6])


def captured(places):
    rng = np.random.default_rng(0)
    return TURN.apply(places) + [1.0, -2.0, 0.5] + 2e-4 * rng.standard_normal(places.shape)


def test_markers_are_laid_onto_their_places():
    found = register(captured(NOMINAL), LABELS, LABELS, NOMINAL, "pull")
    assert found.rms < 1e-3 and not found.warnings
    assert found.apply(captured(NOMINAL)) == pytest.approx(NOMINAL, abs=2e-3)


def test_a_marker_without_a_place_is_named():
    points = np.vstack([captured(NOMINAL), [[9.0, 9.0, 9.0]]])
    found = register(points, [*LABELS, "hat"], LABELS, NOMINAL, "pull")
    assert "hat" in found.warnings[0] and len(found.used) == 5


@pytest.mark.parametrize(("points", "labels", "nominal", "word"), [
    (captured(NOMINAL), [*LABELS[:4], "x"], NOMINAL, "e has a nominal position"),
    (captured(NOMINAL), ["u", "v", "w", "x", "y"], NOMINAL, "markers u, v, w, x, y"),
    (captured(NOMINAL * [1, 1, -1]), LABELS, NOMINAL, "mirrored"),
    (captured(NOMINAL[[1, 0, 2, 3, 4]]), LABELS, NOMINAL, "a and b"),
    (captured(NOMINAL * [1, 0, 0]), LABELS, NOMINAL * [1, 0, 0], "on a line"),
])
def test_what_cannot_be_right_is_refused(points, labels, nominal, word):
    with pytest.raises(InputError, match=word):
        register(points, labels, LABELS, nominal, "pull")


def test_a_grasp_beside_the_branch_is_refused():
    """Where there is a mesh to hold it against."""
    nodes = np.array([[0.0, 0.0, z] for z in np.linspace(0, 0.5, 20)])
    beside = GraspEntry(point_m=(0.0, 0.2, 0.4), radius_m=0.01)
    with pytest.raises(InputError, match="from the branch"):
        require_on_branch(beside, "pull", BranchFrame(nodes=nodes))
    require_on_branch(beside, "pull", BranchFrame())
    require_on_branch(GraspEntry(point_m=(0.0, 0.01, 0.4), radius_m=0.01), "pull",
                      BranchFrame(nodes=nodes))
