"""What a cell with errors records of a pull, and what a virtual pull states of them."""
import shutil

import numpy as np
import pytest
from tests.stages.specified import SpecifiedPull

from limber.core.constants import GRAVITY
from limber.core.errors import InputError
from limber.core.numerics.rigid import rotated
from limber.estimation.settings import PullSpec, VirtualPullSettings
from limber.estimation.simulated_pull import (
    DEFAULT_YOUNG_PA,
    CellErrors,
    true_branch,
)
from limber.geometry.skeleton.assumed_modulus import MOST_TURN, assumed_young, turn_by_weight
from limber.geometry.skeleton.skeleton import Skeleton
from limber.recordings.recording import (
    EXACT,
    CalibrationEntry,
    GraspEntry,
    Observations,
    Pull,
    PullEntry,
    read_pull,
)
from limber.stages.pulls.virtual_pull import VirtualPull
from limber.store import Branch

POINT = (0.0, 0.0, 0.3)


def drawn(seed: int = 0, **known: float) -> tuple[Pull, CellErrors, Pull]:
    """An exact pull, the errors of a cell, and what it records."""
    rng = np.random.default_rng(seed)
    times = np.linspace(0.0, 3.0, 13)
    poses = np.hstack([POINT + 0.01 * np.c_[times, 0 * times, 0 * times],
                       0.1 * np.c_[0 * times, times, 0 * times]])
    wrenches = np.c_[times, -times, 0 * times, np.zeros((13, 3))]
    points = np.tile([[0.0, 0.0, 0.1], [0.0, 0.0, 0.2]], (13, 1, 1)) + 0.003 * (
        times[:, None, None] * [1.0, 0.0, 0.0])
    exact = Pull("a", PullEntry(source="here", grasp=GraspEntry(point_m=POINT, radius_m=0.01)),
                 times, poses, wrenches, Observations(times, points))
    exactly = EXACT.model_copy(update={"pose_noise_m": 1e-12, **known})
    errors = CellErrors.drawn(exactly, rng)
    return exact, errors, errors.recorded(exact, rng)


def test_an_exact_cell_records_what_happens():
    exact, _, seen = drawn()
    np.testing.assert_allclose(seen.poses, exact.poses, atol=1e-9)
    np.testing.assert_allclose(seen.wrenches, exact.wrenches, atol=1e-12)
    np.testing.assert_allclose(seen.observations.positions, exact.observations.positions,
                               atol=1e-12)


def test_a_gripper_frame_turns_about_the_grasp():
    exact, errors, seen = drawn(pose_sigma_m=1e-3, pose_sigma_rad=0.02)
    moved = exact.poses[:, :3] - POINT
    np.testing.assert_allclose(
        seen.poses[:, :3], POINT + errors.gripper_offset + rotated(errors.gripper_turn, moved),
        atol=1e-9)
    assert np.linalg.norm(errors.gripper_turn) > 0.005


def test_gain_zero_and_drift_of_the_force():
    """At the first frame the zero alone is off, and the drift grows from there."""
    exact, errors, seen = drawn(force_gain_sigma=0.1, force_bias_sigma_n=1.0,
                                force_drift_sigma_n=2.0)
    left = seen.wrenches[:, :3] - errors.force_gain * exact.wrenches[:, :3]
    assert abs(errors.force_gain - 1) > 0.005 and np.linalg.norm(left[0]) > 0.1
    drift = np.linalg.norm(left - left[0], axis=1)
    assert (np.diff(drift) > 0).all() and drift[-1] > 0.1


def test_errors_scatter_as_the_calibration_states():
    places = np.array([CellErrors.drawn(CalibrationEntry(), np.random.default_rng(seed)
                                        ).gripper_offset for seed in range(400)])
    assert places.std() == pytest.approx(1e-3, rel=0.1)


def test_a_virtual_pull_states_what_was_drawn(branch_folder):
    """The calibration goes into the fit's prior, the drawn errors into the truth alone."""
    settings = PullSpec(frames=4, cell_errors="realistic", seed=2,
                        known={"force_bias_sigma_n": 0.0})
    SpecifiedPull.of(settings, branch_folder=branch_folder, name="real").run()
    entry = read_pull(branch_folder / "pulls" / "real").entry
    assert entry.calibration == CalibrationEntry().model_copy(update={"force_bias_sigma_n": 0.0})
    known = entry.truth["cell_errors"]
    assert abs(known["force_gain"] - 1) < 0.1 and np.linalg.norm(known["gripper_place_m"]) > 1e-4
    other = read_pull(branch_folder / "pulls" / "pull-1").entry
    assert other.calibration == EXACT and "cell_errors" not in other.truth


