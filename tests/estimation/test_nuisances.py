"""Errors of cell and sensors as unknowns: eliminated, found, named, and in the intervals."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.paper_branches import FRACTIONS, measured
from limber.core.errors import WorkError
from limber.core.numerics.rigid import rotated
from limber.estimation.estimated_branch import Subject, forwards_of, observes_path
from limber.estimation.fit import fit_branch, fit_pulls
from limber.estimation.fitting import nuisances
from limber.estimation.fitting.initial_modulus import far_points, fitted_frame, put_right
from limber.estimation.fitting.objective import EvaluationLog, Objective
from limber.estimation.forward import solved_pull
from limber.estimation.forward.forward_model import PointDirections, Simulated
from limber.estimation.forward.observed_path import ObservedPathForward
from limber.estimation.parameters import BULK, ParameterSpace, Values
from limber.estimation.settings import FitSpec, PullSpec
from limber.estimation.simulated_pull import CellErrors, marked_points, simulate_pull
from limber.estimation.uncertainty.covariance import largest, variance_parts
from limber.estimation.uncertainty.model_error import path_error, path_prescribed
from limber.mechanics.materials.materials import log_bulk_over_shear, poisson_of
from limber.recordings import recording
from limber.recordings.synchronisation import frames_of

TRUTH = np.array([40e6, 22e6, 12e6, 3e6])
SETTINGS = FitSpec(poisson=0.36, hold_out=False, key_frames=6)
SHIFT = np.array([1.5e-3, -1e-3, 1e-3])
TURN = np.array([0.01, -0.02, 0.015])


@pytest.fixture(scope="module")
def bad_cell(small_pull):
    """A pull whose gripper is 2 mm and 1.5 degrees off, whose sensor has a zero, whose camera is
    a millimetre off."""
    pull = measured(small_pull, 3, points=5e-4, force=0.01)
    peak = float(np.linalg.norm(small_pull.wrenches[:, :3], axis=1).max())
    calibration = recording.CalibrationEntry(force_bias_sigma_n=peak, force_drift_sigma_n=peak,
                                   repeat_sigma=0.0)
    point = np.array(pull.entry.grasp.point_m)
    poses, wrenches = pull.poses.copy(), pull.wrenches.copy()
    poses[:, :3] = point + SHIFT + Rotation.from_rotvec(TURN).apply(poses[:, :3] - point)
    wrenches[:, :3] += peak * np.array([0.8, -0.5, 0.3])
    seen = pull.observations
    return replace(pull, poses=poses, wrenches=wrenches,
                   entry=pull.entry.model_copy(update={"calibration": calibration}),
                   observations=replace(seen, positions=seen.positions + [1e-3, 0.0, -1e-3]))


def subject_of(bench, branch):
    """The branch of a bench, weightless."""
    return Subject(bench.mesh, branch.skeleton, bench.points, bench.weights, bench.model,
                   Values(np.full(4, 1e7), 0.36, 900.0))


def objective_of(bench, pull, poisson=0.36):
    forward = ObservedPathForward(
        pull.name,
        bench.model,
        bench.weights,
        pull.entry,
        frames_of(pull),
        np.array(pull.entry.rest_points_m),
        key_count=6,
    )
    forward.skeleton = bench.branch.skeleton
    space = ParameterSpace.separate(Values(np.full(4, 1e7), poisson, 900.0))
    return Objective([forward], space, force_sigma=[pull.entry.sensor.force_sigma_n])


@pytest.fixture(scope="module")
def found(small_bench, bad_cell):
    objective = objective_of(small_bench, bad_cell)
    return fit_pulls(objective, objective.space.base, SETTINGS)


@pytest.mark.parametrize(("iterations", "most"), [(150, 3), (50, 12)])
def test_a_branch_that_folds_up_is_given_up_early(small_bench, bad_cell, monkeypatch, iterations,
                                                  most):
    """Where all states take many iterations: in its first frames, or before its force settles.
    What stood before stands again after that."""
    objective = objective_of(small_bench, bad_cell)
    free = objective.space.pack(Values(TRUTH, 0.36, 900.0))
    before, solve, asked = objective.evaluate(free), solved_pull.solve_static, []

    def folding(*arguments, **named):
        asked.append(1)
        return replace(solve(*arguments, **named), iterations=iterations)

    with monkeypatch.context() as patch:
        patch.setattr(solved_pull, "solve_static", folding)
        assert objective.evaluate(free - [0.4, 0.0, 0.8, 0.0]) is None
    assert len(asked) <= most
    assert objective.evaluate(free).objective == pytest.approx(before.objective, rel=0.05)


def test_slopes_by_adjoints_are_those_of_the_pull(small_bench, bad_cell):
    """Points and gripper under one force, against a difference of two simulations."""
    forward = objective_of(small_bench, bad_cell).forwards[0]
    values, step = Values(TRUTH, 0.36, 900.0), 1e-3
    found = forward.simulate(values, (BULK,), True)
    assert found.slopes.positions.shape[-1] == 5
    for column, changed in ((1, replace(values, young=TRUTH * np.exp([0, step, 0, 0]))),
                            (4, replace(values, poisson=poisson_of(
                                log_bulk_over_shear(0.36) + step)))):
        forward._drives_for = changed  # at the same force
        moved = forward.simulate(changed, (BULK,), False)
        for name in ("positions", "grasps"):
            change = (getattr(moved, name) - getattr(found, name)) / step
            slope = getattr(found.slopes, name)[..., column]
            assert np.abs(change - slope).max() < 0.01 * np.abs(slope).max()
        forward._drives_for = values
        forward.simulate(values, (BULK,), False)


def test_a_force_is_foreseen_after_small_steps(small_bench, bad_cell):
    """One simulation instead of several, at the same objective; a large step scales the force."""
    objective, plain = (objective_of(small_bench, bad_cell) for _ in range(2))
    free = objective.space.pack(Values(TRUTH, 0.36, 900.0))
    counts = {"foreseen": 0, "scaled": 0}

    def counted(name, each):
        compared = each._compared

        def count(*arguments):
            counts[name] += 1
            return compared(*arguments)

        return count

    for name, each in (("foreseen", objective), ("scaled", plain)):
        each.evaluate(free, jacobian=True)
        each._compared = counted(name, each)
    plain._linear = None
    step = np.array([0.1, -0.1, 0.15, 0.1])
    near, same = (each.evaluate(free + step, jacobian=True) for each in (objective, plain))
    assert counts["foreseen"] < counts["scaled"]
    assert near.objective == pytest.approx(same.objective, rel=1e-3)
    assert objective._foreseen(free + 1.0, {}) == {}


def test_elimination_is_the_joint_least_squares_problem():
    """Steps and covariance of the free values, and the errors, as of all unknowns together."""
    rng = np.random.default_rng(0)
    jacobian, columns = rng.standard_normal((40, 3)), rng.standard_normal((40, 5))
    residual = rng.standard_normal(40)
    left, slopes, errors = nuisances.eliminated(residual, jacobian, columns)
    joint = np.vstack([np.hstack([jacobian, columns]), np.hstack([np.zeros((5, 3)), np.eye(5)])])
    step = -np.linalg.lstsq(joint, np.r_[residual, np.zeros(5)], rcond=None)[0]
    ours = -np.linalg.lstsq(slopes, left, rcond=None)[0]
    assert ours == pytest.approx(step[:3])
    assert errors.values + errors.gain @ ours == pytest.approx(step[3:])
    covariance = np.linalg.inv(joint.T @ joint)
    free = np.linalg.inv(slopes.T @ slopes)
    assert free == pytest.approx(covariance[:3, :3])
    assert errors.total_covariance(free) == pytest.approx(covariance[3:, 3:])


def test_a_known_part_of_an_error_is_in_its_value_and_its_prior():
    """Simulated with a part of the errors, the joint problem has the same solution."""
    rng = np.random.default_rng(1)
    jacobian, columns = rng.standard_normal((40, 3)), rng.standard_normal((40, 5))
    residual, known = rng.standard_normal(40), rng.standard_normal(5)
    left, slopes, errors = nuisances.eliminated(residual, jacobian, columns)
    with_part, its_slopes, its_errors = nuisances.eliminated(
        residual + columns @ known, jacobian, columns, known)
    assert its_errors.values == pytest.approx(errors.values)
    assert its_slopes == pytest.approx(slopes)
    assert with_part @ with_part == pytest.approx(left @ left)


def test_points_that_are_far_off_are_simulated_where_they_are():
    """Beyond 4 mm from where the pull was simulated: of each pull, in the order of its points."""
    def listed(*values):
        return [{"name": f"position of point {k + 1} along the branch", "pull": "a", "value": value}
                for k, value in enumerate(values)] + [
                    {"name": "camera position x", "pull": None, "value": 1.0}]

    assert far_points(listed(1e-3, -3e-3), {}) is None
    far = far_points(listed(1e-3, -9e-3), {})
    assert far["a"] == pytest.approx([1e-3, -9e-3])
    assert far_points(listed(1e-3, -10e-3), far) is None


def test_a_cell_that_is_off_does_not_move_the_moduli(found):
    """2 mm of the gripper and a zero of nearly the whole force: every interval holds the truth,
    and none says that nothing is known.
    """
    low, high = found.uncertainty.young_interval.T
    assert np.all((low < TRUTH) & (TRUTH < high))
    assert np.all(high / low < 4)
    assert found.fit.converged and found.uncertainty.variance_factor < 1.3


def test_a_point_that_is_off_along_the_branch_is_told_as_that(small, small_bench, small_pull):
    """8 mm off, as where a scan's tip is short: not a shift of the camera to within 0.2 mm."""
    pull = measured(small_pull, 3, points=5e-4, force=0.01)
    places = np.array(small_pull.entry.rest_points_m)
    off = marked_points(small.skeleton, FRACTIONS, np.array([0.0, 0.0, 8e-3, 0.0]))
    entry = pull.entry.model_copy(update={
        "calibration": recording.CalibrationEntry(force_bias_sigma_n=0.0, force_drift_sigma_n=0.0),
        "rest_points_m": tuple(map(tuple, (2 * places - off).tolist()))})
    objective = objective_of(small_bench, replace(pull, entry=entry))
    evaluation = objective.evaluate(objective.space.pack(Values(TRUTH, 0.36, 900.0)), jacobian=True)
    listed = {each["name"]: each for each in nuisances.nuisance_records(
        objective.cell_errors.nuisances, evaluation.errors, np.zeros((4, 4)))}
    point = listed["position of point 3 along the branch"]
    assert point["value"] == pytest.approx(8e-3, abs=1.5e-3) and point["explains_misfit"]
    low, high = point["interval"]
    assert low < 8e-3 < high
    camera = listed["camera position z"]
    assert not camera["explains_misfit"]
    assert camera["interval"][1] - camera["interval"][0] > 1e-3
    # Without such an error the same pull has no place in the model.
    assert 2 * evaluation.objective < 1.5 * len(evaluation.residual)


