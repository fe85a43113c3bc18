"""One self-contained HTML page with figures and tables of all results."""

from pathlib import Path
from typing import Any

from limber.progress import SILENT, Progress
from limber.report.page import draw_page
from limber.store import Branch


def write_report(folder: Path, *, picture: Path | None = None, progress: Progress = SILENT,
                 ) -> dict[str, Any]:
    """Write ``report.html`` into a branch folder from whatever stages have been run.

    Args:
        folder: The branch folder.
        picture: A render of the scene to put at the top, PNG.

    Returns:
        ``report`` (its path), ``figure_count``, ``sections`` and those ``missing``.
    """
    branch = Branch.open(folder)
    html, page = draw_page(branch, picture=picture, progress=progress)
    with branch.stage("report", {"picture": bool(picture)}) as stage:
        stage.path("report.html").write_text(html, encoding="utf-8")
        stage.result.update(
            figure_count=sum(len(section.pictures) for section in page),
            sections=[section.title for section in page if not section.missing],
            missing=[section.title for section in page if section.missing])
    progress(1.0, "written")
    return branch.manifest.stages["report"].result | {"report": branch.path("report.html")}
