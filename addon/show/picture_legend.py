"""The legend of a picture: text and colour keys fixed before the camera.

It has a margin of its own. Lines are broken at its end, and a legend too long for the picture's
height is scaled down as a whole.
"""

import textwrap

import bpy
from mathutils import Vector

from ..branch.branches import add_object
from ..branch.parts import ShownBranch
from ..bridge import materials, meshes
from .scene import COLORS, NAMES
from .scene_data import SceneData
from .studio import LEGEND_SHARE, PAPER

# In picture heights.
_MARGIN = 0.04
_TITLE = 0.046
_TEXT = 0.027
_LINE = 0.044
_BAR_WIDTH = 0.032
_BAR_HEIGHT = 0.26
_BROKEN = 1.3
"""Line distance of a broken text in heights of the text."""
_LETTER = 0.41
"""Mean width of a letter in heights of the text."""


class _Sheet:
    """A plane before the camera on which objects are laid out from the top left corner down."""

    def __init__(self, scene: bpy.types.Scene, camera: bpy.types.Object):
        self.collection = bpy.data.collections.new("Legend")
        scene.collection.children.link(self.collection)
        self.camera = camera
        frame = camera.data.view_frame(scene=scene)
        # Just behind the near plane, so that no object of the scene is in front of it.
        depth = 2.0 * camera.data.clip_start
        corners = [corner * (depth / -corner.z) for corner in frame]
        left = min(corner.x for corner in corners)
        top = max(corner.y for corner in corners)
        self.unit = top - min(corner.y for corner in corners)
        self.width = LEGEND_SHARE * (max(corner.x for corner in corners) - left) / self.unit
        self.corner = Vector((left, top, -depth))
        self.x, self.y = _MARGIN, _MARGIN
        self.ink = materials.flat_material("Legend ink", (0.012, 0.014, 0.018))

    def put(self, name: str, data: bpy.types.ID, material: bpy.types.Material,
            x: float, y: float) -> bpy.types.Object:
        """Put an object at ``x`` right of and ``y`` below the corner, in picture heights."""
        thing = add_object(self.collection, name, data, material)
        thing.parent = self.camera
        thing.location = self.corner + Vector((x, -y, 0.0)) * self.unit
        _hide_from_light(thing)
        return thing

    def text(self, words: str, *, size: float = _TEXT, x: float = 0.0, y: float | None = None,
             ) -> None:
        """Write ``words`` with their upper edge at ``y``, or at the current line. Further lines
        push the current line down.
        """
        top = self.y if y is None else y
        letters = max(8, int((self.width - self.x - x) / (_LETTER * size)))
        for number, line in enumerate(textwrap.wrap(words, letters)):
            curve = bpy.data.curves.new(f"Legend {line[:20]}", "FONT")
            curve.body = line
            curve.size = size * self.unit
            curve.align_y = "CENTER"
            middle = top + number * _BROKEN * size + size / 2
            self.put(f"Legend: {line[:40]}", curve, self.ink, self.x + x, middle)
            if number:
                self.y += _BROKEN * size

    def fit(self) -> None:
        """Scale everything down if it would not end within the picture."""
        share = min(1.0, (1.0 - 1.5 * _MARGIN) / self.y)
        for thing in self.collection.objects:
            thing.location = self.corner + (thing.location - self.corner) * share
            thing.scale = (share, share, share)

    def ground(self) -> None:
        """Put a background behind all of it, with the margin as its edge."""
        behind = 1.1
        mesh = meshes.new_rectangle("Legend ground", behind * self.width * self.unit,
                                    behind * self.unit)
        thing = add_object(self.collection, "Legend ground", mesh,
                           materials.flat_material("Legend ground", PAPER))
        thing.parent = self.camera
        thing.location = behind * (self.corner + Vector((0.0, -self.unit, 0.0)))
        _hide_from_light(thing)

    def swatch(self, color: tuple[float, float, float], width: float, height: float) -> None:
        """Put a bar of one colour on the current line."""
        mesh = meshes.new_rectangle("Legend key", width * self.unit, height * self.unit)
        material = materials.flat_material("Legend key", color)
        self.put("Legend key", mesh, material, self.x + (0.05 - width) / 2,
                 self.y + _TEXT / 2 + height / 2)


