"""Weight in estimates: a branch that hangs as it was scanned, whatever its modulus comes out as."""

import re
from dataclasses import replace

import numpy as np
import pytest
from tests.stages.specified import SpecifiedPull

from limber.core.progress import Progress
from limber.estimation.estimated_branch import forwards_of, subject_of
from limber.estimation.fit import fit_branch, fit_pulls
from limber.estimation.fitting.objective import EvaluationLog, Objective
from limber.estimation.forward.observed_path import ObservedPathForward
from limber.estimation.forward.solved_pull import QuasiStaticForward
from limber.estimation.parameters import ParameterSpace
from limber.estimation.settings import FitSpec, PullSpec
from limber.estimation.simulated_pull import TrueBranch, simulate_pull
from limber.geometry.tets.tet_mesh import mark
from limber.geometry.tets.tree_sweep import curved_beam
from limber.mechanics.added_masses import PointMass
from limber.recordings.recording import CalibrationEntry
from limber.stages.shape.mesh import Mesh
from limber.store import Branch

GRAVITY = (9.0, 0.0, -3.9)
TRUTH = np.array([1.2e8, 0.9e8, 0.7e8, 0.5e8])
SETTINGS = {"mesh_check": False, "shapes": 0, "hold_out": False, "key_frames": 4,
            "field": "inverse_distance"}  # that of the truth: nothing but weight is to be told


@pytest.fixture(scope="module")
def scanned(small):
    """Mesh and axes of a soft branch that lies nearly level, with a fruit on its tip."""
    skeleton = small.skeleton
    mesh = curved_beam(skeleton.nodes, skeleton.radius, slice_length=4.0, sides=5)
    return mark(mesh, skeleton, young=1e8, poisson=0.36, density=900.0), skeleton


def subject(scanned, **settings):
    mesh, skeleton = scanned
    fruit = (PointMass(tuple(skeleton.nodes[-1]), 0.02),)
    return subject_of(mesh, skeleton, fruit, GRAVITY, FitSpec(**SETTINGS, **settings))


@pytest.fixture(scope="module")
def pull(scanned):
    prestress = subject(scanned)
    truth = TrueBranch(prestress.mesh, prestress.skeleton, prestress.control_points,
                       (0.2, 0.4, 0.6, 0.8), TRUTH, GRAVITY)
    settings = PullSpec(frames=6, reach=0.15, position_noise=0.0, force_noise=0.0,
                        poisson=0.36, density=900.0, phase=0.4)
    made = simulate_pull(truth, "pull", settings)[0]
    assert not made.entry.weightless
    return made


def fitted(scanned, pull, **settings):
    about = FitSpec(**SETTINGS, **settings)
    start = replace(subject(scanned, **settings))
    if settings.get("gravity", True):
        # The truth has no fruit.
        start = replace(start, model=start.model.without_point_masses())
    forwards = forwards_of([pull], start, about)
    objective = Objective(forwards, ParameterSpace.separate(start.start), force_sigma=[0.01])
    return fit_pulls(objective, start.start, about).values.young


def test_estimate_knows_that_the_branch_hangs(scanned, pull):
    """Moduli come out exactly with weight; without it the model is another one, and they do not."""
    with_weight = fitted(scanned, pull)
    np.testing.assert_allclose(with_weight, TRUTH, rtol=2e-3)
    without = fitted(scanned, pull, gravity=False)
    assert np.abs(without / TRUTH - 1).max() > 5 * np.abs(with_weight / TRUTH - 1).max()


@pytest.mark.slow
@pytest.mark.parametrize(("softer", "noise", "stands"), [
    (300, 0.0, False), (40, 1.0, False), (20, 1.0, True)])
