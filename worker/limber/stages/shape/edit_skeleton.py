"""Stage ``skeleton``."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from limber.core.alignment import Alignment
from limber.core.constants import FOUND_SKELETON
from limber.core.errors import Command, InputError, Option, Text
from limber.core.progress import SILENT, Progress
from limber.stages.result import Result, Table, filled
from limber.stages.shape.reconstruct import EDITS, edits_digest, load_edits, write_branch
from limber.stages.stage import About, BranchStage, given
from limber.store import Branch

if TYPE_CHECKING:
    from limber.geometry.skeleton.confidence import DoubtfulPart
    from limber.geometry.skeleton.edits import Edit
    from limber.geometry.skeleton.skeleton import Skeleton

_SHOWN = 30  # doubtful parts in the table; the JSON result has all


class Review(Result):
    """A branch's skeleton, and what is doubtful about it."""

    def tables(self) -> list[Table]:
        """Return what the edits did, the doubtful parts and the alternatives."""
        from limber.results.report.report_tables import alternative_rows, doubtful_rows, edit_rows

        doubtful, others = self.values["doubtful"], self.values["alternatives"]
        places = f"places in the scan's coordinates [{self.values['unit']}]"
        more = f" ({len(doubtful) - _SHOWN} more with --json)" if len(doubtful) > _SHOWN else ""
        return filled(
            (f"Edits, {places}", edit_rows(self.values["edit_effects"])),
            (f"Doubtful parts, {places}{more}", doubtful_rows(doubtful[:_SHOWN])),
            (f"Alternatives, {places}", alternative_rows(others) if len(others) > 1 else []))


def _doubtful_line(result: Mapping[str, Any]) -> str:
    count = len(result["doubtful"])
    return (Text(f"{count} doubtful {'part' if count == 1 else 'parts'}. Edits (a JSON list) are "
                 "applied with ", Option("edits"), ".") if count else "No part of it is doubtful.")


class ReviewSkeleton(BranchStage):
    """List doubtful parts of the skeleton, and edit it; the mesh follows.

    EDITS is a JSON list with one object per edit. Positions are in the coordinates and unit of the
    scan's file, as in the list of doubtful parts:

    \b
      {"do": "move", "at": [x, y, z], "to": [x, y, z]}     put a node elsewhere
      {"do": "delete", "at": [x, y, z]}                    cut a branch off, from there outwards
      {"do": "merge", "at": [...], "to": [...]}            up to there it is one with the branch at "to"
      {"do": "bridge", "at": [...], "to": [...]}           hang the whole branch on another place
      {"do": "split", "at": [...], "to": [...]}            cut there; the rest hangs on "to"
      {"do": "root", "at": [x, y, z]}                      here is the root
      {"do": "radius", "at": [...], "radius": r}           with "to": all along the axes to there
      {"do": "confirm", "at": [x, y, z]}                   the branch is there, no more doubt
      {"do": "add", "at": [...], "to": [...], "radius": r} a straight branch from there to its tip

    The most likely alternatives to the skeleton in use are listed with their probabilities and
    edits; --alternative N applies those of one of them.

    Edits are kept in the branch folder and applied again by each reconstruct. With --frame branch,
    positions and radii are in the branch's frame [m]; with --append they are added to the existing
    edits.
    """  # noqa: E501

    about = About(
        "skeleton", 25, Review, key="reconstruct",
        reads=("cloud.ply", "skeleton.csv", f"{FOUND_SKELETON}.csv"),
        writes=("cloud.ply", "skeleton.swc", "skeleton.csv", "surface.ply", "mesh.vtu",
                "point_masses.json", EDITS),
        found=("{node_count:count} nodes in {branch_count:#branch/branches}, {length_m:m}; the "
               "mesh is {mesh}.", _doubtful_line),
        then="limber suggest-pull {branch_folder}", step="skeleton", label="Review and Edit")

    edits: Path | None = given(
        "Edits (JSON) that replace those of the branch. An empty list removes all.", common=True)
    frame: Literal["scan", "branch"] = given(
        "Coordinates of the edits: those of the scan's file, or the branch's frame [m].", "scan")
    append: bool = given("Append the edits to those of the branch.", False, common=True)
    alternative: int | None = given(
        "Append the edits of this alternative, numbered as listed.", common=True,
        limits={"ge": 2})
    output: Path | None = given(
        "Also write the edited skeleton in the scan's coordinates: .swc, or .csv with intervals "
        "and probabilities.", group="output", short="-o")

    def run(self, progress: Progress = SILENT) -> dict[str, Any]:
        """List the doubtful parts of a branch's skeleton, after applying edits if there are any.

        Returns:
            ``doubtful``: a list of ``kind``, ``branch``, ``at`` (in the scan's coordinates),
            ``at_m`` (in the branch's frame), ``length_m``, ``radius_m`` and ``value``;
            ``alternatives``: the most likely graphs, the one in use first, each with
            ``probability``, ``length_m`` and ``edits``; ``edits``, those that are applied;
            ``edit_effects``, of each the node that it took (``at``, ``at_m``), how far that is from
            the requested position (``off_m``) and the change of the branches' length
            (``length_change_m``); ``mesh``: ``current``, ``out of date`` or ``missing``; ``unit``
            of ``at``.

        Raises:
            InputError: an edit does not fit; the folder is then unchanged.
            MeshingError: the edited skeleton cannot be meshed; likewise.
        """
        from limber.geometry.skeleton.alternatives import SearchDoubts, open_questions
        from limber.geometry.skeleton.confidence import doubtful_parts

        if self.edits is not None or self.alternative is not None:
            branch = Branch.open(self.branch_folder)
            edits = _applied(branch) if self.edits is None else _requested_edits(
                branch, self.edits, self.frame, self.append)
            chosen = [] if self.alternative is None else _edits_of(branch, self.alternative)
            _remade(branch, [*edits, *chosen], progress)
        branch = Branch.read(self.branch_folder)
        skeleton, alignment, mesh = _latest(branch)
        # An older skeleton than the mesh's has its own open questions.
        result = branch.made.result if mesh == "current" and branch.made else {}
        doubtful = [*doubtful_parts(skeleton), *open_questions(skeleton, SearchDoubts.of(result))]
        if mesh == "out of date":
            progress.warn("This skeleton is that of the last reconstruct, which made no mesh. The "
                          "mesh is that of an earlier one.")
        if self.output is not None:
            _write(skeleton.in_file(alignment), self.output,
                   branch.manifest.source.get("unit", "m"))
        applied = _applied(branch)
        return {
            "doubtful": [_part_entry(uncertain_part, alignment) for uncertain_part in doubtful],
            "alternatives": result.get("alternatives", []),
            "node_count": skeleton.node_count,
            "branch_count": skeleton.branch_count,
            "length_m": skeleton.length,
            "mesh": mesh,
            "unit": _unit(branch),
            "edits": [edit.model_dump(mode="json", exclude_none=True) for edit in applied],
            "edit_effects": _effects(branch, applied, alignment, progress),
            "output": self.output,
        }


