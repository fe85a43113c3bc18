"""The user's choices in the sidebar, kept in the scene: made from the stages' schema."""

import json
from typing import Any

import bpy
import numpy as np

from . import compat
from .branch import branch_folder, branches
from .jobs.stages import Field, SettingError, Stage, rows_of, stages
from .show import graph as viewport_graph

OPEN = "use_"
"""Prefix of the property that states whether an optional field is given."""
_LARGEST_INTEGER = 2**31 - 1


def _set_fruit_mass(settings: bpy.types.PropertyGroup, _context) -> None:
    """Set the mass of all hanging fruits to that of the slider."""
    field = stages()["load"].fields["fruit"]
    try:
        rows = rows_of(field, settings.load.fruit)
    except SettingError:
        # Half typed by hand: it stays.
        return
    settings.load.fruit = field.shown([[*row[:3], settings.fruit_mass] for row in rows])


def _show_scan(settings: bpy.types.PropertyGroup, _context) -> None:
    for thing in settings.id_data.objects:
        if branches.SCAN_KEY in thing:
            thing.hide_viewport = not settings.show_scan


def _color_again(settings: bpy.types.PropertyGroup, _context) -> None:
    """Switch the colours to the other mode."""
    surface = branches.find_surface(settings.id_data)
    if surface is None:
        return
    name = surface.get(branches.FRAME_SCALAR_KEY)
    if name is None and (active := surface.data.color_attributes.active_color) is not None:
        name = active.name.removesuffix("_color")
    if name in (branches.info_of(surface).get("frame_scalars") or {}):
        bpy.ops.limber.color_by(scalar=name, each_frame=settings.each_frame)


def _folder_in_sight(settings: bpy.types.PropertyGroup) -> str:
    return branches.current_path(settings.id_data)


def _choose_folder(settings: bpy.types.PropertyGroup, path: str) -> None:
    branches.use_folder(settings.id_data, path)


_NOT_SHOWN = "/"
"""Instead of a collection's name: for a folder that is not shown."""
_branch_items: list[tuple[str, str, str, str, int]] = []
"""Blender keeps no copy of these texts."""


def _branches_to_choose(settings: bpy.types.PropertyGroup, _context) -> list:
    scene = settings.id_data
    shown = [(branch.name, branch.name, bpy.path.abspath(branch[branches.FOLDER_KEY]))
             for branch in branches.branches(scene) if branches.surface_of(branch) is not None]
    if branches.find_surface(scene) is None:
        shown.insert(0, (_NOT_SHOWN, f"{branches.current_name(scene) or 'none'} (not shown)", ""))
    items = [(*item, "NONE", number) for number, item in enumerate(shown)]
    if items != _branch_items:
        # Else the very texts stay that Blender is about to show.
        _branch_items[:] = items
    return _branch_items


def _branch_in_sight(settings: bpy.types.PropertyGroup) -> int:
    surface = branches.find_surface(settings.id_data)
    name = _NOT_SHOWN if surface is None else branches.branch_of(surface).name
    return next((item[-1] for item in _branches_to_choose(settings, None) if item[0] == name), 0)


def _choose_branch(settings: bpy.types.PropertyGroup, number: int) -> None:
    name = _branches_to_choose(settings, None)[number][0]
    if name != _NOT_SHOWN:
        branches.choose(settings.id_data, bpy.data.collections[name])


class LimberSettings(bpy.types.PropertyGroup):
    """Choices of one scene; the settings of each stage are under its name."""

    branch_folder: bpy.props.StringProperty(
        name="Branch Folder", subtype="DIR_PATH", options=compat.PATH_OPTIONS,
        get=_folder_in_sight, set=_choose_folder,
        description="NAME.branch, the folder in which the worker keeps everything about one "
                    "branch: that of the active object, otherwise the last one used")
    branch: bpy.props.EnumProperty(
        name="Branch", items=_branches_to_choose, get=_branch_in_sight, set=_choose_branch,
        description="The branch that every panel works on. Clicking a part of a branch in the view "
                    "chooses it too")
    live_weight: bpy.props.BoolProperty(
        name="Own Weight", default=True,
        description="Apply gravity while the branch is held. The scan shows the branch bent by "
                    "its own weight")
    fruit_mass: bpy.props.FloatProperty(
        name="Mass of Each Fruit [kg]", default=0.1, min=0.0, soft_max=1.0, max=1000.0, precision=3,
        description="Mass of each fruit on the branch", update=_set_fruit_mass)
    show_scan: bpy.props.BoolProperty(
        name="Scan", default=True, update=_show_scan,
        description="Show imported scans over the branches made from them")
    show_legend: bpy.props.BoolProperty(
        name="Legend", default=True,
        description="Explain the colours, in the 3D view and in a picture")
    show_energy_slice: bpy.props.BoolProperty(
        name="Energy Slice", default=False,
        description="Show the energy with the grasp there, in the plane through the 3D cursor that "
                    "faces the view. While a goal is dragged, it is shown through the goal")
    each_frame: bpy.props.BoolProperty(
        name="Colours Follow the Motion", default=True, update=_color_again,
        description="Colour by the value in the current frame; otherwise by the worst value over "
                    "all frames")
    graph: bpy.props.EnumProperty(
        name="Graph", description="Graph in the lower right corner of the 3D view",
        items=[(viewport_graph.NONE, "No graph", ""),
               *((name, title, "") for name, title in viewport_graph.GRAPHS.items())])
    show_expert: bpy.props.BoolProperty(
        name="All Settings", description="Also show the settings that are rarely needed")