def test_a_branch_too_soft_for_its_weight_is_estimated_without(scanned, softer, noise, stands):
    """As other doors do: a warning, and the moduli of the pull as they are; with a density within
    its deviation though another would carry such a branch. Of one that stands it is told."""
    start, soft = subject(scanned), TRUTH / softer
    assert start.carries_itself(replace(start.start, young=soft)) == stands
    truth = TrueBranch(start.mesh, start.skeleton, start.control_points, (0.2, 0.4, 0.6, 0.8),
                       soft, GRAVITY, is_weightless=True)
    pull = simulate_pull(truth, "pull", PullSpec(
        frames=6, reach=0.15, position_noise=1e-3 * noise, force_noise=0.02 * noise, poisson=0.36,
        phase=0.4))[0]
    pull = replace(pull, entry=pull.entry.model_copy(update={"weightless": False}))
    messages: list[str] = []
    found = fit_branch([pull], start, FitSpec(**SETTINGS), log=EvaluationLog(None, ""),
                       progress=Progress(on_warning=messages.append))
    assert found.is_weightless != stands
    told = "density of 6.*4 standard deviations" if stands else "too soft to carry"
    assert any(re.search(told, text) for text in messages)
    if not stands:
        np.testing.assert_allclose(found.values.young, soft, rtol=0.02 + 0.14 * noise)


def test_where_the_force_leads_nowhere_the_path_leads(scanned, pull, monkeypatch):
    """No equilibrium under the measured force: said, and the gripper's path gives the moduli."""
    start = subject(scanned)
    start = replace(start, model=start.model.without_point_masses())
    known = CalibrationEntry(pose_sigma_m=1e-4, pose_sigma_rad=0.0)
    pull = replace(pull, entry=pull.entry.model_copy(update={"calibration": known}))
    monkeypatch.setattr(ObservedPathForward, "simulate", lambda *_, **__: None)
    messages: list[str] = []
    found = fit_branch([pull], start, FitSpec(**SETTINGS), log=EvaluationLog(None, ""),
                       progress=Progress(on_warning=messages.append))
    assert [forward.drive for forward in found.objective.forwards] == ["pose"]
    assert any("The gripper's recorded path is prescribed" in text for text in messages)
    np.testing.assert_allclose(found.values.young, TRUTH, rtol=2e-3)


def test_forward_derivatives_under_weight(scanned, pull):
    """Positions and forces to log E and log density against central differences, fruit and all."""
    start = subject(scanned)
    forward = forwards_of([pull], start, FitSpec(**SETTINGS))[0]
    assert isinstance(forward, QuasiStaticForward)
    values = replace(start.start, young=TRUTH)
    found = forward.simulate(values, ("density",), True)
    step = 1e-3
    for column in (0, 2, 4):
        changed = [replace(values, young=TRUTH * np.exp(sign * step * (np.arange(4) == column)),
                           density=900.0 * float(np.exp(sign * step * (column == 4))))
                   for sign in (1, -1)]
        ahead, behind = (forward.simulate(each, (), False) for each in changed)
        slope = (ahead.positions - behind.positions) / (2 * step)
        size = np.abs(found.slopes.positions).max()
        assert np.abs(found.slopes.positions[..., column] - slope).max() < 5e-3 * size
        slope = (ahead.forces - behind.forces) / (2 * step)
        assert np.abs(found.slopes.forces[..., column] - slope).max() < 5e-3 * np.abs(
            found.slopes.forces).max()


@pytest.mark.slow
def test_virtual_pull_takes_the_body_that_was_meshed(tmp_path):
    """After `limber mesh --up`: its own tetrahedra, under gravity as it was turned with them."""
    from trimesh.creation import box

    box(extents=(0.3, 0.012, 0.006)).export(tmp_path / "slat.stl")

    folder = tmp_path / "slat.branch"
    Mesh(surface=tmp_path / "slat.stl", output=folder, up=(0.0, 0.0, 1.0), unit="m",
         root=(-0.15, 0.0, 0.0)).run()
    gravity = np.array(Branch.open(folder).gravity)
    assert abs(gravity[2]) < 1e-6 * np.linalg.norm(gravity), "the slat lay level"
    settings = PullSpec(young=(3e9,) * 4, weight=0.5, frames=2, position_noise=0.0)
    SpecifiedPull.of(settings, branch_folder=folder, name="hung").run()
    from limber.recordings.recording import read_pull

    hung = read_pull(folder / "pulls" / "hung")
    assert not hung.entry.weightless
    moved = hung.poses[-1, :3] - hung.poses[0, :3]
    # It bends about its thin side, and to where weight points: a round rod would be stiffer.
    arm = 0.92 * 0.3
    thin = 0.5 * arm**3 / (3 * 3e9 * 0.012 * 0.006**3 / 12)
    assert np.dot(moved, gravity) / np.linalg.norm(gravity) == pytest.approx(thin, rel=0.1)
