"""Draws every panel with all its parts open, and errors; test_no_text_is_cut.py starts it.

FOLDER has cut.ttf, whose only letter is the ellipsis, as a block: a text that Blender cuts shows
one. FOLDER/errors.json has the texts of errors by stage, those to draw first.
"""

import json
import sys
from pathlib import Path
from types import SimpleNamespace

import bpy

sys.path.insert(0, str(Path(__file__).parent))
import driving
from driving import FOLDER, drive, is_tab_open, part, picture, seen, start, view

DRAWN_ERRORS = 30


class Open:
    """A UILayout whose folded parts are open."""

    def __init__(self, layout, name):
        object.__setattr__(self, "_given", (layout, name))

    def __getattr__(self, name):
        layout, own = self._given
        found = getattr(layout, name)
        if name not in ("row", "column", "split", "box"):
            return found
        return lambda *given, **named: Open(found(*given, **named), own)

    def __setattr__(self, name, value):
        setattr(self._given[0], name, value)

    def panel(self, name, default_closed=False):
        layout, own = self._given
        header, body = layout.panel(f"{own}_{name}", default_closed=False)
        return Open(header, own), None if body is None else Open(body, own)


def begin():
    preferences = bpy.context.preferences
    preferences.view.font_path_ui = str(FOLDER / "cut.ttf")
    view()[1].spaces.active.show_region_ui = True
    # Only the sidebar is looked at: the view beside it is drawn as fast as it can be.
    space = view()[1].spaces.active
    space.shading.type, space.overlay.show_overlays = "WIREFRAME", False
    space.show_object_viewport_mesh = space.show_object_viewport_curve = False
    seen["panels"] = len(PANELS)
    return True


def panels():
    return sorted((kind for kind in bpy.types.Panel.__subclasses__()
                   if kind.is_registered and getattr(kind, "bl_category", "") == "Limber"),
                  key=lambda kind: getattr(kind, "bl_order", 0))


PANELS = panels()


def show(name, draw, title="", header=None):
    """Return the step that shows one panel of the tab, and no other."""
    def step():
        for kind in panels():
            bpy.utils.unregister_class(kind)

        def drawn(self, context):
            draw(Open(self.layout, name), context)
        content = {"bl_idname": f"LIMBER_PT_{name}", "bl_label": title or name, "draw": drawn,
                   "bl_space_type": "VIEW_3D", "bl_region_type": "UI", "bl_category": "Limber"}
        if header is not None:
            content["draw_header_preset"] = header
        bpy.utils.register_class(type(f"LIMBER_PT_{name}", (bpy.types.Panel,), content))
        is_tab_open()
        return True
    step.__name__ = f"show {name}"
    return step


def each_panel(state):
    """Return the steps that show and picture each panel of the tab."""
    steps = []
    for kind in PANELS:
        name = f"{state}_{kind.__name__.removeprefix('LIMBER_PT_')}"
        header = header_of(kind) if hasattr(kind, "draw_header_preset") else None
        steps += [show(name, body_of(kind), kind.bl_label, header), picture(name)]
    return steps


def body_of(kind):
    def draw(layout, context):
        if not hasattr(kind, "poll") or kind.poll(context):
            kind.draw(SimpleNamespace(layout=layout, step=getattr(kind, "step", None)), context)
    return draw


def header_of(kind):
    def draw(self, context):
        kind.draw_header_preset(SimpleNamespace(
            layout=self.layout, step=getattr(kind, "step", None)), context)
    return draw


def all_settings():
    scene = bpy.context.scene.limber
    scene.show_expert = True
    scene.load.use_wind = scene.scene.use_strength = True
    return True


def fail():
    """A job that ended with an error and said much."""
    jobs = part("jobs.jobs")
    job = jobs.start("Sample the Energy", [sys.executable, "-c", (
        "import sys; print('A line of the log that is longer than the sidebar is wide, with a '"
        "'path: /data/somebody/branches/an-apple-tree/the-scan-of-a-branch.ply',"
        " file=sys.stderr); sys.exit(3)")])
    job.wait()
    return True


def errors():
    """Return the steps that draw the errors asked for."""
    told = json.loads((FOLDER / "errors.json").read_text())

    def draw(layout, context):
        steps, stages = part("panels.steps"), part("jobs.stages").stages()
        # As the panels of the steps have it.
        layout.use_property_split, layout.use_property_decorate = True, False
        for number, (stage, parts) in enumerate(told[:DRAWN_ERRORS]):
            remedies = [{"option": field.name, "value": field.choices[0], "command": None}
                        for field in stages[stage].fields.values() if field.choices][:1]
            steps.draw_error(Open(layout._given[0], f"error{number}"), context, stages[stage],
                             {"parts": [parts], "remedies": remedies})
    return [show("errors", draw), picture("errors")]


def measure_errors():
    """Write down the errors of which a line is wider than there is room for in the sidebar."""
    lines, words = part("panels.lines"), part("jobs.plain_words")
    told = json.loads((FOLDER / "errors.json").read_text())
    stages = part("jobs.stages").stages()
    window, area, region = view("UI")
    seen["sidebar"] = [region.x, region.y, region.width, region.height]
    with bpy.context.temp_override(window=window, area=area, region=region):
        room = lines.room(bpy.context)
    seen["room"], seen["error_count"] = room, len(told)
    seen["too_wide"] = [line for stage, parts in told
                        for text in words.error_texts({"parts": [parts]}, stages[stage])
                        for line in lines.wrapped(text, room) if lines.width(line) > room]
    return True


def draw_too_wide(layout, _context):
    layout.label(text="A text that is wider than the sidebar is at first, on purpose")


drive([begin, is_tab_open, show("cut", draw_too_wide), picture("cut"),
       *each_panel("start"), start("open_example", directory=str(FOLDER / "copy")),
       driving.is_example_open, driving.save(FOLDER / "copy" / "panels.blend"),
       all_settings, fail, *each_panel("all"), *errors(), measure_errors], longest=60)
