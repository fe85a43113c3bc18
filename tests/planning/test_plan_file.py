"""Plan files: the whole motion, and what is refused."""

import json
from dataclasses import replace

import numpy as np
import pytest

from limber.core.errors import InputError
from limber.planning.constraints.limits import Limits
from limber.planning.field.stored_states import States
from limber.planning.path_on_full_model import ResolvedPath
from limber.planning.plan_file import (
    limits_of_motion,
    path_record,
    plan_content,
    read_plan,
    whole_motion,
)
from limber.planning.search_files import BoundGrid, CostToGo
from limber.planning.settings import PlanSpec
from limber.planning.timing import Pace


def solved(xs):
    """States whose values tell where they are: x [m] alone changes."""
    xs = np.asarray(xs, float)
    poses = np.zeros((len(xs), 6))
    poses[:, 0] = xs
    vector = np.stack([xs, 0 * xs, 1 + xs], axis=1)
    return States(
        poses=poses, energies=xs**2, forces=vector, torques=0.1 * vector, strains=0.01 * xs,
        strain_places=vector, stresses=1e6 * xs, min_det_f=1.0 + 0 * xs, tips=2 * vector,
        targets=np.stack([vector, 3 * vector], axis=1),
        axial_forces=1 - xs, displacements=np.zeros((len(xs), 4, 3)))


def resolved(path, approach):
    return ResolvedPath(solved(path), solved(approach), np.empty((0, 3)), (), True)


@pytest.fixture
def path():
    return resolved([0.1, 0.15, 0.2], [0.0, 0.05])


def test_motion_goes_there_and_back(path):
    """Approach from rest, path, and back by the same states, which takes as long."""
    motion = whole_motion(path, ("flower", "leaf"))
    wanted = [0, 0.05, 0.1, 0.15, 0.2, 0.15, 0.1, 0.05, 0]
    np.testing.assert_allclose(motion.poses[:, 0], wanted)
    assert motion.phases == ("approach",) * 2 + ("path",) * 3 + ("return",) * 4
    assert motion.times[-1] > 0.4 / Pace().speed
    np.testing.assert_allclose(motion.times[4], motion.times[-1] / 2)
    assert (np.diff(motion.times) > 0).all()
    np.testing.assert_allclose(motion.targets["leaf"][:, 0], 3 * np.array(wanted))
    np.testing.assert_allclose(motion.torques, 0.1 * motion.forces)


def test_motion_from_rest_has_no_approach():
    """A path that begins at rest is not preceded by the same pose again."""
    motion = whole_motion(resolved([0.0, 0.1], [0.0]))
    np.testing.assert_allclose(motion.poses[:, 0], [0, 0.1, 0])
    assert motion.phases == ("path", "path", "return")


def test_limits_tell_their_margin(path):
    """Over the whole motion; what was not asked for is not there."""
    limits = limits_of_motion(whole_motion(path), Limits(force=2.0))
    both = limits_of_motion(whole_motion(path), Limits(axial_force=1.5, torque=1.0))
    assert both["axial_force_n"]["margin"] == pytest.approx(0.5)
    assert both["torque_nm"]["peak"] == pytest.approx(0.1 * np.hypot(0.2, 1.2))
    assert set(limits) == {"force_n"}
    assert limits["force_n"]["peak"] == pytest.approx(np.hypot(0.2, 1.2))
    assert limits["force_n"]["margin"] == pytest.approx(2.0 - np.hypot(0.2, 1.2))


def written(path, folder):
    ways = [path_record(path.solved, ("flower", "leaf"), field_energies=np.ones(3))] * 2
    motion = whole_motion(path, ("flower", "leaf"))
    summary = {"seed": 3, "baseline": {"length_m": 0.1}, "plan": {"length_m": 0.1}}
    file = folder / "plan.json"
    file.write_text(json.dumps(plan_content(
        summary, *ways, motion, limits_of_motion(motion, Limits(energy=0.1)))))
    return file


def test_what_is_written_is_read(path, tmp_path):
    """All columns, vectors as vectors; summary, limits and timing with them."""
    plan = read_plan(written(path, tmp_path))
    assert plan.summary["seed"] == 3
    assert plan.summary["timing"]["acceleration_m_s2"] == 0.1
    assert plan.summary["limits"]["energy_j"]["limit"] == 0.1 and plan.summary["robot"] is None
    motion = whole_motion(path, ("flower", "leaf"))
    for name in ("poses", "energies", "forces", "torques", "strains", "tips", "times"):
        np.testing.assert_allclose(getattr(plan.motion, name), getattr(motion, name))
    assert plan.motion.phases == motion.phases
    np.testing.assert_allclose(plan.plan.targets["flower"], path.solved.targets[:, 0])
    np.testing.assert_allclose(plan.plan.force_sizes, path.solved.force_sizes)
    assert plan.plan.joints is None


