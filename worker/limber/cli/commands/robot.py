"""Check, calibrate and move a robot: `limber robot check`, `goto-start`, `retreat` and others."""

import click

from limber.cli.robot_commands.calibrate import calibrate
from limber.cli.robot_commands.check import check
from limber.cli.robot_commands.draw import draw
from limber.cli.robot_commands.moves import goto_start, home, open_gripper, release, retreat
from limber.cli.robot_commands.new_cell import new_cell
from limber.cli.robot_commands.scan import scan
from limber.cli.robot_commands.weigh import weigh


@click.group("robot")
def command() -> None:
    """Check a robot, calibrate where it stands, and move it by itself."""


for each in (new_cell, draw, check, weigh, calibrate, scan, home, goto_start, retreat, release,
             open_gripper):
    command.add_command(each)
