"""The place of the branch that the mouse holds, and what it is kept for."""

import enum
from dataclasses import dataclass

from mathutils import Vector


class Kept(enum.Enum):
    """Use of a grab that is kept."""

    MOTION = "RET"
    START = "S"
    GOAL = "G"


@dataclass
class Hold:
    """The place that the mouse holds.

    Attributes:
        rest: Position of that place on the branch as scanned [m]; once the grasp is known, its
            centre there.
        begin: Its position when the mouse took it, in the world.
        asked: Number of the command that the session answers with the grasp.
        number: Number of the grasp, None until it is known.
        position: Position of the grasp when it was taken [m].
        wanted: Target position [m].
        is_dragged: Whether the mouse button is down.
    """

    rest: Vector
    begin: Vector
    asked: int
    number: int | None = None
    position: Vector | None = None
    wanted: Vector | None = None
    is_dragged: bool = True
