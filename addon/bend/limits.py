"""The limits of the plan while the branch is held: the fraction reached, in words and as colour."""

from dataclasses import dataclass

import bpy
import gpu
import numpy as np
from gpu_extras.batch import batch_for_shader

from .. import properties
from ..bridge import meshes
from ..jobs.stages import stages
from .session import HeldFrame

_TINT = "limber_limit"
"""Attribute of the branch's colours while it exceeds a limit."""
_OVER_LINEAR = (0.80, 0.02, 0.02)
_FAR, _NEAR, _OVER = (0.35, 0.85, 0.40), (1.0, 0.80, 0.20), (1.0, 0.20, 0.15)
_NEAR_SHARE = 0.7
_TIMES = 10.0
"""Fraction above which it is shown as a multiple of the limit."""
_RING_PIXELS, _RING_CORNERS = 11.0, 24


@dataclass(frozen=True)
class Reached:
    """Fraction of a limit that is reached: 1 at the limit."""

    title: str
    share: float

    @property
    def words(self) -> str:
        """The displayed text."""
        if self.share >= _TIMES:
            return f"{self.share:.0f} times the plan's {self.title}"
        return f"{100 * self.share:.0f} % of the plan's {self.title}"


def reached(scene: bpy.types.Scene, frame: HeldFrame) -> list[Reached]:
    """Return the limits that are set for the plan, the one with the highest fraction first."""
    limits = properties.group_of(scene, stages()["plan"])
    held = {"max_force": ("force", sum(part * part for part in frame.force) ** 0.5),
            "max_energy": ("energy", frame.energy), "max_strain": ("strain", frame.strain)}
    found = [Reached(title, value / getattr(limits, name)) for name, (title, value) in held.items()
             if getattr(limits, properties.OPEN + name)]
    return sorted(found, key=lambda one: one.share, reverse=True)


def colour_of(share: float) -> tuple[float, float, float, float]:
    """Return the colour of a fraction: green, yellow from 70 % on, red from the limit on."""
    if share >= 1.0:
        return (*_OVER, 1.0)
    part = min(max(share, 0.0) / _NEAR_SHARE, 1.0)
    return (*(far + part * (near - far) for far, near in zip(_FAR, _NEAR, strict=True)), 1.0)


class Tint:
    """Shows the whole branch in red while it exceeds a limit, and then restores its colours."""

    def __init__(self, surface: bpy.types.Object):
        self._surface = surface
        self._before: str | None = None

    @property
    def is_on(self) -> bool:
        return self._before is not None

    def show(self, on: bool) -> None:
        """Turn the tint on or off; safe to call again."""
        mesh = self._surface.data
        if on == self.is_on:
            return
        if on:
            active = mesh.color_attributes.active_color
            self._before = active.name if active is not None else ""
            meshes.set_one_color(mesh, _OVER_LINEAR, _TINT)
            return
        before, self._before = self._before, None
        mesh.color_attributes.remove(mesh.color_attributes[_TINT])
        if before and before in mesh.color_attributes:
            mesh.color_attributes.active_color = mesh.color_attributes[before]
        mesh.update_tag()


def draw_ring(place: tuple[float, float], share: float | None, size: float) -> None:
    """Draw a ring about a position in the view [pixels], coloured by a fraction; white without."""
    turns = np.linspace(0.0, 2 * np.pi, _RING_CORNERS + 1)
    corners = np.column_stack([np.cos(turns), np.sin(turns)]) * _RING_PIXELS * size + place
    shader = gpu.shader.from_builtin("UNIFORM_COLOR")
    gpu.state.blend_set("ALPHA")
    gpu.state.line_width_set(4.0 * size)
    shader.bind()
    shader.uniform_float("color", (1.0, 1.0, 1.0, 0.9) if share is None else colour_of(share))
    batch_for_shader(shader, "LINE_STRIP", {"pos": corners.tolist()}).draw(shader)
    gpu.state.line_width_set(1.0)
    gpu.state.blend_set("NONE")
