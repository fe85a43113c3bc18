"""``report.html``: figures and tables of all results of a branch, in one file."""

from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from functools import partial
from typing import Any

from limber.core.optional import require_extra
from limber.core.progress import SILENT, Progress
from limber.estimation.estimate_file import read_estimate
from limber.geometry.skeleton.qsm_tables import Caliper
from limber.results.findings import (
    ASSUMED,
    simulated_pull,
)
from limber.results.report.report_tables import action_rows, cause_rows
from limber.results.report.section import Section, inline_png
from limber.results.report.shape_sections import (
    cylinders_section,
    mesh_section,
    scan_section,
)
from limber.store import Branch
from limber.version import VERSION

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
    total = max((estimate.get("young_deviation") or {}).get("total") or [float("nan")])
    return [Section("What limits the estimate", text=[
        f"The largest standard deviation of Young's modulus along the branch is {100 * total:.1f} "
        "%. Its main causes follow, largest first."],
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