def _hide_from_light(thing: bpy.types.Object) -> None:
    """Make an object visible to the camera alone, without shadow or reflection."""
    for ray in ("diffuse", "glossy", "transmission", "volume_scatter", "shadow"):
        setattr(thing, f"visible_{ray}", False)


def add_legend(scene: bpy.types.Scene, camera: bpy.types.Object, data: SceneData,
               shown: ShownBranch) -> bpy.types.Collection:
    """Write the picture's contents, with units, left of the branch; returns the collection."""
    sheet = _Sheet(scene, camera)
    sheet.text(data.info["name"].replace("_", " "), size=_TITLE)
    sheet.y += 1.6 * _TITLE
    for note in data.info["notes"]:
        sheet.text(note)
        sheet.y += _LINE
    sheet.y += 0.6 * _LINE
    for name, scale in data.info["scalars"].items():
        if name == _shown_scalar(shown.surface):
            _add_color_bar(sheet, name, scale)
    _add_keys(sheet, data, shown)
    sheet.fit()
    if "robot" in shown.objects:
        sheet.ground()
    return sheet.collection


def _shown_scalar(surface: bpy.types.Object) -> str:
    """Return the scalar that a picture of the branch shows; empty under a material of the user."""
    first = surface.material_slots[0].material if surface.material_slots else None
    return surface.data.color_attributes.active_color_name.removesuffix("_color") if (
        first is not None and materials.KEY in first) else ""


def _add_color_bar(sheet: _Sheet, name: str, scale: dict) -> None:
    sheet.text(scale["title"] + (", log scale" if scale["log"] else ""))
    sheet.y += 1.3 * _LINE
    mesh = meshes.new_rectangle("Legend colours", _BAR_WIDTH * sheet.unit, _BAR_HEIGHT * sheet.unit)
    material = materials.scalar_material(f"Legend {name}", "height", low=0.0, high=1.0,
                                         log=False, stops=scale["stops"], flat=True)
    sheet.put("Legend colours", mesh, material, sheet.x, sheet.y + _BAR_HEIGHT)
    for share, tick in zip((1.0, 0.5, 0.0), scale["ticks"], strict=True):
        sheet.text(tick, x=_BAR_WIDTH + 0.018, y=sheet.y + share * _BAR_HEIGHT - _TEXT / 2)
    sheet.y += _BAR_HEIGHT + 1.2 * _LINE


def _goal_words(goal: dict) -> str:
    words = f"goal of the {goal.get('kind', 'grasp')}"
    return f"{words}, within {1000 * goal['radius_m']:.3g} mm" if goal.get("radius_m") else words


def _add_keys(sheet: _Sheet, data: SceneData, shown: ShownBranch) -> None:
    thin, dot = (0.05, 0.009), (0.022, 0.022)
    keys = [(f"path:{key}", f"{about['title']} path", about["note"], thin)
            for key, about in data.info["paths"].items()]
    keys += [("goal", _goal_words(data.info.get("goal") or {}), "", dot),
             ("targets", ", ".join(data.info.get("targets") or ()), "", dot),
             ("robot", f"robot {(data.info.get('robot') or {}).get('name', '')}", "", dot)]
    keys += [(name, NAMES[name], "", dot)
             for name in ("grasp", "control_points", "observed", "rest", "base")]
    for name, words, note, (width, height) in keys:
        if name not in shown.objects:
            continue
        sheet.swatch(COLORS[name], width, height)
        sheet.text(words, x=0.066)
        sheet.y += _LINE
        if note:
            sheet.y -= 0.2 * _LINE
            sheet.text(note, x=0.066)
            sheet.y += 1.1 * _LINE
