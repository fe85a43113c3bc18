"""Wind, snow, fruit, cuts and weight on a branch held by a session, as set by the sliders.

The settings are those of the worker's stage `load`: loads tried by hand can then be run there.
"""

from typing import Any

import bpy
import numpy as np

from .. import properties
from ..jobs.stages import SettingError, rows_of, stages
from ..jobs.steps import PLACES
from .session import HeldFrame, Session

_MASK = "Limber cut"
_NOTHING = {"wind_m_s": [0.0] * 3, "snow_kg_m2": 0.0, "fruit": [], "cuts": []}
lines: list[str] = []
"""Text of the panel while a branch is held."""


class LiveLoads:
    """Sends the sliders' settings to a session, one request at a time.

    Args:
        scene: Scene of the settings.
        surface: The branch; parts that are cut off are hidden there until :meth:`end`.
    """

    def __init__(self, scene: bpy.types.Scene, surface: bpy.types.Object):
        self._scene, self._surface = scene, surface
        self._group = properties.group_of(scene, stages()["load"])
        self._before = {name: getattr(self._group, name) for name in PLACES}
        self._sent = {**_NOTHING}
        self._weighs = True
        self._asked: int | None = None
        self._reply: dict[str, Any] = {}
        self._left: np.ndarray | None = None
        self.error = ""

    @property
    def acts(self) -> bool:
        """Whether there is any load."""
        return not self._weighs or any(
            self._sent[name] != nothing for name, nothing in _NOTHING.items())

    def vertex(self, number: int) -> int:
        """Return the branch's vertex of a visible one: cut ones are hidden."""
        return number if self._left is None else int(self._left[number])

    def step(self, session: Session) -> None:
        """Send the changes, unless the last request is not answered yet."""
        if self._asked is not None or not session.hello:
            return
        if self._scene.limber.live_weight != self._weighs:
            self._weighs = self._scene.limber.live_weight
            session.weigh(self._weighs)
        try:
            wanted = self._wanted()
        except SettingError:
            # Half typed: the previous loads still act.
            return
        if wanted != self._sent:
            self._sent, self._asked = wanted, session.load(**wanted)

    def hear(self, told: dict[str, Any]) -> bool:
        """Take a reply or an error; returns whether it was for the loads."""
        if self._asked is None or told.get("id") != self._asked:
            return False
        self._asked = None
        if told["event"] == "error":
            self.error = str(told.get("message", ""))
        else:
            self.error, self._reply = "", told
            self._hide(told.get("gone") or [])
        return True

    def add(self, name: str, place) -> None:
        """Add a fruit at a position [m] of the branch as scanned, or cut there."""
        rest = (self._scene.limber.fruit_mass,) if name == "fruit" else PLACES[name]
        row = stages()["load"].fields[name].shown([[*map(float, place), *rest]])
        given = getattr(self._group, name)
        setattr(self._group, name, f"{given}; {row}" if given.strip() else row)

    def tell(self, frame: HeldFrame) -> None:
        """Describe the effect of the loads for the panel."""
        lines[:] = [f"Sag {1000 * frame.sag:.3g} mm",
                    f"Maximum strain {100 * frame.strain:.3g} %"]
        if self._reply.get("wind_force_n"):
            force = sum(value * value for value in self._reply["wind_force_n"]) ** 0.5
            lines.append(f"Wind {force:.3g} N, added {self._reply['added_mass_kg']:.3g} kg, cut "
                         f"{1000 * self._reply['cut_mass_kg']:.3g} g")
        if self.error:
            lines.append(self.error)

    def end(self, *, is_kept: bool) -> None:
        """Show all of the branch again; fruit and cuts are removed unless they are kept."""
        lines.clear()
        if not is_kept:
            for name, text in self._before.items():
                setattr(self._group, name, text)
        self._hide([])

    def _wanted(self) -> dict[str, Any]:
        group, fields = self._group, stages()["load"].fields
        return {"wind_m_s": list(group.wind) if group.use_wind else [0.0] * 3,
                "snow_kg_m2": group.snow,
                "fruit": [{"point": row[:3], "mass_kg": row[3]}
                          for row in rows_of(fields["fruit"], group.fruit) if row[3] > 0],
                "cuts": rows_of(fields["cut"], group.cut)}

    def _hide(self, vertices: list[int]) -> None:
        surface = self._surface
        old, group = surface.modifiers.get(_MASK), surface.vertex_groups.get(_MASK)
        if old is not None:
            surface.modifiers.remove(old)
        if group is not None:
            surface.vertex_groups.remove(group)
        count = len(surface.data.vertices)
        known = [int(number) for number in vertices if 0 <= number < count]
        self._left = np.delete(np.arange(count), known) if known else None
        if known:
            surface.vertex_groups.new(name=_MASK).add(known, 1.0, "REPLACE")
            mask = surface.modifiers.new(_MASK, "MASK")
            mask.vertex_group, mask.invert_vertex_group = _MASK, True