@pytest.mark.parametrize("robot", [[], 1.0, "ur5"])
def test_an_arm_that_is_no_object_is_refused(path, tmp_path, robot):
    """The report asked it for its model."""
    file = written(path, tmp_path)
    file.write_text(json.dumps(json.loads(file.read_text()) | {"robot": robot}))
    with pytest.raises(InputError, match="robot"):
        read_plan(file)


@pytest.mark.parametrize(("spoil", "words"), [
    (lambda content: content.update(format_version=3), "format 3"),
    (lambda content: content["plan"].update(forces_n=content["plan"]["energies_j"]), "no vectors"),
    (lambda content: content["plan"]["energies_j"].pop(), "unequal"),
    (lambda content: content.pop("motion"), "motion"),
    (lambda content: content["plan"]["poses"].__setitem__(0, [0.0] * 5), "not a plan"),
    (lambda content: content["motion"]["forces_n"][0].__setitem__(0, float("nan")), "finite"),
    (lambda content: content["plan"]["forces_n"][0].__setitem__(0, 1e200), "beyond"),
    (lambda content: content["plan"]["energies_j"].__setitem__(0, True), "not a number"),
])
def test_damaged_plans_are_refused(path, tmp_path, spoil, words):
    """With what is wrong; a newer format by its number."""
    file = written(path, tmp_path)
    content = json.loads(file.read_text())
    spoil(content)
    file.write_text(json.dumps(content))
    with pytest.raises(InputError, match=words):
        read_plan(file)


def test_joints_are_carried(path, tmp_path):
    """Where a robot is given its joint angles stand beside the poses."""
    way = replace(path_record(path.solved), joints=np.ones((3, 6)))
    summary = {"baseline": {}, "plan": {}}
    file = tmp_path / "plan.json"
    file.write_text(json.dumps(plan_content(summary, way, way, way, {})))
    np.testing.assert_array_equal(read_plan(file).motion.joints, np.ones((3, 6)))


def test_a_wood_limits_the_strain_to_half_of_what_it_breaks_at():
    """Cherry, 8,000 psi over 1.31 million psi, half of it; not together with another limit."""
    assert Limits.of(PlanSpec(wood="cherry")).strain == pytest.approx(0.00305, abs=1e-5)
    for wood in ("ash", "maple", "oak", "walnut"):
        assert 0.0025 < Limits.of(PlanSpec(wood=wood)).strain < 0.0035
    with pytest.raises(InputError, match="--max-strain and --wood"):
        Limits.of(PlanSpec(wood="oak", max_strain=0.01))


# What a plan's search leaves beside it: the bound comes back as it was, whole between cells.


def test_a_bound_is_kept_and_read_between_its_cells(tmp_path):
    """Linear costs are linear between centres, in the turned grid; an unknown cell takes its
    neighbour's; nothing is known outside."""
    axes = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    costs = np.tile(np.arange(4.0)[:, None, None], (1, 3, 3))
    costs[2, 1, 1] = np.nan
    file = tmp_path / "bound.npz"
    corner = np.array([1.0, 2.0, 3.0])
    CostToGo(axes, (BoundGrid(corner, np.full(3, 0.5), costs, np.isfinite(costs)),)).write(file)
    found = CostToGo.read(file)
    np.testing.assert_array_equal(found.grids[0].costs, costs)
    points = corner + 0.5 * np.array([[1.5, 0.5, 0.5], [1.25, 0.5, 1.0], [2.5, 1.5, 1.5],
                                            [9.0, 0.5, 0.5]]) @ axes
    np.testing.assert_allclose(found.at(points)[:2], [1.0, 0.75])
    assert found.at(points)[2] in (1.0, 2.0, 3.0) and np.isnan(found.at(points)[3])


def test_the_largest_bound_of_all_grids_counts_where_it_is_known(tmp_path):
    """A finer grid about a part only: its bound there, the first one's elsewhere and where that is
    larger."""
    coarse = BoundGrid(np.zeros(3), np.full(3, 0.1), np.full((4, 4, 4), 0.2),
                       np.ones((4, 4, 4), bool))
    tube, known = np.full((4, 8, 8), np.nan, np.float32), np.zeros((4, 8, 8), bool)
    tube[:, 3:6, 3:6], tube[:, 6:8, 3:6] = 0.7, 0.1
    known[:, 4, 4] = known[:, 7, 4] = True
    fine = BoundGrid(np.zeros(3), np.array([0.1, 0.05, 0.05]), tube, known)
    CostToGo(np.eye(3), (coarse, fine)).write(tmp_path / "bound.npz")
    places = np.array([[0.15, 0.225, 0.225], [0.15, 0.375, 0.225], [0.15, 0.1, 0.1]])
    found = CostToGo.read(tmp_path / "bound.npz").at(places)
    np.testing.assert_allclose(found, [0.7, 0.2, 0.2], rtol=1e-6)
