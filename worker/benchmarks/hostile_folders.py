"""Possible attacks on a branch folder: names that lead out, links, pipes, noise.

Each layout changes a good branch folder, two folders below one with ``victim.txt`` files.
"""

import hashlib
import json
import os
import shutil
import socket
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from limber.core.files.temporary_names import owned_name

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
    return str(choices[int(rng.integers(len(choices)))]).replace("{root}",
                                                                 str(folder.parents[2]))


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