def test_a_frame_is_put_right_by_its_fitted_turn(small_pull):
    """About the middle of the points at rest, as it was fitted."""
    turn, shift = np.array([0.2, -0.1, 0.15]), np.array([0.03, -0.02, 0.01])
    seen = small_pull.observations.positions
    middle = seen[0].mean(axis=0)
    wrong = middle + shift + rotated(turn, (seen - middle).reshape(-1, 3)).reshape(seen.shape)
    off = replace(small_pull, observations=replace(small_pull.observations, positions=wrong))
    errors = [{"name": f"camera {what} {axis}", "value": float(value)}
              for what, values in (("position", shift), ("rotation about", turn))
              for axis, value in zip("xyz", values, strict=True)]
    right = put_right(off, *fitted_frame(errors), middle).observations.positions
    assert right == pytest.approx(seen, abs=1e-9)


def test_pulls_of_one_cell_turn_about_one_point(small_bench, small_pull):
    """Each about the middle of its own points, one turn would be two frames."""
    turn = np.array([2e-3, -1e-3, 1.5e-3])
    known = recording.EXACT.model_copy(update={"camera_sigma_rad": 1e-3})
    seen = small_pull.observations
    pulls = [replace(small_pull, name=name, entry=small_pull.entry.model_copy(
        update={"calibration": known}), observations=replace(seen, positions=places))
        for name, places in (("a", seen.positions), ("b", 2 * seen.positions[:1] - seen.positions))]
    objective = small_bench.objective(pulls, SETTINGS)
    for number, pull in enumerate(pulls):
        places = objective.forwards[number].frames.positions
        slopes = objective.cell_errors.slopes(number, Simulated(places, np.zeros((len(places), 3))))
        wanted = np.cross(turn, places - objective.forwards[0].rest_points.mean(axis=0))
        assert slopes.positions @ (turn / 1e-3) == pytest.approx(wanted, abs=1e-9), pull.name


