"""The progress of a batch: lines appended as it proceeds, so that they survive any end."""

import html
import json
import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from logging.handlers import RotatingFileHandler
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from scipy.spatial import cKDTree

from limber.batch.job_file import BranchJob, JobFile, fingerprint
from limber.core.errors import LimberError
from limber.core.files.atomic import is_alive, write_atomically
from limber.core.files.tables import table_text
from limber.core.not_none import present
from limber.geometry.io.skeletons import read_swc
from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.tets.tet_mesh import TetMesh
from limber.results.scene.colours import colour_scale, css_colours
from limber.stages.stage import Stage
from limber.store.journal import Stream, stream_lines
from limber.version import VERSION

_LEAST_LINES, _MOST_TIMES = 2000, 4
"""The file is shortened when it has this many lines, and this many times the valid ones."""
WAITING, RUNNING, DONE, KEPT, FAILED = "waiting", "running", "done", "up to date", "failed"


@dataclass(frozen=True)
class Record:
    """The state of a task: ``numbers`` of its result, ``memory_mb`` its largest, ``content`` the
    digest of the branch shown by a stage that stores no results in it."""

    status: str = WAITING
    error: str = ""
    seconds: float | None = None
    memory_mb: float | None = None
    warnings: tuple[str, ...] = ()
    numbers: dict[str, float] = field(default_factory=dict)
    content: str = ""

    @property
    def has_succeeded(self) -> bool:
        return self.status in (DONE, KEPT)


class Records:
    """The records of a job file's tasks, by branch and fingerprint."""

    def __init__(self, jobs: JobFile):
        self.path = jobs.out / f"{jobs.path.stem}.jobs.jsonl"
        self._found: dict[tuple[str, str], Record] = {}
        self._stream: Stream | None = None
        for line in stream_lines(self.path) if self.path.is_file() else ():
            self._take(line)

    def of(self, branch: BranchJob, task: Stage) -> Record:
        """Return the state of a task; one that ran when its batch was killed is waiting."""
        return self._found.get((branch.name, fingerprint(task)), Record())

    @contextmanager
    def writing(self) -> Iterator[None]:
        """Acquire the right to append; another batch of this job file is refused meanwhile."""
        with Stream(self.path, _last_of_each) as self._stream:
            yield
        self._stream = None

    def begin(self, branch: BranchJob, task: Stage) -> None:
        import psutil

        self._append(branch, task, {"status": RUNNING, "process": [
            os.getpid(), round(psutil.Process().create_time())]})

    def end(self, branch: BranchJob, task: Stage, record: Record) -> None:
        self._append(branch, task, {**vars(record)})

    def _append(self, branch: BranchJob, task: Stage, record: dict[str, Any]) -> None:
        line = json.dumps({"branch": branch.name, "stage": task.label,
                           "task": fingerprint(task), **record})
        present(self._stream, "right to append to the records").append(line)
        self._take(line)

    def _take(self, line: str) -> None:
        try:
            entry = json.loads(line)
            key = (str(entry["branch"]), str(entry["task"]))
            status = str(entry["status"])
            if status == RUNNING:
                process, since = entry["process"]
                record = Record(RUNNING) if is_alive(int(process), int(since)) else Record()
            else:
                record = Record(status, str(entry["error"]), entry["seconds"], entry["memory_mb"],
                                tuple(entry["warnings"]), dict(entry["numbers"]),
                                str(entry.get("content", "")))
        except (ValueError, KeyError, TypeError, RecursionError):
            # A damaged line is ignored: its task runs again, and its result is kept if it is up to
            # date.
            return
        self._found[key] = record


def _last_of_each(lines: Iterator[str]) -> list[str] | None:
    """The last line of each task, if there are many more; a night's runs leave thousands."""
    last: dict[tuple[str, str], str] = {}
    count = 0
    for line in lines:
        count += 1
        try:
            entry = json.loads(line)
            last[str(entry["branch"]), str(entry["task"])] = line
        except (ValueError, KeyError, TypeError, RecursionError):
            # Damaged: ignored, as when it is read.
            continue
    return list(last.values()) if count > max(_LEAST_LINES, _MOST_TIMES * len(last)) else None


