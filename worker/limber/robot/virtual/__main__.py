"""``python -m limber.robot.virtual``: the process that :class:`VirtualRobot` starts."""

import argparse
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
    parser = argparse.ArgumentParser(prog="python -m limber.robot.virtual", description=__doc__)
    parser.add_argument("--model", default="ur5e")
    parser.add_argument("--address", default="127.0.0.1")
    parser.add_argument("--joints", type=float, nargs=6, metavar="RAD")
    parser.add_argument("--mass", type=float, default=0.0, help="kg at the flange")
    parser.add_argument("--centre", type=float, nargs=3, default=(0.0, 0.0, 0.0), help="m")
    parser.add_argument("--ft300", action="store_true")
    parser.add_argument("--robotiq", action="store_true", help="serve a gripper on port 63352")
    parser.add_argument("--off-nominal", type=float, default=0.0,
                        help="m, of each length of the arm")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--branch", type=Path, help="JSON file of a BranchSetting")
    options = parser.parse_args()
    try:
        load = None
        if options.branch is not None:
            known = json.loads(options.branch.read_text(encoding="utf-8"))
            load = HeldBranch(BranchSetting(**{**known, "mesh": Path(known["mesh"])}))
        controller = Controller(options.model, joints=options.joints, mass=options.mass,
                                centre=tuple(options.centre), seed=options.seed,
                                ft300=options.ft300, robotiq=options.robotiq, load=load,
                                off_nominal=options.off_nominal)
        claim_real_time(VIRTUAL_ROBOT_PRIORITY)
        serve(controller, options.address, control=True)
    except LimberError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
