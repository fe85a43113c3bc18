"""Branch folders from strangers that try to read, write or remove files outside themselves.

Each layout changes a good branch folder, two folders below one with files of a victim. Then every
command that opens a branch folder is called on it in this process. A snapshot of everything except
the branch folder itself is compared before and after. The victim's words must not be in any output,
and no command may end with a traceback or take over ten seconds.
"""

import contextlib
import hashlib
import io
import json
import os
import shutil
import signal
import socket
import stat
import tempfile
import time
import traceback
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.table import Asked, Row, Setting
from benchmarks.worker_branch_files import TEMPLATE
from benchmarks.worker_files import addon_module
from limber.cli.main import call
from limber.core.errors import LimberError
from limber.core.files.atomic import owned_name
from limber.store import Branch

SECRET = "The words of the victim, 5f0c2a7e."
Layout = Callable[[Path, np.random.Generator], None]

_NAMES = ("../victim.txt", "../../victim.txt", "pulls/../../victim.txt", "{root}/victim.txt", "..",
          "", ".", "./../victim.txt", "a\\..\\..\\victim.txt", "C:/victim.txt", "C:victim.txt",
          "//server/share/victim.txt", "pulls/.. /victim.txt", "a\0b", "a\nb", "\ud800", "x" * 300,
          "/".join(["d"] * 2000), "branch.json", "BRANCH.JSON", ".commit/x", ".lock", "mesh.vtu/x",
          "~/victim.txt", "$HOME/victim.txt", "pulls/..//../victim.txt", "../in/victim.txt",
          "../precious", "..\\victim.txt", "\u202e/../victim.txt", "/dev/full", "/proc/self/mem")
_PLACES = ("pulls", "pulls/p", "plans", "frames", "frames/to-goal.npz", "mesh.vtu", "surface.ply",
           "energy.npz", "estimate.json", "report.html", "branch.json", ".commit", ".streams",
           ".streams/pulls", ".lock", ".run.lock", ".run.json", "scan_skeleton.csv", "new", "x/y/z",
           ".streams/pulls/p/robot.csv", "pulls/p/note.txt", "skeleton.swc", "cloud.ply")
_TARGETS = ("../victim.txt", "../../victim.txt", "{root}/home/in/victim.txt", "..", "../..",
            "{root}", "../precious", "../not-there", "{root}/not-there/at-all", ".", "/dev/full",
            "/")
_VALUES: tuple[Any, ...] = (None, True, -1, 1e308, 10**30, "", "x", "../../victim.txt", [], {},
                            [[]], {"x": 1}, "\0", "<script>alert(1)</script>", "x" * 100_000)


def manifest(folder: Path) -> dict[str, Any]:
    """Return the manifest of a folder as plain data."""
    return json.loads((folder / "branch.json").read_text())


def entry(content: bytes, stage: str = "estimate") -> dict[str, Any]:
    """Return a manifest's entry for a file with this content."""
    return {"sha256": hashlib.sha256(content).hexdigest(), "bytes": len(content), "stage": stage}


def _drawn(choices: tuple[str, ...], folder: Path, rng: np.random.Generator) -> str:
    return str(choices[int(rng.integers(len(choices)))]).replace("{root}", str(folder.parents[2]))


def _write(folder: Path, content: Any) -> None:
    (folder / "branch.json").write_text(json.dumps(content))


def _evil_file(folder: Path, rng: np.random.Generator) -> None:
    content = manifest(folder)
    content["files"][_drawn(_NAMES, folder, rng)] = entry(SECRET.encode())
    _write(folder, content)


def _evil_writes(folder: Path, rng: np.random.Generator) -> None:
    content, name = manifest(folder), _drawn(_NAMES, folder, rng)
    stage = content["stages"][sorted(content["stages"])[int(rng.integers(len(content["stages"])))]]
    stage["writes"].append(name)
    stage["reads"][name] = hashlib.sha256(SECRET.encode()).hexdigest()
    _write(folder, content)


def _evil_stage(folder: Path, rng: np.random.Generator) -> None:
    content, name = manifest(folder), _drawn(_NAMES, folder, rng)
    key = sorted(content["stages"])[int(rng.integers(len(content["stages"])))]
    content["stages"][f"{key}:{name}"] = content["stages"][key]
    content["name"] = name
    _write(folder, content)


def _journal(folder: Path, rng: np.random.Generator, *, old: bool) -> None:
    """An interrupted commit with an evil name in its manifest, or in the one it replaces."""
    name, content = _drawn(_NAMES, folder, rng), manifest(folder)
    pending = folder / ".commit"
    pending.mkdir()
    new = json.loads(json.dumps(content))
    new["files"]["new.txt"] = entry(b"new")
    (pending / "new.txt").write_bytes(b"new")
    (content if old else new)["files"][name] = entry(SECRET.encode())
    (pending / "branch.json").write_text(json.dumps(new))
    _write(folder, content)


def _clash(folder: Path, rng: np.random.Generator) -> None:
    """A file of a commit is where the folder has a folder, or below one of its files."""
    pending, content = folder / ".commit", manifest(folder)
    for name in (("pulls", "plans", "frames")[int(rng.integers(3))], "mesh.vtu/x"):
        (pending / name).parent.mkdir(parents=True, exist_ok=True)
        (pending / name).write_bytes(b"new")
        content["files"][name] = entry(b"new")
        if rng.random() < 0.5:
            break
    (pending / "branch.json").write_text(json.dumps(content))


