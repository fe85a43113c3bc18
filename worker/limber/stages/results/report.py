"""Stage ``report``: one HTML page."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from limber.core.files.atomic import file_digest, require_file
from limber.core.progress import SILENT, Progress
from limber.stages.registry import result_kinds, result_of
from limber.stages.result import Written
from limber.stages.shape.mesh import MeshNumbers, Shape
from limber.stages.stage import About, BranchStage, KeptStage, given
from limber.store import Branch
from limber.version import VERSION

if TYPE_CHECKING:
    from limber.geometry.skeleton.qsm_tables import Caliper
    from limber.results.report.section import Section
    from limber.stages.result import Result

_ORDER = ("pull", "estimate", "swing", "vibration", "simulate", "load")
"""Results in the order of the page; others follow in that of the stages."""


class WriteReport(KeptStage, BranchStage):
    """Write one HTML page with figures and tables of all results."""

    about = About(
        "report", 110, Written, key="report", writes=("report.html",),
        found=("A page with {figure_count} figures. Open it in a browser.",
               lambda result: ("Not done yet: " + ", ".join(result["missing"]) + "."
                               if result["missing"] else None)),
        step="report", label="Write Report")

    picture: Path | None = given(
        "A PNG for the top of the page, such as a render of `limber scene`.")
    caliper: Path | None = given(
        "Measured diameters to compare with the scan's: a CSV with the columns along_m (from the "
        "root along the main path) and diameter_mm.", common=True)

    def run(self, progress: Progress = SILENT) -> dict[str, Any]:
        """Write ``report.html`` into a branch folder for the stages that have been run.

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

        branch = Branch.open(self.branch_folder)
        png = None if self.picture is None else read_png(self.picture)
        calipers = [] if self.caliper is None else read_calipers(self.caliper)
        settings, digests = {"picture": bool(self.picture)}, _shown(
            branch, self.picture, self.caliper)
        if branch.is_current("report", settings, digests=digests):
            return branch.manifest.stages["report"].result | {"report": branch.path("report.html")}
        if png and branch.is_current(
                "report", {"picture": False}, digests=_shown(branch, None, self.caliper)):
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
            stage.write("report.html", html)
            stage.result.update(found)
        progress(1.0, "written")
        return branch.manifest.stages["report"].result | {"report": branch.path("report.html")}


def page_of(branch: Branch, *, calipers: "Sequence[Caliper]" = (), progress: Progress = SILENT,
            ) -> "tuple[str, list[Section]]":
    """Return the page of a branch as HTML, and its sections."""
    from limber.results.report.page import draw_page

    values, results = branch.made.result if branch.made else {}, _results(branch)
    return draw_page(branch, _sentences(branch, results), _sections(results),
                     shape=Shape.of(values).rows(), mesh=MeshNumbers.of(values).rows(),
                     calipers=calipers, progress=progress)


def _results(branch: Branch) -> "dict[type[Result], dict[str, Result]]":
    """The branch's results by kind and entry, in the order of the page."""
    found: dict[type[Result], dict[str, Result]] = {}
    for word in sorted(result_kinds(), key=(_ORDER + tuple(result_kinds())).index):
        found.setdefault(result_kinds()[word], {}).update(
            (key, result_of(branch, key, branch.manifest.stages[key].result))
            for key in sorted(branch.manifest.stages) if key.partition(":")[0] == word)
    return found


def _sentences(branch: Branch, results: "dict[type[Result], dict[str, Result]]") -> list[str]:
    """What was found, by the newest result of each kind."""
    return [sentence for known in results.values() if known for sentence in known[max(
        known, key=lambda key: branch.manifest.stages[key].finished)].sentences(branch)]


def _sections(results: "dict[type[Result], dict[str, Result]]",
              ) -> "list[Callable[[Branch], Section | None]]":
    """Functions that make the sections of the results."""
    found: list[Callable[[Branch], Section | None]] = []
    for kind, known in results.items():
        found += [partial(result.section, key=key) for key, result in known.items()] or (
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
