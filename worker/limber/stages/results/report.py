"""Write one HTML page with figures and tables of all results."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from pydantic import Field

from limber.core.files.atomic import file_digest, require_file
from limber.core.progress import SILENT, Progress
from limber.core.settings import Groups
from limber.stages.inputs import BranchInputs, NoSettings, RunOptions, by_name
from limber.stages.registry import StageDescription, result_kinds, result_of
from limber.stages.result import Written
from limber.stages.shape.mesh import MeshNumbers, Shape
from limber.store import Branch
from limber.version import VERSION

if TYPE_CHECKING:
    from limber.geometry.skeleton.qsm_tables import Caliper
    from limber.results.report.section import Section
    from limber.stages.result import Result

_ORDER = ("pull", "estimate", "swing", "vibration", "simulate", "load")
"""Results in the order of the page; others follow in that of the stages."""


class ReportInputs(BranchInputs):
    """A branch folder, and a picture of it."""

    groups: ClassVar[Groups] = {"input": ("picture", "caliper")}
    common = ("caliper",)

    picture: Path | None = Field(
        None, description="A PNG for the top of the page, such as a render of `limber scene`.")
    caliper: Path | None = Field(
        None, description="Measured diameters to compare with the scan's: a CSV with the columns "
        "along_m (from the root along the main path) and diameter_mm.")


def write_report(folder: Path, *, picture: Path | None = None, caliper_path: Path | None = None,
                 force: bool = False, progress: Progress = SILENT) -> dict[str, Any]:
    """Write ``report.html`` into a branch folder for the stages that have been run.

    Args:
        folder: The branch folder.
        picture: A render of the scene to put at the top, PNG.
        caliper_path: Measured diameters, see
            :func:`limber.geometry.skeleton.qsm_tables.read_calipers`.

    Returns:
        ``report`` (its path), ``figure_count``, ``sections`` and the ``missing`` ones;
        ``calipers``, the scan's diameters against the measured ones.

    Raises:
        InputError: the picture or the measured diameters cannot be used.
    """
    from limber.geometry.skeleton.qsm_tables import against_calipers, read_calipers
    from limber.results.report.page import with_picture
    from limber.results.report.section import read_png
    from limber.store.loading import load_skeleton

    branch = Branch.open(folder)
    png = None if picture is None else read_png(picture)
    calipers = [] if caliper_path is None else read_calipers(caliper_path)
    settings, digests = {"picture": bool(picture)}, _shown(branch, picture, caliper_path)
    if not force and branch.is_current("report", settings, digests=digests):
        return branch.manifest.stages["report"].result | {"report": branch.path("report.html")}
    if not force and png and branch.is_current(
            "report", {"picture": False}, digests=_shown(branch, None, caliper_path)):
        html = branch.path("report.html").read_text(encoding="utf-8")
        found = branch.manifest.stages["report"].result
    else:
        html, page = page_of(branch, calipers=calipers, progress=progress)
        found = {"figure_count": sum(len(section.pictures) for section in page),
                 "sections": [section.title for section in page if not section.missing],
                 "missing": [section.title for section in page if section.missing]}
        if calipers:
            found["calipers"] = against_calipers(load_skeleton(branch), calipers)
    if png:
        html = with_picture(html, png)
        found = found | {"figure_count": found["figure_count"] + 1}
    with branch.stage("report", settings, digests=digests) as stage:
        stage.path("report.html").write_text(html, encoding="utf-8")
        stage.result.update(found)
    progress(1.0, "written")
    return branch.manifest.stages["report"].result | {"report": branch.path("report.html")}


def page_of(branch: Branch, *, calipers: "Sequence[Caliper]" = (), progress: Progress = SILENT,
            ) -> "tuple[str, list[Section]]":
    """Return the page of a branch as HTML, and its sections."""
    from limber.results.report.page import draw_page

    values = branch.made.result if branch.made else {}
    return draw_page(branch, _sections(branch), shape=Shape.of(values).rows(),
                     mesh=MeshNumbers.of(values).rows(), calipers=calipers, progress=progress)


def _section_of(branch: Branch, key: str) -> "Section | None":
    return result_of(branch, key, branch.manifest.stages[key].result).section(branch, key)


def _sections(branch: Branch) -> "list[Callable[[Branch], Section | None]]":
    """Functions that make the sections of the results, in the order of the page."""
    words = sorted(result_kinds(), key=(_ORDER + tuple(result_kinds())).index)
    keys: dict[type[Result], list[str]] = {}
    for word in words:
        keys.setdefault(result_kinds()[word], []).extend(
            key for key in sorted(branch.manifest.stages) if key.partition(":")[0] == word)
    found: list[Callable[[Branch], Section | None]] = []
    for kind, known in keys.items():
        found += [partial(_section_of, key=key) for key in known] or (
            [partial(_gap, kind)] if kind.missing else [])
    return found


def _gap(kind: "type[Result]", _branch: Branch) -> "Section":
    from limber.results.report.section import Section

    return Section(kind.heading.partition(":")[0], missing=kind.missing)


def _shown(branch: Branch, picture: Path | None, caliper_path: Path | None) -> dict[str, str]:
    """Digests of all inputs of the page."""
    outside = {"picture": picture, "caliper": caliper_path}
    return {"folder": branch.manifest.content_digest(), "limber": VERSION} | {
        name: file_digest(require_file(path, f"A {name} file"))
        for name, path in outside.items() if path is not None}


STAGE = StageDescription(
    "report", 110, by_name(write_report, folder="branch_folder", caliper_path="caliper"),
    ReportInputs, NoSettings, RunOptions, key="report",
    result=Written, writes=("report.html",),
    found=("A page with {figure_count} figures. Open it in a browser.",
           lambda result: ("Not done yet: " + ", ".join(result["missing"]) + "."
                           if result["missing"] else None)),
    step="report", label="Write Report")
