"""The messages that a client may send to a session, checked before they take effect.

One JSON object per line, UTF-8, at most ``LINE_LIMIT`` bytes. Every command may carry an ``id``,
which its reply repeats. An invalid line gets an ``error`` reply. Only ``close`` and the end of the
input end the session.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError, model_validator

from limber.core.errors import InputError
from limber.core.json_values import first_refusal, json_object
from limber.core.settings import GraspMode, Settings

PROTOCOL = 2
"""Version of commands, events and the frames' file; clients with another version are refused."""
LINE_LIMIT = 1 << 20
"""Longest line [bytes]; a longer line is discarded and reported."""
GRASP_LIMIT = 8
"""Most grasps at once."""
_FAR = 1e3
"""Largest coordinate [m]; beyond it a unit is wrong."""
_LARGEST_ID = 2**53
"""An id travels as a float64 with the frames."""

_Coordinate = Annotated[float, Field(ge=-_FAR, le=_FAR)]
_Component = Annotated[float, Field(ge=-1e6, le=1e6)]
_Vector = tuple[_Coordinate, _Coordinate, _Coordinate]
_Pose = tuple[_Coordinate, _Coordinate, _Coordinate, _Component, _Component, _Component]


class _Command(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, strict=True)

    id: int = Field(0, ge=0, le=_LARGEST_ID)


class _OnBranch(BaseModel):
    """A position on the branch: a vertex of the surface, or a point of the scanned branch [m]."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, strict=True)

    vertex: int | None = Field(None, ge=0)
    point: _Vector | None = None

    @model_validator(mode="after")
    def _one_position(self) -> "_OnBranch":
        if (self.vertex is None) == (self.point is None):
            raise ValueError("give a position as either `vertex` or `point`")
        return self


class Hello(_Command):
    """The client's version of the protocol."""

    command: Literal["hello"]
    protocol: int


class Grab(_Command, _OnBranch):
    """Hold the branch at the current location of a position."""

    command: Literal["grasp"]
    mode: GraspMode = "point"
    radius_m: float = Field(0.01, ge=0, le=_FAR)


class Release(_Command):
    """Release a grasp, or all."""

    command: Literal["release"]
    grasp: int | None = None


class Move(_Command):
    """Move a grasp (the first, if not named) to a pose [m, rad]."""

    command: Literal["move"]
    pose: _Pose
    grasp: int | None = None


class Gravity(_Command):
    """Switch the branch's weight on or off."""

    command: Literal["gravity"]
    on: bool


class Dynamics(_Command):
    """Switch between motion over time and equilibria."""

    command: Literal["dynamics"]
    on: bool


class Young(_Command):
    """Young's modulus at the control points [Pa]."""

    command: Literal["young"]
    young_pa: list[Annotated[float, Field(gt=0, le=1e15)]] = Field(max_length=10_000)


class Load(_OnBranch):
    """A dead load [N] at a position."""

    force_n: tuple[_Component, _Component, _Component]


class Loads(_Command):
    """Forces that hang on the branch, replacing the earlier ones: a fruit, a weight, wind."""

    command: Literal["loads"]
    loads: list[Load] = Field(max_length=1000)


class Fruit(BaseModel):
    """A mass [kg] at a position [m] on the branch as it was scanned."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, strict=True)

    point: _Vector
    mass_kg: float = Field(gt=0, le=1000)


class Weather(_Command):
    """Wind, snow, fruit and pruning cuts, replacing the earlier ones; see `limber load`."""

    command: Literal["outdoors"]
    wind_m_s: tuple[_Component, _Component, _Component] = (0.0, 0.0, 0.0)
    drag: float = Field(1.1, gt=0, le=5)
    snow_kg_m2: float = Field(0.0, ge=0, le=1000)
    fruit: list[Fruit] = Field([], max_length=1000)
    cuts: list[_Vector] = Field([], max_length=1000)


class RecordedWind(BaseModel):
    """A measured wind: times, and speeds along its mean direction."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, strict=True)

    time_s: list[Annotated[float, Field(ge=-1e12, le=1e12)]] = Field(max_length=30_000)
    speed_m_s: list[_Component] = Field(max_length=30_000)


