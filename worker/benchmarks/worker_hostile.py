"""Branch folders from strangers that try to read, write or remove files outside themselves.

Each is made in a folder of its own, with files of a victim around it; then every command that opens
a branch folder is called on it in this process. A snapshot of everything except the branch folder
itself is compared before and after. The victim's words must not be in any output, and no command
may end with a traceback or take over ten seconds.
"""

import contextlib
import hashlib
import io
import os
import shutil
import signal
import stat
import tempfile
import time
import traceback
import zipfile
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from benchmarks.hostile_folders import LAYOUTS, SECRET
from benchmarks.table import Asked, Row, Setting
from benchmarks.worker_readers import addon_module
from limber.cli.main import call
from limber.core.errors import LimberError
from limber.store import Branch

HOSTILE_ROWS = (
    Asked("hostile folders (200 asked), every command on each: files outside touched or read", "0"),
    Asked("hostile folders: traces, and commands over 10 s of processor time", "0"))
_MOST_SECONDS = 10.0
_LONGEST_WAIT = 120


def hostile(setting: Setting, template: Path) -> list[Row]:
    """Two rows: files touched outside, and commands that ended in a traceback or took too long."""
    touched: list[str] = []
    failed: list[str] = []
    opened = Counter()
    names = list(LAYOUTS)
    numbers = setting.budget.seeds(0, setting.at_most(200, len(names)), at_least=len(names))
    count = 0
    for number in numbers:
        count += 1
        name = names[number % len(names)]
        setting.progress(number / 200, name)
        with tempfile.TemporaryDirectory(prefix="limber-hostile-") as place:
            folder = _place(Path(place), template)
            LAYOUTS[name](folder, setting.generator(number))
            before = snapshot(Path(place), folder)
            for command, arguments in commands(folder):
                code, trouble = _called(arguments)
                opened[command, code == 0] += 1
                failed += [f"{name} {number}: {command}: {trouble}"] if trouble else []
                changed = differences(before, snapshot(Path(place), folder))
                told = _secrets(folder.parent / "out")
                touched += [f"{name} {number}: {command}: {each}" for each in (*changed, *told)]
                if changed:
                    before = snapshot(Path(place), folder)
    for line in (*touched[:20], *failed[:20]):
        print(line)
    refused = sum(number for (_, worked), number in opened.items() if not worked)
    told = f"{len(touched)} ({count} folders, {opened.total()} commands, {refused} refused)"
    return [Row(*HOSTILE_ROWS[0], told, not touched, count),
            Row(*HOSTILE_ROWS[1], str(len(failed)), not failed, count)]


def _place(place: Path, template: Path) -> Path:
    """Lay out a copy of the template with a victim's files above and beside it; return the copy."""
    inner = place / "home" / "in"
    inner.mkdir(parents=True)
    for path in (place / "victim.txt", inner.parent / "victim.txt", inner / "victim.txt",
                 inner.parent / "precious" / "victim.txt"):
        path.parent.mkdir(exist_ok=True)
        path.write_text(SECRET)
    (inner / "out").mkdir()
    return Path(shutil.copytree(template, inner / "a.branch"))


def commands(folder: Path) -> Iterator[tuple[str, list[str]]]:
    """Yield the name and the arguments of every command that opens a branch folder quickly."""
    out, name = folder.parent / "out", str(folder)
    yield "verify", ["verify", name]
    yield "bug-report", ["bug-report", name, "-o", str(out / "bug.zip"), "--data"]
    yield "predict", ["predict", name, "--weight", "0.1"]
    yield "scene", ["scene", name, "--data", str(out / "scene.npz")]
    yield "export", ["export", name, "-o", str(out / "b.urdf")]
    yield "skeleton", ["skeleton", name]
    yield "python", ["", name]
    yield "finish", ["verify", "--finish", name]
    yield "report", ["report", name]


def _called(arguments: list[str]) -> tuple[int, str]:
    """Call one command; return its exit code and the fault, or an empty text."""
    begun, told = time.process_time(), io.StringIO()
    signal.signal(signal.SIGALRM, _waited)
    signal.alarm(_LONGEST_WAIT)
    try:
        with contextlib.redirect_stderr(told), contextlib.redirect_stdout(io.StringIO()):
            code = call([*arguments, "--json"]) if arguments[0] else _written(Path(arguments[1]))
    except (Exception, _Waits):
        return 3, traceback.format_exc(limit=-3)
    finally:
        signal.alarm(0)
    if "Traceback" in told.getvalue():
        return code, told.getvalue()[-600:]
    seconds = time.process_time() - begun
    return code, f"{seconds:.0f} s" if seconds > _MOST_SECONDS else ""


class _Waits(BaseException):
    """A command waits, for example for a pipe that nobody writes to."""


def _waited(_signal: int, _frame: object) -> None:
    raise _Waits(f"still waiting after {_LONGEST_WAIT} s")


def _written(folder: Path) -> int:
    """Open, run a stage and append to a stream, as a Python program does, after the add-on has read
    the data of its panels.
    """
    addon_module("branch_folder").read_record(folder)
    addon_module("live_force").read(folder)
    try:
        branch = Branch.create(folder)
        with branch.stream("pulls/p/robot.csv") as stream:
            stream.append("1,2")
        with branch.stage("probe", {"n": 1}) as stage:
            stage.path("pulls/p/note.txt").write_text("note")
            for name in branch.streams():
                stage.adopt(name)
            for name in branch.manifest.files:
                if name.startswith("frames/"):
                    stage.remove(name)
        return 0
    except LimberError as error:
        return error.exit_code


def snapshot(place: Path, folder: Path) -> dict[str, tuple]:
    """Return the entries at ``place`` outside ``folder`` and the commands' outputs: by name the
    kind, mode, size, time and content.
    """
    found = {}
    for at, folders, files in os.walk(place):
        here = Path(at)
        folders[:] = [name for name in folders if here / name != folder
                      and here / name != folder.parent / "out"]
        for name in (*folders, *files):
            path = here / name
            about = path.lstat()
            content = (os.readlink(path) if path.is_symlink() else
                       hashlib.sha256(path.read_bytes()).hexdigest()
                       if stat.S_ISREG(about.st_mode) else "")
            found[str(path)] = (stat.S_IFMT(about.st_mode), stat.S_IMODE(about.st_mode), content,
                                about.st_mtime_ns if stat.S_ISREG(about.st_mode) else 0)
    return found


def differences(before: dict[str, tuple], after: dict[str, tuple]) -> list[str]:
    """Return the files made, removed or changed between two snapshots."""
    return [f"{path} was {'made' if path not in before else 'removed' if path not in after else ''}"
            f"{'changed' if path in before and path in after else ''}"
            for path in sorted(before.keys() | after.keys())
            if before.get(path) != after.get(path)]


def _secrets(out: Path) -> list[str]:
    """Return the outputs that contain a victim's words, and remove all outputs."""
    found = []
    for path in sorted(out.iterdir()):
        if path.suffix == ".zip" and zipfile.is_zipfile(path):
            with zipfile.ZipFile(path) as archive:
                contents = [archive.read(name) for name in archive.namelist()]
        else:
            contents = [path.read_bytes()] if path.is_file() else []
        if any(SECRET.encode() in content for content in contents):
            found.append(f"{path.name} holds the words of a file outside")
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    return found
