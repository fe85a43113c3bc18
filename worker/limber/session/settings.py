"""The settings of a session."""

from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field

from limber.core.settings import GraspMode


class SessionSettings(BaseModel):
    """Options of `limber session`."""

    model_config = ConfigDict(extra="forbid", frozen=True)

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