class Effects(_Command):
    """Request the effects of wind, snow, fruit and cuts, as `limber load` does. With ``gust``, or a
    ``gust_record``, of whose wind only the direction is used, they are for the gusts' peak."""

    command: Literal["effects"]
    strain_limit: float = Field(0.01, gt=0, lt=1)
    limit_load: bool = False
    most: float = Field(50.0, gt=1, le=1e4)
    gust: float | None = Field(None, gt=0, le=1)
    gust_length_m: float = Field(27.0, gt=0, le=1000)
    gust_time_s: float = Field(600.0, ge=10, le=1e5)
    gust_record: RecordedWind | None = None

    @model_validator(mode="after")
    def _one_kind(self) -> "Effects":
        if self.gust is not None and self.gust_record is not None:
            raise ValueError("give either `gust` or `gust_record`, not both")
        return self


class Status(_Command):
    """Request the grasps, gravity and the model that answers."""

    command: Literal["status"]


class Close(_Command):
    """End the session."""

    command: Literal["close"]


Command = (Hello | Grab | Release | Move | Gravity | Dynamics | Young | Loads | Weather | Effects
           | Status | Close)
_COMMANDS: TypeAdapter[Command] = TypeAdapter(Annotated[Command, Field(discriminator="command")])


class NotUnderstood(InputError):
    """A line that is not a command; ``reply_id`` is that of the command, if it is known."""

    def __init__(self, seen: str, why: str = "", fix: str = "", *, reply_id: int = 0):
        super().__init__(seen, why, fix)
        self.reply_id = reply_id


def parse_command(line: bytes) -> Command:
    """Return the command of a line; NotUnderstood says why it is none, and names the known ones."""
    try:
        return _COMMANDS.validate_json(line, strict=True)
    except ValidationError as error:
        raise NotUnderstood(
            f"Not understood: {line[:200].decode(errors='replace').strip()}",
            f"{first_refusal(error)}.", "",
            reply_id=_id_of(line)) from None


def _id_of(line: bytes) -> int:
    """Return the id of a command that is otherwise invalid, 0 if it has none."""
    found = (json_object(line) or {}).get("id")
    if isinstance(found, int) and not isinstance(found, bool) and 0 <= found <= _LARGEST_ID:
        return found
    return 0


class Lines:
    """Cuts a stream of bytes into lines, in bounded memory. ``feed`` returns the complete lines
    that a chunk ends, None for one that was too long."""

    def __init__(self, limit: int = LINE_LIMIT):
        self._limit = limit
        self._part = bytearray()
        self._is_dropping = False

    def feed(self, piece: bytes) -> Iterator[bytes | None]:
        """Take a chunk; yield each line that ends in it, without its end."""
        *ended, rest = piece.split(b"\n")
        for end in ended:
            line = None if self._is_dropping or len(self._part) + len(end) > self._limit else (
                bytes(self._part) + end)
            self._part.clear()
            self._is_dropping = False
            yield line
        if self._is_dropping or len(self._part) + len(rest) > self._limit:
            self._part.clear()
            self._is_dropping = True
        else:
            self._part += rest


# The settings of a session.


class SessionSettings(Settings):
    """Options of `limber session`."""

    mode: GraspMode = Field(
        "rigid", description="rigid: the marked grasp holds position and rotation. "
            "point: it holds the position only.")
    grasp: bool = Field(True, description="Start with the marked grasp held. Otherwise no grasp "
        "is held.")
    gravity: bool = Field(True, description="The branch carries its own weight, as when it was "
        "scanned.")
    reduced: bool = Field(
        True, description="Learn a reduced model of the held branch. Otherwise the full model "
            "answers.")
    grasps: int = Field(160, ge=2, description="Number of full solutions to learn from.")
    size: int = Field(80, ge=13, description="Reduced coordinates.")
    fields: int = Field(130, ge=10, description="Reduced strain fields.")
    young_spread: float = Field(
        1.0, ge=1, description="Factor within which Young's modulus will change. 1: it is "
            "constant.")
    cache: bool = Field(True, description="Use and keep learnt models.")
    cache_folder: Path | None = Field(
        None, description="Folder for learnt models instead of the user's cache.")
    positions: Path | None = Field(
        None, description="File for the frames. Default: a temporary file.")