def test_an_untared_zero_is_free(small_bench, small, small_pull):
    """Stated as not tared, a zero of twice the force is found; otherwise it is an odd error."""
    peak = float(np.linalg.norm(small_pull.wrenches[:, :3], axis=1).max())
    wrenches = small_pull.wrenches.copy()
    wrenches[:, 0] += 2 * peak
    calibration = recording.CalibrationEntry(force_bias_sigma_n=0.01 * peak,
                                             force_drift_sigma_n=0.0)
    sigmas = []
    for is_tared in (True, False):
        entry = small_pull.entry.model_copy(update={
            "calibration": calibration,
            "sensor": small_pull.entry.sensor.model_copy(update={"tared": is_tared})})
        forward = forwards_of([replace(small_pull, entry=entry, wrenches=wrenches)],
                              subject_of(small_bench, small), SETTINGS)[0]
        sigmas.append(recording.calibration_of(forward.entry).force_bias_sigma_n)
    assert sigmas[0] == 0.01 * peak and sigmas[1] >= 2 * peak


@pytest.mark.slow
def test_a_free_frame_is_put_right_though_it_is_turned_far(small_bench, small, small_pull):
    """12 degrees and 5 cm off: with a frame that counts as known the same is no result."""
    turn, shift = np.radians([8.0, -7.0, 5.0]), np.array([0.05, -0.02, 0.01])
    seen = small_pull.observations.positions
    middle = seen.mean(axis=(0, 1))
    wrong = middle + shift + rotated(turn, (seen - middle).reshape(-1, 3)).reshape(seen.shape)
    entry = small_pull.entry.model_copy(update={"calibration": recording.EXACT.model_copy(
        update={"camera_sigma_m": 1e-3, "camera_sigma_rad": 1e-3})})
    pull = replace(small_pull, entry=entry,
                   observations=replace(small_pull.observations, positions=wrong))
    settings = SETTINGS.model_copy(update={
        "also": ("frame",), "field": "inverse_distance", "poisson_sigma": 0.0, "key_frames": 4,
        "mesh_check": False})
    found = fit_branch([pull], subject_of(small_bench, small), settings,
                       log=EvaluationLog(None, ""))
    assert found.is_bad is None
    assert found.values.young == pytest.approx(TRUTH, rel=0.1)
    assert 0.0 <= found.prospects.cost_of_the_frame() < 1.0