def numbers_of(result: dict[str, Any], longest: int = 12) -> dict[str, float]:
    """Return the numbers of a result, those of short lists one by one: ``young_pa_1``."""
    found: dict[str, float] = {}
    for key, value in result.items():
        items = value if isinstance(value, list) else [value]
        if len(items) > longest or not all(
                isinstance(one, int | float) and not isinstance(one, bool) for one in items):
            continue
        names = [key] if items is not value else [f"{key}_{n}" for n in range(1, len(items) + 1)]
        found |= dict(zip(names, items, strict=True))
    return found


def path_of_table(jobs: JobFile) -> Path:
    """Return the path of the table of results."""
    return jobs.out / f"{jobs.path.stem}.csv"


def path_of_page(jobs: JobFile) -> Path:
    """Return the path of the summary."""
    return jobs.out / f"{jobs.path.stem}.html"


# The log of a batch: a text file of limited size.

MOST_BYTES = 1_000_000
LOGS_KEPT = 3
"""Older files that are kept besides the newest: ``JOBS.log.1`` ..."""


def log_of(jobs: JobFile) -> logging.Handler:
    """Return the batch's log, to be closed; a line that cannot be written, on a full disk, is
    printed on standard error."""
    handler = RotatingFileHandler(jobs.out / f"{jobs.path.stem}.log", maxBytes=MOST_BYTES,
                                  backupCount=LOGS_KEPT, encoding="utf-8", delay=True)
    handler.setFormatter(logging.Formatter("%(asctime)s %(message)s"))
    return handler


def tell(log: logging.Handler, *parts: str) -> None:
    """Append a line made of these parts, with the time."""
    text = " ".join(" ".join(filter(None, parts)).split())
    log.handle(logging.makeLogRecord({"msg": "%s", "args": (text,)}))


# The summary of a batch: a table with one row per branch, and an HTML page.

# A picture of each branch for the summary: its axes from two sides, coloured by modulus.

HEIGHT = 150
"""Size of a picture [pixels]."""
_EDGE = 6
_WOOD = "#5a4632"
_VIEWS = (("from the front", 0), ("from the side", 1))


def pictures(folder: Path) -> str:
    """Return drawings (SVG) of a branch, with the range of the mesh's modulus, or brown if uniform
    or unknown; empty if it has no axes."""
    try:
        skeleton = read_swc(folder / "skeleton.swc")
    except (OSError, LimberError):
        return "<div class=pictures></div>"
    young = _moduli(folder / "mesh.vtu", skeleton)
    colours, caption = [_WOOD] * skeleton.node_count, ""
    if young is not None:
        scale = colour_scale(young, "Young's modulus", "Pa", "viridis")
        colours = css_colours(young, scale)
        caption = (f"<p class=range>Young's modulus {scale['ticks'][0]} (dark) to "
                   f"{scale['ticks'][-1]} (bright)</p>")
    drawn = "".join(_view(skeleton, colours, label, axis) for label, axis in _VIEWS)
    return f"<div class=pictures>{drawn}{caption}</div>"


def _moduli(path: Path, skeleton: Skeleton) -> np.ndarray | None:
    """Young's modulus at each node [Pa]; None if it is unknown or uniform."""
    try:
        mesh = TetMesh.read(path)
    except (OSError, LimberError):
        # No mesh yet, or a damaged one: its own stage reports it.
        return None
    young = mesh.cell_data.get("young")
    if young is None or not (np.isfinite(young) & (young > 0)).all():
        return None
    near = cKDTree(mesh.centroids).query(skeleton.nodes)[1]
    found = np.asarray(young, float)[near]
    return found if found.max() > 1.001 * found.min() else None


