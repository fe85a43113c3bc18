"""From the coordinates of the file that a branch was made from to the branch's, and back."""

from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, field_validator

_Row = tuple[float, float, float]
_Place = Annotated[float, Field(ge=-1e8, le=1e8)]
"""A coordinate [m]: ten times farther than any on the Earth, and still exact to a micrometre."""


class Alignment(BaseModel):
    """From the input file's coordinates to the branch's: ``x = rotation (scale * p - origin)``.

    ``scale`` is metres per input unit, ``origin`` [m] the recentring in scaled input axes,
    ``rotation`` the upright rotation. All three are kept so that a result can be transformed back.
    """

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    scale: float = Field(1.0, ge=1e-7, le=1e6)
    origin: tuple[_Place, _Place, _Place] = (0.0, 0.0, 0.0)
    rotation: tuple[_Row, _Row, _Row] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))

    @field_validator("rotation")
    @classmethod
    def _is_a_turn(cls, rows: tuple[_Row, _Row, _Row]) -> tuple[_Row, _Row, _Row]:
        turn = np.array(rows)
        if not np.abs(turn @ turn.T - np.eye(3)).max() < 1e-3:
            raise ValueError("a rotation matrix must have orthogonal rows of length 1")
        return rows

    def apply(self, points: np.ndarray) -> np.ndarray:
        """Transform input coordinates, shape [n, 3], to branch coordinates [m]."""
        return (np.asarray(points) * self.scale - self.origin) @ np.array(self.rotation).T

    def apply_metres(self, points: np.ndarray) -> np.ndarray:
        """Transform input coordinates in metres, shape [..., 3], to branch coordinates [m]."""
        return self.apply(np.asarray(points) / self.scale)

    def undo(self, points: np.ndarray) -> np.ndarray:
        """Transform branch coordinates [m], shape [n, 3], back to those of the input file."""
        return (np.asarray(points) @ np.array(self.rotation) + self.origin) / self.scale