def _link(folder: Path, rng: np.random.Generator) -> None:
    for _ in range(int(rng.integers(1, 4))):
        place = folder / _drawn(_PLACES, folder, rng)
        if not any(above.is_symlink() or above.is_file() for above in place.parents):
            if place.is_dir() and not place.is_symlink():
                shutil.rmtree(place)
            place.unlink(missing_ok=True)
            place.parent.mkdir(parents=True, exist_ok=True)
            place.symlink_to(_drawn(_TARGETS, folder, rng))


def _swept_link(folder: Path, rng: np.random.Generator) -> None:
    """A link with the name of a dead program's leftover: it is removed, never followed."""
    name = owned_name("stage-plan").replace(f"-{os.getpid()}-", "-999999999-")
    (folder / name).symlink_to(_drawn(_TARGETS, folder, rng))
    outside = folder.parent / name
    if rng.random() < 0.5:
        (folder / name).unlink()
        (folder / name).mkdir()
        (folder / name / "below").symlink_to(folder.parent, target_is_directory=True)
    assert not outside.exists()


def _hard_link(folder: Path, rng: np.random.Generator) -> None:
    """A hard link to a victim's file, as an archive creates when unpacked on the same disk."""
    place = folder / (".lock", ".run.lock", ".run.json", ".streams/pulls/p/robot.csv",
                      "report.html", ".streams/pulls/p/.robot.csv.lock", "pulls/p/note.txt",
                      "frames/to-goal.json")[int(rng.integers(8))]
    place.unlink(missing_ok=True)
    place.parent.mkdir(parents=True, exist_ok=True)
    os.link(folder.parent / "victim.txt", place)


def _special(folder: Path, rng: np.random.Generator) -> None:
    """A pipe, a socket or a folder where a file belongs; nobody writes to the pipe."""
    place = folder / _drawn(_PLACES, folder, rng)
    if place.is_dir():
        shutil.rmtree(place)
    place.unlink(missing_ok=True)
    place.parent.mkdir(parents=True, exist_ok=True)
    way = int(rng.integers(3))
    if way == 0:
        os.mkfifo(place)
    elif way == 1:
        with socket.socket(socket.AF_UNIX) as made:
            made.bind(os.path.relpath(place))
    else:
        (place / "below").mkdir(parents=True)


def _value(folder: Path, rng: np.random.Generator) -> None:
    """A value of the manifest is replaced: names, numbers, lists."""
    content = manifest(folder)
    place: Any = content
    while True:
        keys = list(place) if isinstance(place, dict) else list(range(len(place)))
        key = keys[int(rng.integers(len(keys)))]
        if not (isinstance(place[key], dict | list) and place[key]) or rng.random() < 0.25:
            place[key] = _VALUES[int(rng.integers(len(_VALUES)))]
            break
        place = place[key]
    _write(folder, content)


def _listed_file(name: str, text: str, folder: Path, _rng: np.random.Generator) -> None:
    """A file with a correct checksum whose content names a file outside."""
    content = manifest(folder)
    (folder / name).parent.mkdir(parents=True, exist_ok=True)
    (folder / name).write_text(text.replace("{root}", str(folder.parents[2])))
    content["files"][name] = entry((folder / name).read_bytes())
    _write(folder, content)


def _deep(folder: Path, rng: np.random.Generator) -> None:
    """Folders nested until no path names the last, or a manifest nested as deeply."""
    if rng.random() < 0.5:
        (folder / "branch.json").write_text('{"a":' * 100_000)
        return
    at = os.open(folder, os.O_RDONLY)
    name = ("d", "d" * 20)[int(rng.integers(2))]
    for _ in range(400):
        os.mkdir(name, dir_fd=at)
        below = os.open(name, os.O_RDONLY, dir_fd=at)
        os.close(at)
        at = below
    os.close(at)


_PULL = ('format_version = 1\nobservation = "depth"\nsource = "../../victim.txt"\n'
         '[grasp]\npoint_m = [0.0, 0.0, 0.3]\nradius_m = 0.01\n')

LAYOUTS: dict[str, Layout] = {
    "a file of the manifest": _evil_file, "what a stage wrote": _evil_writes,
    "a stage's name": _evil_stage, "a commit": partial(_journal, old=False),
    "a replaced manifest": partial(_journal, old=True), "a clash": _clash, "links": _link,
    "more links": _link, "a swept link": _swept_link, "a hard link": _hard_link,
    "a special file": _special, "a value": _value, "another value": _value,
    "depth": _deep,
    "a pull": partial(_listed_file, "pulls/p/pull.toml", _PULL),
    "masses": partial(_listed_file, "point_masses.json", '["../../victim.txt"]'),
    "a plan": partial(_listed_file, "plans/to-goal.json", '{"trees": "{root}/victim.txt"}'),
    "a recording's holder": partial(_listed_file, "pulls/p/robot.csv", "{root}/victim.txt\n")}
"""Attacks by name."""


HOSTILE_ROWS = (
    Asked("hostile folders (200 asked), every command on each: files outside touched or read", "0"),
    Asked("hostile folders: traces, and commands over 10 s of processor time", "0"))
_MOST_SECONDS = 10.0
_LONGEST_WAIT = 120


def hostile(setting: Setting, template: Path = TEMPLATE) -> list[Row]:
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
    addon_module("branch.branch_folder").read_record(folder)
    addon_module("plan.live_force").read(folder)
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