def attribute_name(stage: str) -> str:
    """Return the Python name of a stage."""
    return stage.replace("-", "_")


def group_of(scene: bpy.types.Scene, stage: Stage) -> bpy.types.PropertyGroup:
    """Return the settings of a stage in ``scene``."""
    return getattr(scene.limber, attribute_name(stage.name))


def values_of(group: Any, stage: Stage, only: set[str] | None = None) -> dict[str, Any]:
    """Return the settings of a stage by field: None if it is left open.

    Args:
        group: An object with the properties of :func:`stage_properties`.
        stage: Stage of the settings.
        only: Names of the fields to return; all by default.
    """
    found: dict[str, Any] = {}
    for name, field in stage.fields.items():
        if only is not None and name not in only:
            continue
        if field.word and getattr(group, word_property(field)):
            found[name] = field.word
            continue
        if field.is_optional and has_switch(field) and not getattr(group, OPEN + name):
            found[name] = None
            continue
        value = getattr(group, name)
        if field.kind == "path" and value:
            value = bpy.path.abspath(value)
        found[name] = tuple(value) if field.kind == "vector" else value
    return found


def word_property(field: Field) -> str:
    """Return the name of the property that states whether a vector is its word instead."""
    return f"{field.word}_{field.name}"


def put(group: bpy.types.PropertyGroup, field: Field, value: Any) -> None:
    """Set a setting to ``value``, as in JSON; TypeError or ValueError if it has no such value."""
    is_word = bool(field.word) and value == field.word
    if field.word:
        setattr(group, word_property(field), is_word)
    if field.is_optional and has_switch(field):
        setattr(group, OPEN + field.name, value is not None and not is_word)
    if value is None or is_word:
        group.property_unset(field.name)
    else:
        setattr(group, field.name, field.shown(value))


def take_over(group: bpy.types.PropertyGroup, stage: Stage, settings: dict[str, Any]) -> None:
    """Set the settings of a stage to those that made a branch."""
    for name in stage.settings & settings.keys():
        try:
            put(group, stage.fields[name], settings[name])
        except (TypeError, ValueError):
            # The branch is from a version with other choices: the default stays.
            group.property_unset(name)


def differs(group: Any, stage: Stage, settings: dict[str, Any]) -> bool:
    """Whether the stage would now run with settings other than ``settings``, as in JSON."""
    now = values_of(group, stage)
    for name in stage.settings & settings.keys():
        value, before = now[name], settings[name]
        if value is None or before is None or stage.fields[name].word in (value, before):
            if value != before and (value or before):
                return True
        elif stage.fields[name].kind in ("number", "vector"):
            if np.float32(value).tolist() != np.float32(before).tolist():
                return True
        elif value != (given := stage.fields[name].shown(before)) and (
                _numbers(value) != _numbers(given)):
            return True
    return False


def _numbers(value: Any) -> Any:
    """Return a list that a panel keeps as text with its numbers as such: 6e+07 is 60000000.0."""
    if not isinstance(value, str):
        return value
    try:
        return [[float(part) for part in row.replace(",", " ").split()]
                for row in value.split(";")]
    except ValueError:
        return value


def has_switch(field: Field) -> bool:
    """Whether a separate property states if the field is given; an empty text needs none."""
    return field.kind not in ("string", "path")


def stage_properties(stage: Stage, options: set[str] = frozenset()) -> dict[str, Any]:
    """Return the properties of a stage's fields, by name, with these options of properties."""
    found: dict[str, Any] = {}
    for name, field in stage.fields.items():
        found[name] = _property(field, set(options), _pattern(stage, field))
        if field.is_optional and has_switch(field):
            found[OPEN + name] = bpy.props.BoolProperty(
                name=field.title, description=f"{field.description} Off: the worker decides",
                options=set(options))
        if field.word:
            found[word_property(field)] = bpy.props.BoolProperty(
                name=f"{field.title}: {field.word}", description=field.about(field.word),
                options=set(options))
    return found


_PATTERNS = {"plan": "plans/{name}.csv", "motion": "frames/{name}.pc2",
             "pull": "pulls/{name}/pull.toml", "target": "target:"}
"""Pattern of the files offered for a field of this name, as :meth:`BranchRecord.names` takes it."""


def _pattern(stage: Stage, field: Field) -> str:
    """Return the pattern of the files that the folder offers for a field; or empty.
    """
    if field.name == "name":
        read = next((each for each in stage.reads if "{name}" in each), "")
        return f"{read}pull.toml" if read.endswith("/") else read
    return _PATTERNS.get(field.name, "")


