"""The report's sections on a branch's shape: scan and skeleton, cylinders, mesh."""

from collections.abc import Sequence

import numpy as np

from limber.geometry.skeleton import qsm_tables
from limber.geometry.skeleton.alternatives import SearchDoubts, open_questions
from limber.geometry.skeleton.confidence import DoubtfulPart, doubtful_parts
from limber.geometry.skeleton.qsm_tables import Caliper
from limber.results.report import figures
from limber.results.report.report_tables import (
    alternative_rows,
    caliper_rows,
    diameter_rows,
    doubtful_rows,
    order_rows,
    share_rows,
)
from limber.results.report.section import Section
from limber.store import Branch
from limber.store.loading import load_skeleton, load_targets

_DOUBTS_SHOWN = 12


def scan_section(branch: Branch) -> Section:
    section = Section("Scan and skeleton")
    if not (branch.has("cloud.ply") and branch.has("skeleton.swc")):
        section.missing = "limber reconstruct CLOUD -o NAME.branch"
        return section
    targets = load_targets(branch)
    section.draw(figures.scan_and_skeleton(branch, targets),
                 "The aligned cloud (grey) with the centreline tree (one colour per branching "
                 "order), the control points (rings) and the named targets (stars), from the "
                 "front and from the side.")
    if targets:
        section.tables.append(("Named targets", [
            ["target", "x [m]", "y [m]", "z [m]", "mass [kg]"],
            *([target.name, *(f"{value:.3f}" for value in target.position),
               f"{target.mass:.4g}"] for target in targets)]))
    section.draw(figures.radii(branch), "Radius along the centreline, with its uncertainty where "
                                        "known; one colour per branching order.")
    result = branch.made.result if branch.made else {}
    section.text += result.get("warnings") or []
    skeleton = load_skeleton(branch)
    doubtful = [*doubtful_parts(skeleton), *open_questions(skeleton, SearchDoubts.of(result))]
    if doubtful:
        section.tables.append(_doubt_table(doubtful))
    graphs = result.get("alternatives") or []
    if len(graphs) > 1:
        section.tables.append((
            "Alternatives to the skeleton, positions in the scan's coordinates (`limber skeleton "
            "--alternative` applies one)", alternative_rows(graphs)))
    if result.get("clamped_radius_count"):
        section.text.append(f"{result['clamped_radius_count']} radii were limited to the cloud's "
                            "scale.")
    return section


def _doubt_table(doubtful: list[DoubtfulPart]) -> tuple[str, list[list[str]]]:
    rows = doubtful_rows([{
        "kind": part.kind, "branch": part.branch, "at": np.round(part.at, 4),
        "length_m": part.length, "radius_m": part.radius, "value": part.value}
        for part in doubtful[:_DOUBTS_SHOWN]])
    rest = len(doubtful) - _DOUBTS_SHOWN
    more = f"; `limber skeleton` lists {rest} more" if rest > 0 else ""
    return f"Uncertain parts of the skeleton, positions in the branch's frame [m]{more}", rows


def cylinders_section(branch: Branch, calipers: Sequence[Caliper]) -> Section:
    section = Section("Cylinder model")
    if not branch.has("skeleton.swc"):
        section.missing = "limber reconstruct CLOUD -o NAME.branch"
        return section
    skeleton = load_skeleton(branch)
    compared = qsm_tables.against_calipers(skeleton, list(calipers))
    shares = branch.made and branch.made.result.get("length_shares")
    if shares:
        section.tables.append(("Sources of the radii", share_rows(shares)))
    section.tables.append(("By branching order (0 is the main axis)",
                           order_rows(qsm_tables.by_order(skeleton))))
    section.tables.append(("Diameters along the main path",
                           diameter_rows(qsm_tables.diameters_at_heights(skeleton))))
    if compared:
        section.tables.append(("Against calipers", caliper_rows(compared)))
    section.draw(figures.diameters(skeleton, compared),
                 "Diameter along the main path; the band is plus or minus two standard "
                 "deviations.")
    return section


def mesh_section(branch: Branch, rows: list[list[str]]) -> Section:
    section = Section("Mesh")
    if not branch.has("mesh.vtu"):
        section.missing = "limber reconstruct or limber mesh"
        return section
    section.draw(figures.mesh_by_modulus(branch), "The tetrahedral mesh, coloured by Young's "
                                                  "modulus; base in brown, grasp patch in orange.")
    if len(rows) > 1:
        section.tables.append(("", rows))
    return section
