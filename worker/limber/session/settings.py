"""What a session is started with."""

from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field


class SessionSettings(BaseModel):
    """Options of `limber session`."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    mode: Literal["clamped", "pinned"] = Field(
        "clamped", description="What the marked grasp holds: the pose, or the position alone.")
    grasp: bool = Field(True, description="Start with the marked grasp held; else nothing is.")
    gravity: bool = Field(True, description="The branch bears its weight, and was scanned so.")
    reduced: bool = Field(
        True, description="Learn a reduced model of what is held; else the full one answers.")
    grasps: int = Field(160, ge=2, description="Full solutions to learn from.")
    size: int = Field(80, ge=13, description="Reduced coordinates.")
    fields: int = Field(130, ge=10, description="Reduced strain fields.")
    young_spread: float = Field(
        1.0, ge=1, description="Factor within which Young's modulus will change; 1: it stays.")
    cache: bool = Field(True, description="Use and keep learnt models.")
    cache_folder: Path | None = Field(
        None, description="Folder for learnt models instead of the user's cache.")
    positions: Path | None = Field(
        None, description="File for the frames instead of a temporary one.")
