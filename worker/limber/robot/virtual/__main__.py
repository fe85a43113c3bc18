"""``python -m limber.robot.virtual``: the process that :class:`VirtualRobot` starts; the first line
of its input states the robot.
"""

import json
import sys
from pathlib import Path

from limber.core.errors import LimberError
from limber.robot.driver.real_time import VIRTUAL_ROBOT_PRIORITY, claim_real_time
from limber.robot.virtual.branch_solver import BranchSetting
from limber.robot.virtual.controller import Controller
from limber.robot.virtual.gripped_branch import HeldBranch
from limber.robot.virtual.launch import serve


def main() -> int:
    """Serve a virtual robot until standard input ends; returns an exit code."""
    asked = json.loads(sys.stdin.readline())
    address, held = asked.pop("address"), asked.pop("branch")
    try:
        load = held and HeldBranch(BranchSetting(**{**held, "mesh": Path(held["mesh"])}))
        controller = Controller(load=load, **asked)
        claim_real_time(VIRTUAL_ROBOT_PRIORITY)
        serve(controller, address, control=True)
    except LimberError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