def _view(skeleton: Skeleton, colours: list[str], label: str, axis: int) -> str:
    flat = skeleton.nodes[:, [axis, 2]]
    low, size = flat.min(axis=0), np.maximum(np.ptp(flat, axis=0), 1e-9)
    scale = (HEIGHT - 2 * _EDGE) / max(size[1], size[0] / 2)
    pixels = (flat - low) * scale + _EDGE
    width = size[0] * scale + 2 * _EDGE
    pixels[:, 1] = HEIGHT - pixels[:, 1]
    lines = "".join(_lines(skeleton, pixels, colours, scale))
    return (f"<svg class=sketch viewBox='0 0 {width:.0f} {HEIGHT}' width={width:.0f} "
            f"height={HEIGHT} stroke-linecap=round role=img aria-label='{html.escape(label)}'>"
            f"<title>{html.escape(label)}</title>{lines}</svg>")


def _lines(skeleton: Skeleton, pixels: np.ndarray, colours: list[str], scale: float,
           ) -> Iterator[str]:
    thick = np.maximum(2 * skeleton.radius * scale, 0.7)
    for node, up in enumerate(skeleton.parent):
        if up >= 0:
            yield (f"<line x1='{pixels[up, 0]:.1f}' y1='{pixels[up, 1]:.1f}' "
                   f"x2='{pixels[node, 0]:.1f}' y2='{pixels[node, 1]:.1f}' "
                   f"stroke='{colours[node]}' stroke-width='{thick[node]:.1f}'/>")


_COLORS = {DONE: "#2d7a3a", KEPT: "#6c9a74", FAILED: "#b3261e", RUNNING: "#1f5fa8",
           WAITING: "#888888"}
_FORMULA = ("=", "+", "-", "@", "\t", "\r")


def counts(jobs: JobFile, records: Records) -> dict[str, int]:
    """Return how many branches are done, failed, running and waiting."""
    found = dict.fromkeys(("done", "failed", "running", "waiting"), 0)
    for branch in jobs.branches:
        found[branch_status(branch, records)] += 1
    return found


def branch_status(branch: BranchJob, records: Records) -> str:
    """Return ``done``, ``failed``, ``running`` or ``waiting``."""
    states = [records.of(branch, task).status for task in branch.tasks]
    if FAILED in states:
        return "failed"
    if RUNNING in states:
        return "running"
    return "done" if all(state in (DONE, KEPT) for state in states) else "waiting"


def failures(jobs: JobFile, records: Records) -> list[tuple[str, str, str]]:
    """Return branch, stage and reason of each failure."""
    return [(branch.name, task.label, record.error) for branch in jobs.branches
            for task in branch.tasks if (record := records.of(branch, task)).status == FAILED]


def write_table(jobs: JobFile, records: Records) -> None:
    """Write the CSV: one row per branch, with the results of its stages side by side."""
    rows = [_row(branch, records) for branch in jobs.branches]
    columns = list(dict.fromkeys(key for row in rows for key in row))
    write_atomically(path_of_table(jobs), table_text(
        columns, ([_cell(row.get(key)) for key in columns] for row in rows)))


def _row(branch: BranchJob, records: Records) -> dict[str, Any]:
    row: dict[str, Any] = {"branch": branch.name, **branch.sweep,
                           "status": branch_status(branch, records)}
    for task in branch.tasks:
        record = records.of(branch, task)
        row |= {f"{task.label}.status": record.status, f"{task.label}.seconds": record.seconds,
                f"{task.label}.memory_mb": record.memory_mb}
        row |= {f"{task.label}.{key}": value for key, value in record.numbers.items()}
    reasons = [records.of(branch, task).error for task in branch.tasks]
    return row | {"error": " ".join(filter(None, reasons))}


def _cell(value: Any) -> str:
    """Return a value, with all its digits, that no spreadsheet interprets as a formula."""
    if isinstance(value, str) and value.startswith(_FORMULA):
        return f"'{value}"
    return "" if value is None else str(value)


def write_page(jobs: JobFile, records: Records) -> None:
    """Write the page: number of finished branches, failures and reasons, time, memory, pictures."""
    write_atomically(path_of_page(jobs), "\n".join(_page(jobs, records)) + "\n")


