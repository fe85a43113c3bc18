"""``report.html``: figures and tables of all results of a branch, in one file."""

from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from functools import partial
from typing import Any

import numpy as np

from limber.core.optional import require_extra
from limber.core.progress import SILENT, Progress
from limber.estimation.estimate_file import read_estimate
from limber.geometry.skeleton import qsm_tables
from limber.geometry.skeleton.alternatives import SearchDoubts, open_questions
from limber.geometry.skeleton.confidence import DoubtfulPart, doubtful_parts
from limber.geometry.skeleton.qsm_tables import Caliper
from limber.results.findings import ASSUMED, simulated_pull, telling_sentence
from limber.results.report import figures
from limber.results.report.report_tables import (
    action_rows,
    alternative_rows,
    caliper_rows,
    cause_rows,
    diameter_rows,
    doubtful_rows,
    order_rows,
    share_rows,
)
from limber.results.report.section import Section, inline_png
from limber.store import Branch
from limber.store.loading import load_skeleton, load_targets
from limber.version import VERSION

# The report's sections on a branch's shape: scan and skeleton, cylinders, mesh.

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


_SOURCE_LABELS = {"file": "source", "unit": "unit of length", "sha256": "sha256 of the source",
                  "truth": "known truth"}


def draw_page(branch: Branch, sentences: list[str],
              results: Sequence[Callable[[Branch], Section | None]], *,
              shape: list[list[str]], mesh: list[list[str]], calipers: Sequence[Caliper] = (),
              progress: Progress = SILENT) -> tuple[str, list[Section]]:
    """Return the page for the stages that have been run, as HTML, and its sections, by what was
    found, builders of each, rows of shape and mesh, and caliper diameters to compare with the
    scan's. InputError for a diameter beyond the branch; MissingDependencyError without the extra
    ``report``."""
    require_extra("report", ("matplotlib", "jinja2"), "The report")
    page = [_found(branch, sentences), *_held_back(branch), _summary(branch, shape)]
    builders: list[Callable[[Branch], Section | None]] = [
        scan_section, partial(cylinders_section, calipers=calipers),
        partial(mesh_section, rows=mesh), *results, _provenance]
    for number, build in enumerate(builders):
        progress(number / len(builders), "drawing")
        if section := build(branch):
            page.append(section)
    return _render(branch, page), page


def with_picture(html: str, png: bytes) -> str:
    """Return a page with a render of the scene at the end of its first section."""
    figure = (f'<figure><img src="{inline_png(png)}" alt="Rendered scene.">'
              "<figcaption>Rendered scene.</figcaption></figure>\n")
    return html.replace("</section>", f"{figure}</section>", 1)


def _found(branch: Branch, sentences: list[str]) -> Section:
    """The findings in one paragraph, and their limits."""
    section, pull = Section("What was found"), simulated_pull(branch)
    if pull is not None:
        section.text.append(ASSUMED if pull["young_assumed"] else (
            "The branch was generated and its pull simulated, so that the true modulus is known."))
    if not branch.has("estimate.json"):
        sentences = ["Young's modulus has not been estimated from a pull: what follows holds for "
                     "the modulus that the mesh has.", *sentences]
    section.text.append(" ".join(sentences))
    return section


def _held_back(branch: Branch) -> list[Section]:
    """The causes of the estimate's uncertainty and their remedies: the first section."""
    if not branch.has("estimate.json"):
        return []
    estimate = read_estimate(branch.path("estimate.json"))
    rows = cause_rows(estimate)
    if not rows:
        return []
    actions = action_rows(estimate)
    return [Section("What limits the estimate", text=[
        f"{telling_sentence(estimate)} The main causes follow, largest first."],
        tables=[("", rows), *([("What to do next, best first", actions)] if actions else [])])]


def _summary(branch: Branch, shape: list[list[str]]) -> Section:
    section = Section("Summary")
    rows = [["item", "value"]]
    source = branch.manifest.source
    rows += [[_SOURCE_LABELS.get(key, key.replace("_", " ")), str(value)]
             for key, value in source.items() if isinstance(value, str | int | float)]
    rows += [[f"{label} (95 % interval)", f"{value} ({between[0]})"] if any(between)
             else [label, value] for label, value, *between in shape[1:]]
    section.tables.append(("", rows))
    return section


def _provenance(branch: Branch) -> Section:
    section = Section("How it was made")
    rows = [["stage", "finished", "settings"]]
    programs: dict[str, str] = {}
    for key, entry in branch.manifest.stages.items():
        settings_text = ", ".join(f"{name} {_setting(value)}" for name, value
                                  in entry.settings.items()
                                  if value not in (None, []))
        rows.append([key, entry.finished[:16].replace("T", " "), settings_text])
        programs |= entry.programs
    section.tables.append(("Stages (times in UTC)", rows))
    section.tables.append(("Programs", [["program", "version"],
                                        *([name, v] for name, v in sorted(programs.items()))]))
    return section


def _setting(value: Any) -> str:
    if isinstance(value, list):
        return "(" + ", ".join(map(_setting, value)) + ")"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _render(branch: Branch, page: list[Section]) -> str:
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("limber.results.report", "."), autoescape=True,
        undefined=jinja2.StrictUndefined)
    made = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
    return environment.get_template("page.html").render(
        name=branch.name, sections=page, made=made, version=VERSION)