def _requested_edits(branch: Branch, path: Path, frame: str, append: bool) -> list[Edit]:
    """The resulting edits of the branch, in the coordinates of the scan's file."""
    from limber.geometry.skeleton.edits import read_edits

    edits = read_edits(path)
    if frame == "branch":
        edits = [edit.in_file(branch.manifest.alignment) for edit in edits]
    return [*_applied(branch), *edits] if append else edits


def _edits_of(branch: Branch, number: int) -> list[Edit]:
    """The edits of an alternative, numbered from 1."""
    from limber.geometry.skeleton.alternatives import from_entries

    known = branch.made.result.get("alternatives", []) if branch.made else []
    if number > len(known):
        raise InputError(
            f"Alternative {number} was requested, but the skeleton in use has "
            f"{max(len(known) - 1, 0)} alternatives.",
            "Alternatives are numbered from 2; number 1 is the skeleton in use.",
            "Choose one of those listed, or reconstruct again if there are none.")
    return list(from_entries(known)[number - 1].edits)


def _applied(branch: Branch) -> list[Edit]:
    return load_edits(branch) if "edits" in _entry(branch).reads else []


def _effects(branch: Branch, edits: list[Edit], alignment: Alignment, progress: Progress,
             ) -> list[dict[str, Any]]:
    from limber.geometry.skeleton.edits import effects_of
    from limber.store.loading import load_found_skeleton

    if not edits:
        return []
    found, misfits = load_found_skeleton(branch, alignment, _unit(branch)), list[str]()
    effects = effects_of(found, [edit.aligned(alignment) for edit in edits], misfits)
    for message in misfits:
        progress.warn(message)
    return [{"do": each.do, "at": np.round(alignment.undo(each.node[None])[0], 6),
             "at_m": each.node, "off_m": round(each.distance, 9),
             "length_change_m": each.length_change}
            for each in effects]


def _entry(branch: Branch) -> Any:
    known = branch.manifest.stages
    entry = known.get("reconstruct") or known.get("skeleton") or known.get("mesh")
    if entry is None:
        branch.require("skeleton.swc", "reconstruct")
    return entry


def _unit(branch: Branch) -> str:
    return _entry(branch).settings.get("unit", "m")


