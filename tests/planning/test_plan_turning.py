"""The torque of a gripper that turns the branch: second order, and on the full model."""

from types import SimpleNamespace

import numpy as np
import pytest
from tests.stages.specified import Planned

from limber.cell.cell_file import Cell
from limber.core.errors import InputError, NoPathError
from limber.planning.constraints.limits import Limits
from limber.planning.path_on_full_model import resolve_path
from limber.robot.motion.execution import Turned
from limber.stages.paths import plan_cell
from limber.stages.paths.plan_cell import Clamped, turned_by


@pytest.fixture(scope="module")
def clamped(small_model):
    """The small branch at six states along a way aside."""
    rest = small_model.rest_position
    way = rest + np.linspace(0.0, 1.0, 7)[:, None] * [0.03, 0.0, -0.002]
    return Clamped.of(small_model, resolve_path(small_model, way, rest[None]).ahead)


def test_the_torque_is_second_order_in_the_offset(clamped):
    """Twice the offset has four times the error, which is small; the energy is its integral."""
    share = np.linspace(0.0, 1.0, len(clamped.rows))[:, None]
    errors = []
    for size in (0.04, 0.08):
        offsets = share * [size, 0.5 * size, 0.0]
        found = clamped.checked(offsets, Limits())
        assert found["torque_error_nm"] < 0.1 * found["peak_torque_nm"]
        errors.append(found["torque_error_nm"])
    assert 2.5 < errors[1] / errors[0] < 6.0
    slope = (clamped.cost.energy(1.001 * offsets) - clamped.cost.energy(0.999 * offsets)) / 0.002
    work = (clamped.cost.wrench(offsets)[:, 3:] * offsets).sum(axis=1)
    assert slope == pytest.approx(work, rel=0.02, abs=1e-9)
    with pytest.raises(NoPathError, match=r"torque .* on the full model"):
        clamped.checked(offsets, Limits(torque=0.5 * found["peak_torque_nm"]))


def test_an_offset_never_needs_the_torque_at_which_the_guard_stops(clamped, monkeypatch):
    """Where no limit of torque is given either."""
    monkeypatch.setattr(plan_cell.Clamped, "of", lambda *_: clamped)
    allowed = []

    def motion(_cell, _predicted, _axis, cost, _slack, most, **_asked):
        allowed.append(most)
        none = np.zeros((len(cost.along), 3))
        return Turned(None, none, none[:, 0], none[:, 0])
    monkeypatch.setattr(plan_cell, "turned_motion", motion)
    cell = Cell(robot={"model": "ur5e"}, base={"pose": (0.6, 0, 0, 0, 0, 0)},
                limits={"hard_torque_nm": 2.0})
    states = SimpleNamespace(poses=np.repeat(clamped.poses, 2, axis=0))
    model = SimpleNamespace(reach=SimpleNamespace(axis=None))
    turned_by(cell, None, model, states, 0.3, Limits(force=1e3))
    assert allowed == [(1e3, 1.6)]


def test_a_slack_without_an_arm_is_refused(planned_branch):
    with pytest.raises(InputError, match="--turn-slack is given without --cell"):
        Planned(branch_folder=planned_branch, turn_slack=0.2, name="turned").run()