def test_an_assumed_modulus_carries_the_branch():
    """A lying cantilever: q L^3 / (6 E I) at its end. One that turns too far is stiffer."""
    count, radius = 101, 0.01
    for length in (0.4, 1.6):
        rod = Skeleton.from_edges(np.linspace((0, 0, 0), (length, 0, 0), count),
                                  np.arange(-1, count - 1), np.full(count, radius))
        turn = 4 * 900 * GRAVITY[2] * length**3 / (6 * 1e8 * radius**2)
        young = np.full(count, 1e8)
        assert turn_by_weight(rod, young, 900.0, GRAVITY) == pytest.approx(-turn, rel=0.02)
        assert assumed_young(rod, 900.0, GRAVITY) == pytest.approx(
            1e8 * max(1.0, -turn / MOST_TURN), rel=0.05)
        assumed = true_branch(rod, PullSpec(density=900.0))
        ratio = assumed.young / DEFAULT_YOUNG_PA
        assert np.ptp(ratio) == pytest.approx(0)
        assert ratio[0] == 1.0 if length < 1 else ratio[0] > 1.5
        turned = turn_by_weight(rod, assumed.young_at(rod.nodes), 900.0, GRAVITY)
        assert turned == pytest.approx(MOST_TURN) or ratio[0] == 1.0


def test_each_branch_has_its_own_shape_and_cell(branch_folder, tmp_path, small, small_bench):
    """A joint fit takes its pulls as of one branch in one cell, wherever the folder is and whatever
    the seed, which draws zero and points."""
    rng = np.random.default_rng(1)
    scan = small_bench.mesh.nodes + 1e-3 * rng.standard_normal(small_bench.mesh.nodes.shape)
    shapes, cells = [], []
    for seed, source in ((3, "1f"), (4, "1f"), (3, "ab" * 32)):
        settings = PullSpec(frames=4, cell_errors="realistic", seed=seed)
        shapes.append(true_branch(small.skeleton, settings, scan=scan, source=source
                                  ).skeleton.nodes)
        folder = shutil.copytree(branch_folder, tmp_path / f"{len(cells)}.branch")
        manifest = Branch.open(folder).manifest
        manifest.source["sha256"] = source
        (folder / "branch.json").write_text(manifest.text(), encoding="utf-8")
        SpecifiedPull.of(settings, branch_folder=folder, name="other").run()
        cells.append(read_pull(folder / "pulls" / "other").entry.truth["cell_errors"])
    assert np.array_equal(*shapes[:2]) and not np.allclose(*shapes[1:])
    shifts = [cell.pop("point_shifts_m") for cell in cells]
    assert cells[0] == cells[1] != cells[2] and shifts[0] != shifts[1]


def test_depth_images_have_no_such_errors(branch_folder):
    with pytest.raises(InputError, match="--camera cannot be combined"):
        VirtualPull(branch_folder=branch_folder, name="seen", frames=4, camera=True,
                    cell_errors="realistic").run()


def test_errors_can_be_stated_in_a_file(branch_folder, tmp_path):
    """What its table states not is as by default; a change of the file runs the stage again."""
    file = tmp_path / "sensor.toml"
    file.write_text("[calibration]\nforce_bias_sigma_n = 0.01\n")
    settings = VirtualPullSettings(frames=4, cell_errors=str(file))
    SpecifiedPull.of(settings, branch_folder=branch_folder, name="small").run()
    path = branch_folder / "pulls" / "small"
    assert read_pull(path).entry.calibration == CalibrationEntry(force_bias_sigma_n=0.01)
    file.write_text("[calibration]\nforce_bias_sigma_n = 0.02\n")
    SpecifiedPull.of(settings, branch_folder=branch_folder, name="small").run()
    assert read_pull(path).entry.calibration == CalibrationEntry(force_bias_sigma_n=0.02)
    file.write_text("[calibration]\nbias = 0.02\n")
    with pytest.raises(InputError, match="bias"):
        SpecifiedPull.of(settings, branch_folder=branch_folder, name="small").run()