def test_directions_bend_with_the_branch(small, small_bench):
    """At rest along the axis; turned with a rigid rotation of all nodes."""
    mesh = small_bench.mesh
    coarse = small.mesh(slice_length=3.0, sides=8)
    found = PointDirections.at(mesh, small_bench.points)
    step = 1e-3 / small.length
    ahead, behind = (np.array([small.skeleton.point_at(each + sign * step)
                               for each in FRACTIONS]) for sign in (1, -1))
    axis = (ahead - behind) / np.linalg.norm(ahead - behind, axis=1, keepdims=True)
    for each in (found, PointDirections.at(coarse, small_bench.points)):
        assert np.degrees(np.arccos(np.sum(each.rest * axis, axis=1).clip(-1, 1))).max() < 0.5
    turn = Rotation.from_rotvec([0.3, -0.5, 0.2])
    moved = turn.apply(mesh.nodes) - mesh.nodes
    assert found.bent(moved) == pytest.approx(turn.apply(found.rest), abs=1e-6)


@pytest.mark.slow
def test_what_is_off_is_found_and_named(found):
    """Within its interval, and in a sentence that says how much."""
    errors = {each["name"]: each for each in found.cell_errors}
    true = {f"gripper rotation about {axis}": turn for axis, turn in zip("xyz", TURN, strict=True)}
    held = [each["interval"][0] - 2e-3 < value < each["interval"][1] + 2e-3
            for name, value in true.items() if (each := errors[name])]
    assert sum(held) >= 2
    sentence = nuisances.in_words(found.cell_errors)
    assert re.search(r"force zero x [+-][\d.e+-]+ N \(± ", sentence)
    assert nuisances.in_words([]) is None