def _search(pattern: str) -> Any:
    """Return the function that lists the current branch's entries for a text field."""
    def found(settings: bpy.types.PropertyGroup, _context, typed: str) -> list[str]:
        folder = branches.current_folder(settings.id_data)
        record = None if folder is None else branch_folder.read_record(folder)
        names = [] if record is None else record.names(pattern)
        # A text that is already a choice would hide all others.
        return names if typed in names else [name for name in names if typed in name]
    return found


def _property(field: Field, options: set[str], pattern: str = "") -> Any:
    if field.kind == "path":
        options |= compat.PATH_OPTIONS
    about: dict[str, Any] = {"name": field.label, "description": field.description,
                             "options": options}
    if field.kind == "boolean":
        return bpy.props.BoolProperty(default=bool(field.default), **about)
    if field.kind == "choice":
        items = [(choice, choice.replace("_", " ").capitalize() if len(choice) > 2 else choice,
                  field.about(choice)) for choice in field.choices]
        return bpy.props.EnumProperty(items=items, default=field.default or items[0][0], **about)
    if field.kind == "integer":
        least = -_LARGEST_INTEGER if field.least is None else int(field.least) + field.is_open
        most = _LARGEST_INTEGER if field.most is None else int(field.most)
        return bpy.props.IntProperty(default=field.default or max(least, 0), min=least, max=most,
                                     **about)
    if field.kind == "number":
        limits = _limits(field)
        default = max(limits.get("min", 0.0), 0.0) if field.default is None else field.default
        return bpy.props.FloatProperty(default=default, precision=_digits(field), **limits,
                                       **about)
    if field.kind == "vector":
        return bpy.props.FloatVectorProperty(
            size=field.length, default=field.default or (0.0,) * field.length, precision=4,
            **about)
    subtype = "FILE_PATH" if field.kind == "path" else "NONE"
    default = "" if field.default is None else field.shown(field.default)
    if pattern and field.kind in ("string", "list"):
        about["search"] = _search(pattern)
    return bpy.props.StringProperty(default=default, subtype=subtype, **about)


def _limits(field: Field) -> dict[str, float]:
    limits = {}
    if field.least is not None:
        least = np.float32(field.least)
        # The next number above it: a value above 0 may be arbitrarily small.
        limits["min"] = float(np.nextafter(least, np.float32(np.inf)) if field.is_open else least)
    if field.most is not None:
        limits["max"] = float(np.float32(field.most))
    return limits


def _digits(field: Field) -> int:
    if field.unit in ("Pa", "MB") or (field.default or 0.0) >= 1000.0:
        return 0
    return 6 if field.unit == "m" or 0.0 < (field.default or 1.0) < 0.01 else 3


def arguments_of(scene: bpy.types.Scene, stage: Stage, folder: str) -> list[str]:
    """Return the command line that runs a stage in a branch folder with the settings of ``scene``.

    Raises:
        SettingError: a required value is missing, or a text is not a list as required.
    """
    group = group_of(scene, stage)
    values = values_of(group, stage)
    for field in stage.fields.values():
        if not field.is_kept:
            values.pop(field.name)
    # The worker asks for a unit that nobody stated, even if it would be the default.
    stated = {name for name in ("unit",) if name in stage.fields and group.is_property_set(name)}
    return stage.arguments({**values, "branch_folder": folder}, stated)


def outcome_of(scene: bpy.types.Scene, stage: Stage, folder: str) -> dict[str, Any]:
    """Return the stage's last outcome for the branch in ``folder``: error, warnings, status."""
    try:
        outcome = json.loads(group_of(scene, stage).outcome or "{}")
    except ValueError:
        return {}
    return outcome if outcome.get("folder") == folder else {}


def keep_outcome(scene: bpy.types.Scene, stage: Stage, folder: str, outcome: dict[str, Any],
                 ) -> None:
    """Keep the texts that the user must be able to read after the message has disappeared.

    If the branch folder keeps no result (of loads, of an export, of a dry run), keep that too.
    """
    common = ("status", "error", "warnings", "seconds", "arguments", "code", "place", "remedies",
              "parts", "warning_parts")
    kept = {name: outcome[name] for name in common if name in outcome}
    if not stage.keeps_entry(values_of(group_of(scene, stage), stage, {"name"})):
        kept["result"] = {name: value for name, value in outcome.items()
                          if name not in (*common, "command", "fix")}
    group_of(scene, stage).outcome = json.dumps({"folder": folder, **kept})


_GROUPS = {attribute_name(stage.name): type(
    f"LIMBER_PG_{attribute_name(stage.name)}", (bpy.types.PropertyGroup,), {
        "__module__": __name__, "__annotations__": stage_properties(stage) | {
            "outcome": bpy.props.StringProperty(options={"HIDDEN"})}})
    for stage in stages().values()}
LimberSettings.__annotations__ |= {
    name: bpy.props.PointerProperty(type=group) for name, group in _GROUPS.items()}
CLASSES = (*_GROUPS.values(), LimberSettings)


def register() -> None:
    bpy.types.Scene.limber = bpy.props.PointerProperty(type=LimberSettings)


def unregister() -> None:
    del bpy.types.Scene.limber
