"""The maker's own simulator, where a user has one: LIMBER_URSIM=address scripts/test.

URSim simulates no force sensor, so the guard refuses it: it is read, and moved without the guard.
Its model is that of LIMBER_URSIM_MODEL, by default ur5e. The virtual robot passes the same tests.
Runs at another address than this computer's are logged for the guide's page "How right is it".
"""

import os
import time
from contextlib import closing
from pathlib import Path
from runpy import run_path

import numpy as np
import pytest

from limber.cell.cell_file import Cell
from limber.robot.driver.controls import calibration_of
from limber.robot.ur.ur_control import UrControl

pytest.importorskip("rtde_control")
ADDRESS = os.environ.get("LIMBER_URSIM", "")
MODEL = os.environ.get("LIMBER_URSIM_MODEL", "ur5e")
pytestmark = pytest.mark.skipif(
    not ADDRESS, reason="no simulator of Universal Robots: LIMBER_URSIM names its address")
_TURN_RAD = 0.02


@pytest.fixture
def cell() -> Cell:
    return Cell(robot={"model": MODEL, "address": ADDRESS}, base={"pose": (0,) * 6},
                tool={"grasp_pose": (0, 0, 0.1, 0, 0, 0), "mass_kg": 0.5},
                sensor={"kind": "controller" if MODEL.endswith("e") else "ft300"})


@pytest.fixture(scope="module", autouse=True)
def _logged(request):
    failed = request.session.testsfailed
    yield
    if not ADDRESS.startswith("127."):
        page = run_path(str(Path(__file__).parents[2] / "worker/docs/accuracy_page.py"))
        page["log_ursim"](ADDRESS, MODEL, request.session.testsfailed == failed)


def test_its_state_is_read_and_its_arm_is_the_cells(cell):
    with closing(UrControl(cell)) as control:
        samples = [sample for _ in range(20) for sample in control.read(1.0)]
    clocks = np.array([sample.clock for sample in samples])
    assert np.diff(clocks) == pytest.approx(np.full(len(clocks) - 1, 1 / cell.arm.rate), abs=1e-4)
    sample = samples[-1]
    nominal = cell.arm.forward(sample.joints)
    calibration = calibration_of(cell)
    assert calibration is not None, "Kinematics Info was not sent on the primary interface"
    assert calibration.off_nominal(cell.arm, sample.joints)[0] < 0.02
    if sample.tool is not None and not sample.tool.any():
        assert sample.pose[:3] == pytest.approx(nominal[:3, 3], abs=0.02)


@pytest.mark.slow
def test_it_follows_targets_stops_and_gets_its_settings_back(cell):
    """Slow: in real time. The last wrist turns by a degree; then tool and payload are restored."""
    with closing(UrControl(cell)) as control:
        before = control.read(1.0)[-1]
        control.connect()
        assert control.program_runs()
        control.skip()
        start = control.read(1.0)[-1].joints
        steps = int(1.0 * control.rate)
        sample = before
        for step in range(steps):
            target = start + [0, 0, 0, 0, 0, _TURN_RAD * min(1.0, 2 * step / steps)]
            assert control.servo_joints(target)
            sample = (control.read(0.1) or [sample])[-1]
        assert control.end_motion()
        for _ in range(int(0.3 * control.rate)):
            assert control.keep_alive()
            sample = (control.read(0.1) or [sample])[-1]
        assert sample.joints - start == pytest.approx([0, 0, 0, 0, 0, _TURN_RAD], abs=2e-3)
        assert np.abs(sample.joint_speeds).max() < 1e-2
        if sample.tool is not None:
            assert sample.tool == pytest.approx(cell.tool.grasp_pose, abs=1e-6)
            assert control.put_back() is None
            control.skip()
            time.sleep(0.1)
            after = control.read(1.0)[-1]
            assert after.tool == pytest.approx(before.tool, abs=1e-6)