def test_causes_add_up_to_the_variance(found):
    """The parts of all causes are the covariance's diagonal; each can be acted on."""
    sure = found.uncertainty
    parts = variance_parts(found.fit.evaluation, found.objective)
    total = np.sum(list(parts.values()), axis=0)
    plain = np.linalg.inv(found.fit.evaluation.jacobian.T @ found.fit.evaluation.jacobian)
    assert total == pytest.approx(np.diag(plain), rel=0.02)
    assert sure.variance_factor == pytest.approx(0.5, abs=0.6)
    named = largest(parts)
    assert len(named) == 3 and all(each["advice"] for each in named)
    assert named[0]["share"] >= named[1]["share"] >= named[2]["share"]


def test_a_path_is_watched_where_its_frame_may_be_off(small_pull):
    """Not where it is known exactly, the force was not measured, or the user says what drives."""
    frames = frames_of(small_pull)
    entry = small_pull.entry
    assert entry.calibration == recording.EXACT and not observes_path(entry, frames, SETTINGS)
    entry = entry.model_copy(update={"calibration": None})
    assert observes_path(entry, frames, SETTINGS)
    assert not observes_path(entry, frames, SETTINGS.model_copy(update={"drive": "pose"}))
    blind = replace(frames, wrenches=np.full_like(frames.wrenches, np.nan))
    assert not observes_path(entry, blind, SETTINGS)


def test_a_force_that_leads_nowhere_says_how_well_it_is_known(small_bench, small_pull, monkeypatch):
    """Where no equilibrium is found the sensor's zero is named, not the grasp point alone."""
    pull = replace(small_pull, entry=small_pull.entry.model_copy(update={"calibration": None}))
    objective = objective_of(small_bench, pull)
    monkeypatch.setattr(Objective, "evaluate", lambda *_, **__: None)
    with pytest.raises(WorkError, match=r"zero is known to 1 N and drifts by 1 N.*Tare the sensor"):
        fit_pulls(objective, objective.space.base, SETTINGS.model_copy(update={"young": 1e7}))


def test_calibration_survives_a_pull_file(tmp_path, small_pull):
    entry: recording.PullEntry = small_pull.entry.model_copy(
        update={"calibration": recording.CalibrationEntry(pose_sigma_m=2e-4)})
    recording.write_entry(tmp_path / "pull.toml", entry)
    assert recording.read_entry(tmp_path / "pull.toml").calibration == entry.calibration


@pytest.mark.slow
def test_a_path_that_leads_says_so_and_widens_the_interval(small_bench, small_pull):
    """Without a measured force the frame counts as exact in the fit: a millimetre of it enters the
    interval, ten times less of it ten times less, and where it is known exactly there is no word.
    """
    def found(**known):
        calibration = recording.EXACT.model_copy(update=known)
        pull = measured(small_pull, 3)
        pull = replace(pull, entry=pull.entry.model_copy(update={"calibration": calibration}))
        objective = small_bench.objective([pull], SETTINGS)
        evaluation = objective.evaluate(objective.space.pack(Values(TRUTH, 0.36, 900.0)),
                                        jacobian=True)
        return path_prescribed(objective.forwards), path_error(evaluation, objective)

    led, wide = found(pose_sigma_m=1e-3)
    assert [forward.name for forward in led] == ["pull-1"]
    assert wide.shape == (4,) and wide.max() > 0.1
    assert found(pose_sigma_m=1e-4)[1] == pytest.approx(wide / 10, rel=0.05)
    assert np.all(found(pose_sigma_m=1e-3, pose_sigma_rad=0.02)[1] > wide)
    assert path_prescribed(small_bench.objective([small_pull], SETTINGS).forwards) == []


def test_an_error_far_beyond_what_the_cell_states_gives_no_result():
    """Named with how far it is; what may well be is none."""
    gain = {"name": "force gain", "unit": "", "pull": "", "value": -0.7, "prior_sigma": 0.02}
    place = {"name": "gripper position x", "unit": "m", "pull": "", "value": 3e-3,
             "prior_sigma": 1e-3}
    assert ("force gain would have an error of -70 %. That is 35 times the standard deviation"
            in nuisances.unlikely([place, gain]))
    assert nuisances.unlikely([place]) is None and nuisances.unlikely([]) is None


