"""Streams with clocks of their own."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from limber.core.errors import InputError
from limber.recordings.import_request import BranchFrame, register, require_on_branch
from limber.recordings.recording import GraspEntry, Observations
from limber.recordings.synchronisation import estimate_offset, frames_of


def test_frames_are_the_observers_instants(plain_pull):
    """Poses are interpolated, the faster wrench is averaged: its noise falls with the count."""
    frames = frames_of(plain_pull)
    assert np.array_equal(frames.times, plain_pull.observations.times)
    expected = np.interp(frames.times, plain_pull.times, plain_pull.poses[:, 0])
    assert np.allclose(frames.poses[:, 0], expected)
    error = frames.wrenches[:, 0] - 50 * expected
    assert np.std(error) < 0.02 and abs(np.mean(error)) < 0.01


def there_and_back(pull):
    """The pull, and the way back after it."""
    half = pull.times[::2]
    return replace(pull, times=np.r_[half, half + 4.02][:-1],
                   poses=np.vstack([pull.poses[::2], pull.poses[::-2]])[:-1],
                   wrenches=np.vstack([pull.wrenches[::2], pull.wrenches[::-2]])[:-1])


@pytest.mark.parametrize("offset", [-0.37, 0.0, 0.154, 3.0, -8.0])
def test_clock_offset_is_found(plain_pull, offset):
    """An observer's clock that is off is found to a few milliseconds, from the motion alone."""
    rng = np.random.default_rng(1)
    pull = there_and_back(plain_pull)
    seen = np.linspace(0.5, 7.5, 120)
    way = np.interp(seen, pull.times, pull.poses[:, 0])
    positions = np.zeros((120, 2, 3))
    positions[:, 0, 0], positions[:, 1, 0], positions[:, 1, 2] = 0.3 * way, 0.7 * way, -way**2
    positions += 5e-4 * rng.standard_normal(positions.shape)
    pull = replace(pull, observations=Observations(seen - offset, positions))
    found, sigma = estimate_offset(pull)
    assert sigma < 5e-3
    assert abs(found - offset) < 4 * sigma


@pytest.mark.parametrize(("offset", "told"), [
    (13.0, "at the end of that range"), (2.0, "fit, so the pull does not determine")])
def test_an_offset_that_is_not_determined_is_refused(plain_pull, offset, told):
    """An optimum at the end of the search was taken; so was one of many on a way at even speed."""
    seen = np.linspace(-20, 24, 300) if offset > 10 else np.linspace(0.5, 3.5, 60)
    times, poses = plain_pull.times, plain_pull.poses
    if offset < 10:
        poses = np.outer(np.linspace(0, 1, len(times)), [0.05, 0, 0, 0, 0, 0])
    way = np.interp(seen, times, poses[:, 0])
    positions = np.zeros((len(seen), 2, 3))
    positions[:, 0, 0], positions[:, 1, 0] = 0.3 * way, 0.7 * way
    positions += 1e-4 * np.random.default_rng(1).standard_normal(positions.shape)
    pull = replace(plain_pull, poses=poses, observations=Observations(seen - offset, positions))
    with pytest.raises(InputError, match=rf"-10 to 10 s were tried.*{told}.*--time-offset"):
        estimate_offset(pull)


@pytest.mark.slow
@pytest.mark.parametrize("quantum", [2e-4, 1e-3, 5e-3])
def test_the_offsets_error_includes_the_rounding_of_the_poses(plain_pull, quantum):
    """A pull one way with rounded poses: the offset is off by far more than noise explains."""
    seen = np.linspace(0.2, 3.8, 120)
    way = np.interp(seen, plain_pull.times, plain_pull.poses[:, 0])
    off = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        positions = np.zeros((120, 2, 3))
        positions[:, 0, 0], positions[:, 1, 0], positions[:, 1, 2] = 0.3 * way, 0.7 * way, -way**2
        positions += 5e-5 * rng.standard_normal(positions.shape)
        poses = plain_pull.poses.copy()
        poses[:, 0] = quantum * np.round(poses[:, 0] / quantum + rng.uniform(-0.5, 0.5))
        pull = replace(plain_pull, poses=poses, observations=Observations(seen, positions))
        found, sigma = estimate_offset(pull)
        off.append(found / sigma)
    assert np.abs(off).max() < 3.0 and np.sqrt(np.mean(np.square(off))) < 1.5


def test_an_offset_that_nothing_shows_is_not_invented(plain_pull):
    """Of a branch that does not move, no offset is claimed."""
    seen = plain_pull.observations
    still = np.broadcast_to(seen.positions[0], seen.positions.shape)
    noise = 1e-3 * np.random.default_rng(0).standard_normal(seen.positions.shape)
    pull = replace(plain_pull, poses=np.tile(plain_pull.poses[0], (201, 1)),
                   observations=Observations(seen.times, still + noise))
    found, sigma = estimate_offset(pull)
    assert found == 0.0 and np.isinf(sigma)


def test_nothing_is_interpolated_across_a_gap(plain_pull):
    """Observed frames inside a gap of the robot's stream are left out, with a word."""
    keep = (plain_pull.times < 1.0) | (plain_pull.times > 2.0)
    pull = replace(plain_pull, times=plain_pull.times[keep], poses=plain_pull.poses[keep],
                   wrenches=plain_pull.wrenches[keep])
    frames = frames_of(pull)
    assert not np.any((frames.times > 1.0) & (frames.times < 2.0))
    assert "gap" in frames.warnings[0]


def test_clocks_that_do_not_overlap(plain_pull):
    """Streams hours apart are refused with both ranges."""
    seen = plain_pull.observations
    pull = replace(plain_pull, observations=Observations(seen.times + 3600, seen.positions))
    with pytest.raises(InputError, match="--time-offset"):
        frames_of(pull)


# Markers onto their nominal places, and what is refused.

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
