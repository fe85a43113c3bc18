"""Tables of the sidebar: paths side by side, moduli with their intervals, branches of the scene."""

from collections.abc import Sequence
from typing import Any

import bpy

from ..branch import branch_folder, branches, several
from ..branch.branch_folder import BranchRecord
from .lines import draw_text, room, width

_PATH_ROWS = (("Length", "length_m", 1e3, "mm"), ("Energy, summed", "energy_sum_nmm", 1.0, "N mm"),
              ("Peak energy", "peak_energy_j", 1e3, "mJ"), ("Peak force", "peak_force_n", 1.0, "N"),
              ("Peak strain", "peak_strain", 1e2, "%"))
_PLAN = "plan:"
_FIRST_SHARE = 0.46


def draw_paths(layout: bpy.types.UILayout, context: bpy.types.Context, result: dict[str, Any],
               record: BranchRecord | None, stress_share: float) -> None:
    """Draw the planned path beside the one without energy, proven bounds, and other plans.

    ``stress_share`` is the largest stress over the strength: beyond 1 the plan is not ticked.
    """
    paths = [result.get(key) or {} for key in ("plan", "baseline")]
    if not paths[0]:
        return
    rows = [["", "Gentle", "Shortest"]]
    rows += [[f"{words} [{unit}]", *(_number(path.get(key), factor) for path in paths)]
             for words, key, factor, unit in _PATH_ROWS]
    draw_table(layout, context, rows)
    saved, longer = result.get("energy_saved_percent"), result.get("length_added_percent")
    if saved is not None and longer is not None:
        draw_text(layout, context, f"{saved:.0f} % of the energy saved, {abs(longer):.1f} % "
                  f"{'longer' if longer >= 0 else 'shorter'}")
    strength = result.get("strength") or {}
    is_over = bool(strength.get("over")) or stress_share > 1.0
    gap = (result.get("certificate") or {}).get("gap_percent")
    longest = (result.get("detour") or {}).get("longest_m")
    least = "the minimum" if longest is None else (
        f"the least energy of a path up to {1e3 * longest:.3g} mm")
    draw_text(layout, context, "No bound was proven" if gap is None else
              f"Proven on the field: at most {gap:.1f} % above {least}",
              "QUESTION" if gap is None else "BLANK1" if is_over else "CHECKMARK")
    if strength.get("over"):
        draw_text(layout, context,
                  f"Strain {strength['peak_strain'] / strength['median_strain']:.1f} x "
                  f"the strength ({strength['source']})", "ERROR")
    elif is_over:
        draw_text(layout, context, f"May break: stress {stress_share:.2g} times the strength",
                  "ERROR")
    if legs := result.get("legs"):
        draw_table(layout, context, [["Leg", "Time [s]", "Force [N]"], *(
            [str(leg["name"]).capitalize(), _number(leg.get("duration_s"), 1.0),
             _number(leg.get("peak_force_n"), 1.0)] for leg in legs)])
    others = {key.removeprefix(_PLAN): entry.result for key, entry in (
        record.stages.items() if record else ()) if key.startswith(_PLAN)}
    if len(others) > 1:
        draw_table(layout, context, [["Plan", "Sum [N mm]", "Length [mm]"], *(
            [name, _number((each.get("plan") or {}).get("energy_sum_nmm"), 1.0),
             _number((each.get("plan") or {}).get("length_m"), 1e3)]
            for name, each in others.items())])


def draw_moduli(layout: bpy.types.UILayout, context: bpy.types.Context,
                result: dict[str, Any]) -> None:
    """Draw Young's modulus at the control points with its interval, base first."""
    young = result.get("young_pa") or []
    intervals = result.get("young_interval_pa") or [[None, None]] * len(young)
    if young and len(young) == len(intervals):
        draw_table(layout, context, [["E [MPa]", "from", "to (95 %)"], *(
            [f"{number + 1}:  {_number(value, 1e-6)}", _number(low, 1e-6), _number(high, 1e-6)]
            for number, (value, (low, high)) in enumerate(zip(young, intervals, strict=True)))])


def draw_branches(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """Draw the branches of the scene if there are several, and a button if one is lost."""
    shown = branches.branches(context.scene)
    surface = branches.find_surface(context.scene)
    chosen = branches.branch_of(surface) if surface is not None else None
    if chosen is not None and several.is_lost(chosen):
        draw_text(layout, context, "The folder has moved or been renamed", "ERROR")
        layout.operator("limber.relink", icon="FILE_REFRESH")
    if len(shown) < 2:
        return
    for branch in shown:
        layout.operator("limber.choose_branch", text=branch.name, depress=branch == chosen,
                        icon="ERROR" if several.is_lost(branch) else "NONE").branch = branch.name
        draw_text(layout, context, _modulus_and_saving(branch), "BLANK1")
    row = layout.row(align=True)
    row.operator("limber.side_by_side", icon="MOD_ARRAY")
    row.operator("limber.side_by_side", text="In Place").back = True


def _modulus_and_saving(branch: bpy.types.Collection) -> str:
    """Return E and the energy saved of a branch, as far as its folder has them."""
    record = branch_folder.read_record(bpy.path.abspath(branch[branches.FOLDER_KEY]))
    if record is None:
        return "folder not found"
    young = record.stages["estimate"].result.get("young_pa") if "estimate" in record.stages else []
    plans = [entry.result for key, entry in record.stages.items() if key.startswith(_PLAN)]
    words = [f"E {_number(min(young), 1e-6)} to {_number(max(young), 1e-6)} MPa"] if young else []
    if plans and plans[-1].get("energy_saved_percent") is not None:
        words.append(f"{plans[-1]['energy_saved_percent']:.0f} % saved")
    return ", ".join(words) or "E assumed"


def draw_table(layout: bpy.types.UILayout, context: bpy.types.Context,
               rows: Sequence[Sequence[str]]) -> None:
    """Draw rows of words under each other, the first as wide as two of the others; above them if it
    is wider."""
    column = layout.column(align=True)
    for first, *others in rows:
        if width(first) > _FIRST_SHARE * room(context):
            draw_text(column, context, first)
            first = ""
        row = column.split(factor=_FIRST_SHARE, align=True)
        row.label(text=first)
        cells = row.row(align=True)
        for words in others:
            cells.label(text=words)


def _number(value: Any, factor: float) -> str:
    return f"{factor * value:.3g}" if isinstance(value, int | float) else "-"