@pytest.mark.slow
def test_points_aside_of_the_scanned_axis_move_no_modulus(small_bench, small):
    """A scanned axis 3 mm off at its points, each to another side.

    Not stated where they are, they are found there; stated on the axis, the moduli are wrong.
    """
    truth = small.truth()
    sides = np.random.default_rng(4).standard_normal((4, 3))
    sides *= 3e-3 / np.linalg.norm(sides, axis=1, keepdims=True)
    settings = PullSpec(young=small.young, poisson=small.poisson, frames=16, reach=0.4,
                        position_noise=0.0, force_noise=0.0, phase=0.3)
    pull = measured(simulate_pull(replace(truth, control_points=truth.control_points + sides),
                                  "pull-1", settings)[0], 3, points=5e-4, force=0.01)
    calibration = recording.CalibrationEntry(force_bias_sigma_n=0.02, force_drift_sigma_n=0.02)
    off = {}
    for name, places in (("stated", tuple(map(tuple, small_bench.points))), ("open", None)):
        entry = pull.entry.model_copy(update={"calibration": calibration, "rest_points_m": places})
        found = fit_branch([replace(pull, entry=entry)], subject_of(small_bench, small),
                           SETTINGS.model_copy(update={"mesh_check": False}),
                           log=EvaluationLog(None, ""))
        off[name] = np.abs(np.log(found.values.young / TRUTH)).max()
        interval = found.uncertainty.young_interval
    assert off["open"] < 0.5 * off["stated"]
    assert np.all((interval[:, 0] < TRUTH) & (TRUTH < interval[:, 1]))
    across = [each["value"] for each in found.cell_errors if "across the branch" in each["name"]]
    assert len(across) == 8 and 1.5e-3 < np.abs(across).max() < 4e-3


def test_a_point_aside_of_the_axis_turns_with_the_branch():
    """Its arm stays across the branch and as long, and moves least."""
    angle = np.linspace(0.0, 1.2, 5)
    directions = np.stack([0 * angle, np.sin(angle), np.cos(angle)], axis=1)[:, None]
    directions = np.concatenate([directions, directions[:, :, [1, 0, 2]]], axis=1)
    pull = nuisances._Pull(None, None, np.zeros(3), np.zeros(3), None, directions,
                           np.zeros((5, 2, 3)), None)
    arms = nuisances._across(pull)["positions"].reshape(5, 2, 3, 2, 2)
    assert not arms[:, 0, :, 1].any() and not arms[:, 1, :, 0].any()
    for point in range(2):
        own = arms[:, point, :, point]
        assert np.einsum("fik,fi->fk", own, directions[:, point]) == pytest.approx(0, abs=1e-12)
        assert np.einsum("fik,fil->fkl", own, own) == pytest.approx(np.stack(5 * [np.eye(2)]))
        about = np.cross(directions[0, point], directions[-1, point])
        assert own.swapaxes(1, 2) @ about == pytest.approx(np.stack(5 * [own[0].T @ about]))


@pytest.mark.slow
def test_a_zero_larger_than_the_force_ends_soon_with_a_wide_interval(small_bench, small,
                                                                     small_pull):
    """Readings up to nine times the force: few simulations, the truth inside, the zero named."""
    pull = measured(small_pull, 3)
    peak = float(np.linalg.norm(small_pull.wrenches[:, :3], axis=1).max())
    known = recording.CalibrationEntry(force_bias_sigma_n=3 * peak, force_drift_sigma_n=3 * peak)
    rng = np.random.default_rng(7)
    seen = CellErrors.drawn(known, rng).recorded(pull, rng)
    assert np.linalg.norm(seen.wrenches[:, :3], axis=1).max() > 9 * peak
    subject = subject_of(small_bench, small)
    found = fit_branch([seen], subject, SETTINGS.model_copy(update={
        "mesh_check": False, "key_frames": 4}), log=EvaluationLog(None, ""))
    low, high = found.uncertainty.young_interval.T
    assert found.is_bad is None and found.objective.forward_count < 60
    assert np.all((low < TRUTH) & (TRUTH < high)) and np.log(high / low).max() > 0.5
    assert "force zero" in nuisances.in_words(found.cell_errors)