def _page(jobs: JobFile, records: Records) -> Iterator[str]:
    title = html.escape(jobs.path.name)
    yield ("<!doctype html><html lang=en><meta charset=utf-8>"
           "<meta name=viewport content='width=device-width'>"
           f"<title>{title}: Limber batch</title><style>{_STYLE}</style>")
    yield f"<h1>{title}</h1>"
    totals = ", ".join(f"{count} {name}" for name, count in counts(jobs, records).items() if count)
    seconds = sum(records.of(branch, task).seconds or 0.0
                  for branch in jobs.branches for task in branch.tasks)
    yield (f"<p>{len(jobs.branches)} branches: {totals}. {seconds / 60:.1f} minutes of work. "
           f"Limber {VERSION}.</p>")
    failed = failures(jobs, records)
    if failed:
        yield "<h2>Failed</h2><table><tr><th>branch<th>stage<th>why</tr>"
        for cells in failed:
            yield "<tr>" + "".join(f"<td>{html.escape(cell)}" for cell in cells) + "</tr>"
        yield "</table>"
    yield "<h2>Branches</h2>"
    for branch in jobs.branches:
        yield from _branch(branch, records, path_of_page(jobs))


def _branch(branch: BranchJob, records: Records, page: Path) -> Iterator[str]:
    swept = ", ".join(f"{key} = {value}" for key, value in branch.sweep.items())
    yield (f"<section>{pictures(branch.folder)}<div><h3>{_title(branch, page)}</h3>"
           f"{_rendered(branch, page)}")
    if swept:
        yield f"<p>{html.escape(swept)}</p>"
    yield "<table><tr><th>stage<th>status<th>time [s]<th>memory [MB]<th></tr>"
    for task in branch.tasks:
        record = records.of(branch, task)
        yield (f"<tr><td>{html.escape(task.label)}"
               f"<td style='color:{_COLORS[record.status]}'>{record.status}"
               f"<td>{_number(record.seconds, 1)}<td>{_number(record.memory_mb, 0)}"
               f"<td>{html.escape(_messages(record))}</tr>")
    yield "</table></div></section>"


def _title(branch: BranchJob, page: Path) -> str:
    """The branch's name, with a link to its report if it has one."""
    name, link = html.escape(branch.name), _relative_link(branch.folder / "report.html", page)
    return f"<a href='{link}'>{name}</a>" if link else name


def _rendered(branch: BranchJob, page: Path) -> str:
    """The branch's pictures that `limber scene` has rendered."""
    images = (getattr(task, kind, None) for task in branch.tasks
              for kind in ("render", "turntable"))
    links = [link for path in images if path and (link := _relative_link(path, page))]
    return "".join(f"<a href='{link}'><img src='{link}' alt='rendered' loading=lazy></a>"
                   for link in links)


def _relative_link(path: Path, page: Path) -> str:
    """The relative link from the page to a file beside it; empty if the file does not exist."""
    if not path.is_file():
        return ""
    try:
        link = Path(os.path.relpath(path.resolve(), page.resolve().parent)).as_posix()
    except ValueError:
        # On another drive (Windows) there is no relative path.
        return ""
    return html.escape(quote(link))


def _messages(record: Record) -> str:
    return " ".join(filter(None, (record.error, *record.warnings)))


def _number(value: float | None, digits: int) -> str:
    return "" if value is None else f"{value:.{digits}f}"


_STYLE = ("body{font:15px/1.45 system-ui,sans-serif;max-width:60em;margin:2em auto;padding:0 1em}"
          "table{border-collapse:collapse}td,th{padding:.15em .7em .15em 0;text-align:left;"
          "vertical-align:top}section{display:flex;gap:1.5em;border-top:1px solid #ddd;"
          "padding:.8em 0}h3{margin:.1em 0 .4em}.pictures{width:310px;flex:none}"
          "img{max-width:230px;margin:0 6px 6px 0}.sketch{max-width:150px;margin-right:6px}"
          ".range{color:#666;margin:.1em 0;font-size:.85em}")