def _latest(branch: Branch) -> tuple[Skeleton, Alignment, str]:
    """The newest skeleton in the branch's frame, its alignment, and the state of the mesh."""
    from limber.geometry.io.skeletons import read_skeleton
    from limber.store.loading import load_found_skeleton

    known = branch.manifest.stages
    made, early = known.get("reconstruct"), known.get("skeleton")
    if made is None and early is None:
        path = branch.require("skeleton.swc", "reconstruct")
        return read_skeleton(path), branch.manifest.alignment, "current"
    if early is not None and (made is None or not _belong(early, made)):
        alignment = Alignment.model_validate(early.result["alignment"])
        return (load_found_skeleton(branch, alignment, early.settings["unit"]), alignment,
                "missing" if made is None else "out of date")
    path = branch.require("skeleton.csv", "reconstruct")
    return read_skeleton(path), branch.manifest.alignment, "current"


def _belong(early: Any, made: Any) -> bool:
    """Whether a stored skeleton and a mesh are of the same scan and settings, apart from edits."""
    def source(entry: Any) -> dict[str, str]:
        return {name: value for name, value in entry.reads.items() if name != "edits"}
    # In this version's form: one of them may have been written before a setting was added.
    return (_settings(early) == _settings(made)) and source(early) == source(made)


def _settings(entry: Any) -> Any:
    from limber.geometry.settings import ReconstructSettings

    return ReconstructSettings.model_validate(entry.settings)


def _remade(branch: Branch, edits: Sequence[Edit], progress: Progress) -> None:
    """Apply edits to the skeleton as found; make surface and mesh of the result."""
    from limber.geometry.io.clouds import read_points
    from limber.geometry.reconstruction import labelled, mesh_skeleton
    from limber.geometry.skeleton.alternatives import SearchDoubts, alternatives, entries
    from limber.geometry.skeleton.confidence import shares
    from limber.geometry.skeleton.edits import edited, edits_text
    from limber.geometry.skeleton.plausibility import without_volumes
    from limber.geometry.skeleton.totals import totals
    from limber.store.loading import load_found_skeleton, load_masses

    known = branch.manifest.stages
    made, early = known.get("reconstruct"), known.get("skeleton")
    if made is None or early is None or not _belong(early, made):
        raise InputError(
            f"{branch.folder} has no mesh of this skeleton.",
            "The last reconstruct failed. The scan is needed again.",
            "Run ", Command("reconstruct", "CLOUD", "-o", "NAME.branch", Option("edits"), "FILE"),
            ".")
    settings = _settings(made)
    alignment = branch.manifest.alignment
    digests = {name: value for name, value in made.reads.items() if name != "edits"}
    found = load_found_skeleton(branch, alignment, settings.unit)
    skeleton = edited(found, [edit.aligned(alignment) for edit in edits])
    cloud = read_points(branch.require("cloud.ply", "reconstruct"))
    warnings = list(made.result.get("skeleton_warnings", []))
    leaves = [mass for mass in load_masses(branch) if mass.get("kind") == "leaf"]
    with branch.stage("reconstruct", settings, digests=digests | edits_digest(edits)) as stage:
        meshed = mesh_skeleton(skeleton, settings, branch.gravity,
                               progress.keeping(warnings))
        write_branch(stage, labelled(cloud, skeleton),
                     replace(meshed, masses=[*meshed.masses, *leaves]))
        if edits:
            stage.write(EDITS, edits_text(edits))
        else:
            stage.remove(EDITS)
        doubts = SearchDoubts.of(made.result)
        stage.result.update(made.result | meshed.numbers | totals(skeleton, doubts) | {
            "alternatives": entries(alternatives(skeleton, doubts),
                                    lambda edit: edit.in_file(alignment)),
            "length_shares": shares(skeleton), "warnings": warnings} | (
                {} if "surface_share" not in made.result else without_volumes(
                    made.result["surface_share"])))


def _write(skeleton: Skeleton, path: Path, unit: str) -> None:
    from limber.geometry.io.skeletons import write_cylinders

    if path.suffix.lower() not in (".swc", ".csv"):
        raise InputError(f"{path} is neither .swc nor .csv.", "A skeleton is written as one of "
                                                              "them.",
                         "Use one of them.")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.suffix.lower() == ".swc":
            skeleton.write_swc(path, unit=unit)
        else:
            write_cylinders(skeleton, path)
    except OSError as error:
        raise InputError(f"{path} cannot be written ({error.strerror}).",
                         "The skeleton goes there.", "Choose another location.") from error


def _part_entry(uncertain_part: DoubtfulPart, alignment: Alignment) -> dict[str, Any]:
    return {
        "kind": uncertain_part.kind,
        "branch": uncertain_part.branch,
        "at": np.round(alignment.undo(uncertain_part.at[None])[0], 6),
        "at_m": uncertain_part.at,
        "length_m": uncertain_part.length,
        "radius_m": uncertain_part.radius,
        "value": None if math.isnan(uncertain_part.value) else uncertain_part.value,
    }
