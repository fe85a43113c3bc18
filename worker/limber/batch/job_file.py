"""The job file: which stages are run on which scans or branch folders, and with what settings.

`limber batch --help` shows one. The whole file is checked against the stages' settings before
anything runs. No part of it is executed; results stay in ``out``, or in the folders that it names.
Scans, folders, inputs and ``out`` may be addresses for fsspec
(:mod:`limber.batch.staging`).
"""

import glob
import hashlib
import itertools
import json
import math
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from limber.batch.remote_files import checked_address, is_address, matching, plain_name
from limber.core.errors import BranchFolderError, Command, InputError, LimberError, Option
from limber.core.files.atomic import require_file
from limber.core.files.reading import read_text, read_toml
from limber.core.files.safe_names import same_named
from limber.core.json_values import plain
from limber.core.processes import Limits
from limber.core.settings import nearest
from limber.core.units import in_unit
from limber.stages.registry import stage_class, stage_schema, stage_summaries
from limber.stages.stage import PARTS, Stage
from limber.store.manifest import MANIFEST, read_manifest

# The content of a job file: branches, and the stages to run on each.


def fingerprint(task: Stage) -> str:
    """Return the same text for the same task; options do not count."""
    inputs = {name: plain(getattr(task, name)) for name in task.parts()["inputs"]}
    content = json.dumps([task.about.name, inputs, plain(task)], sort_keys=True)
    return hashlib.sha256(content.encode("utf-8")).hexdigest()[:16]


@dataclass(frozen=True)
class BranchJob:
    """The stages to run on one branch, in this order; ``sweep`` contains its own values,
    ``fetched`` the addresses of its inputs and their local paths, ``home`` the branch folder's
    address, or ""."""

    name: str
    folder: Path
    tasks: tuple[Stage, ...]
    sweep: dict[str, Any] = field(default_factory=dict)
    fetched: tuple[tuple[str, Path], ...] = ()
    home: str = ""

    @property
    def is_moved(self) -> bool:
        """Whether it, or one of its inputs, is remote."""
        return bool(self.fetched or self.home)


@dataclass(frozen=True)
class JobFile:
    """A checked job file; ``limits`` hold for each stage, ``home`` is the address of results."""

    path: Path
    out: Path
    branches: tuple[BranchJob, ...]
    workers: int | None = None
    cluster: str | None = None
    limits: Limits = field(default_factory=Limits)
    home: str = ""


# The line of each key in a TOML file, which the parser does not report.

KeyPath = tuple[str | int, ...]

_HEADER = re.compile(r"(\[\[?)([^\]]+)\]")
_PART = r"""(?:[\w-]+|"[^"]*"|'[^']*')"""
_KEY = re.compile(rf"({_PART}(?:\s*\.\s*{_PART})*)\s*=")


def toml_lines(text: str) -> dict[KeyPath, int]:
    """Return the line, from 1, of every table and key: ``("job", 0, "stage", 1, "run")``; text in a
    multi-line string that looks like a key counts as one, which does no harm."""
    found: dict[KeyPath, int] = {(): 1}
    counts: dict[KeyPath, int] = {}
    table: KeyPath = ()
    for number, line in enumerate(map(str.strip, text.splitlines()), 1):
        if header := _HEADER.match(line):
            table = ()
            parts = _parts(header.group(2))
            for part in parts[:-1]:
                table = (*table, part)
                if table in counts:
                    table = (*table, counts[table] - 1)
            table = (*table, parts[-1])
            if header.group(1) == "[[":
                counts[table] = counts.get(table, 0) + 1
                table = (*table, counts[table] - 1)
            found[table] = number
        elif key := _KEY.match(line):
            key_path = table
            for part in _parts(key.group(1)):
                key_path = (*key_path, part)
                found.setdefault(key_path, number)
    return found


def line_of(lines: dict[KeyPath, int], key_path: KeyPath) -> int:
    """Return the line of ``key_path``, or of the nearest table that contains it."""
    while key_path not in lines:
        key_path = key_path[:-1]
    return lines[key_path]


def _parts(text: str) -> list[str]:
    return [part.strip("\"'") for part in re.findall(_PART, text)]


# The problems of a job file: collected, and reported together, each with its line.

_SHOWN = 12
_KINDS = {str: "a text", int: "a whole number", list: "a list"}


class Problems:
    """The problems of one file; ``lines`` gives the line of each key."""

    def __init__(self, path: Path, lines: dict[KeyPath, int]):
        self._path, self._lines = path, lines
        self._found: list[tuple[int, str]] = []

    def add(self, key_path: KeyPath, text: str) -> None:
        self._found.append((line_of(self._lines, key_path), text))

    def stop(self) -> None:
        """Raise an InputError that lists them, if there are any."""
        if not self._found:
            return
        messages = [f"{self._path}, line {line}: {text}"
                    for line, text in sorted(dict.fromkeys(self._found))]
        more = len(messages) - _SHOWN
        raise InputError("\n".join(messages[:_SHOWN]) + (
            f"\nand {more} more." if more > 0 else ""), "", "Nothing was run.")

    def check_keys(self, table: dict[str, Any], known: tuple[str, ...], key_path: KeyPath) -> None:
        for key in table:
            if key not in known:
                self.add((*key_path, key), f"{key!r} is unknown here. {nearest(key, known)}")

    def typed(self, table: dict[str, Any], key: str, kind: type, key_path: KeyPath,
              otherwise: Any) -> Any:
        """Return a value of this kind; ``otherwise`` if it is missing or has another type."""
        value = table.get(key, otherwise)
        if value is not otherwise and (not isinstance(value, kind) or isinstance(value, bool)):
            self.add((*key_path, key), f"{key} is {value!r}, but must be {_KINDS[kind]}.")
            return otherwise
        return value

    def tables(self, table: dict[str, Any], key: str, key_path: KeyPath) -> list[dict[str, Any]]:
        """Return the tables of a name, as ``[[job]]`` are; an empty list if it has another type."""
        found = table.get(key, [])
        if not isinstance(found, list) or not all(isinstance(one, dict) for one in found):
            names = ".".join(str(part) for part in (*key_path, key) if isinstance(part, str))
            self.add((*key_path, key), f"Write {key} as an array of tables: [[{names}]].")
            return []
        return found


# The paths that a job file names; a remote file gets a local path.


class JobPaths:
    """Finds the files that a job file names, relative to its folder, and remembers their addresses;
    ``problems`` collects errors with their position, ``out`` is the folder of results and fetched
    files, ``home`` the address of results, empty if they stay there."""

    def __init__(self, folder: Path, problems: Problems):
        self._folder, self._problems = folder, problems
        self._known: dict[Path, str] = {}
        self.out = folder
        self.home = ""

    def read_out(self, out: str, work: str, otherwise: str) -> None:
        """Results go to a folder; or to an address, with a local working folder."""
        self.out = self._folder / otherwise
        if work and (is_address(work) or not is_address(out)):
            self._problems.add(
                ("work",), "work must be a folder on this computer, and needs an address in "
                           "`out`.")
        elif is_address(out):
            self.home = self._tried(checked_address, out, ("out",)) or ""
            self.out = self._folder / (work or otherwise)
        elif out:
            self.out = self._folder / out

    def files(self, pattern: str, key_path: KeyPath) -> list[Path] | None:
        """Return the files that a pattern names, sorted; None if it was refused."""
        if not is_address(pattern):
            return [self._folder / name for name in sorted(
                glob.glob(pattern, root_dir=self._folder, recursive=True))]
        found = self._tried(matching, pattern, key_path)
        return None if found is None else [self._file(each, key_path) for each in found]

    def folders(self, pattern: str, key_path: KeyPath) -> list[Path] | None:
        """Return the branch folders that a pattern names; None if it was refused."""
        if not is_address(pattern):
            return [path for path in self.files(pattern, key_path) or ()
                    if (path / MANIFEST).is_file()]
        found = self._tried(matching, f"{pattern.rstrip('/')}/{MANIFEST}", key_path)
        return None if found is None else [
            self._here(each.removesuffix(f"/{MANIFEST}"), self.out, key_path) for each in found]

    def file(self, name: str, key_path: KeyPath) -> Path:
        """Return the path of one file or folder."""
        if not is_address(name):
            return self._folder / name
        address = self._tried(checked_address, name, key_path)
        return self._file(address, key_path) if address else self.out

    def written(self, name: str, key_path: KeyPath) -> Path:
        """Return the path for a stage's output file: never outside ``out``."""
        path = (self.out / name).resolve()
        if is_address(name):
            if self._tried(checked_address, name, key_path):
                self._problems.add(
                    key_path, f"{name!r} is an address. Stages write their files to `out` only.")
        elif not path.is_relative_to(self.out.resolve()):
            self._problems.add(key_path, f"{name!r} is outside {self.out}.")
        return path

    def address_of(self, path: Path) -> str:
        """Return the address of a path; an empty text for a local one."""
        return self._known.get(path, "")

    def fetched(self, paths: list[Path]) -> tuple[tuple[str, Path], ...]:
        """Return address and path of the files that must be fetched."""
        return tuple((self._known[path], path) for path in dict.fromkeys(paths)
                     if path in self._known)

    def _tried(self, function: Callable[[str], Any], address: str, key_path: KeyPath) -> Any:
        """Return ``function(address)``; None if it refuses the address."""
        try:
            return function(address)
        except LimberError as error:
            self._problems.add(key_path, str(error))
            return None

    def _file(self, address: str, key_path: KeyPath) -> Path:
        """Return the local path of a file or folder; neighbours stay neighbours."""
        around = address.rpartition("/")[0]
        own = hashlib.sha256(around.encode("utf-8")).hexdigest()[:12]
        return self._here(address, self.out / ".inputs" / own, key_path)

    def _here(self, address: str, folder: Path, key_path: KeyPath) -> Path:
        name = self._tried(plain_name, address, key_path)
        if name is None:
            return folder / "refused"
        self._known[folder / name] = address
        return folder / name


# The stages of a job, ``[[job.stage]]``: each a task, or several, on every branch.

_PLACEHOLDER = re.compile(r"\{([^{}]*)\}")
_ROBOTS = {"always": "It moves a robot, which a person must supervise.",
           "when armed": "It may move a robot. Run it at a terminal."}


def why_not_in_batches(name: str) -> str:
    """Return why a stage is not allowed in a job file, else ""; KeyError if there is no such
    stage."""
    stage = stage_class(name)
    if stage.about.moves_robot:
        return _ROBOTS[stage.about.moves_robot]
    if not {*stage.parts()["inputs"]} & {"branch_folder", "output"}:
        return "It makes a scan, not a branch. Run it first, and list its cloud under scans."
    return ""


@dataclass(frozen=True)
class Source:
    """Input of a branch: a scan, or its own folder."""

    path: Path
    is_scan: bool

    @property
    def name(self) -> str:
        return self.path.stem if self.is_scan else self.path.name.removesuffix(".branch")


class _StageTable:
    """One ``[[job.stage]]`` on one branch, whose own values are ``sweep``: its values with their
    positions in the file."""

    def __init__(self, reader: "_Reader", stage: type[Stage], table: dict[str, Any],
                 key_path: KeyPath, source: Source, folder: Path, sweep: dict[str, Any]):
        self._problems, self._paths, self._stage = reader.problems, reader.paths, stage
        self._key_path, self._source, self._folder = key_path, source, folder
        self._name = stage.about.name
        self._values = {key: value for key, value in table.items() if key != "run"}
        self._key_paths: dict[str, KeyPath] = {key: (*key_path, key) for key in self._values}
        for swept, value in sweep.items():
            name, _, key = swept.partition(".")
            if name == self._name:
                self._values[key], self._key_paths[key] = value, (*key_path[:2], "sweep", swept)
        schema = stage_schema(self._name)
        self._fields = {key: about for part in PARTS
                        for key, about in schema[part].get("properties", {}).items()}
        self._refused: set[str] = set()
        """Fields whose value was refused before reaching the stage's settings."""

    def tasks(self) -> list[Stage]:
        own = self._own_inputs()
        values: dict[str, Any] = {}
        for key, value in self._values.items():
            if key in own:
                self._problems.add(self._key_paths[key],
                                   f"The batch sets {key!r} itself. Remove it.")
            elif key not in self._fields:
                self._problems.add(self._key_paths[key], f"{self._name} has no {key!r}. "
                                   f"{nearest(key, list(self._fields))}")
            else:
                values[key] = self._value(key, value)
        tasks = [task for each in self._runs(values)
                 if (task := self._checked(own | each)) is not None]
        self._check_results(tasks)
        return tasks

    def _check_results(self, tasks: list[Stage]) -> None:
        """Report runs of this table that would replace each other's result."""
        for group in same_named([task.entry or " ".join(map(str, task.outputs()))
                                 or fingerprint(task) for task in tasks]):
            files = [", ".join(path.name for key in self._stage.parts()["inputs"]
                               if isinstance(path := getattr(tasks[index], key), Path)
                               and key in self._values) for index in group]
            same = tasks[group[0]].entry
            self._problems.add(self._key_path, (
                f"{len(group)} runs of {self._name} on {self._source.name} would have one "
                f"result{f', {same}' if same else ''}: {'; '.join(files[:5])}. Each would replace "
                "the one before. Put {file} into the name, and give files that differ in their "
                "suffix only other names."))

    def _own_inputs(self) -> dict[str, Any]:
        """Return the inputs that follow from the branch."""
        if "branch_folder" in self._fields:
            return {"branch_folder": self._folder}
        source = next(key for key, about in self._fields.items() if about.get("argument"))
        if not self._source.is_scan:
            self._problems.add((), f"{self._name} makes a branch from a scan, but this job "
                               "has branch folders.")
        return {source: self._source.path, "output": self._folder}

    def _value(self, key: str, value: Any) -> Any:
        """Return a value with its unit and its placeholders resolved."""
        about = self._fields[key]
        try:
            if about.get("unit") or "string" not in _said_of(about, "type"):
                return in_unit(value, about.get("unit", ""))
        except ValueError as error:
            self._refused.add(key)
            where = self._key_paths[key]
            self._problems.add(where, f"{where[-1]}: {error}")
        return self._filled(value, self._key_paths[key]) if isinstance(value, str) else value

    def _filled(self, text: str, key_path: KeyPath) -> str:
        def fill(match: re.Match) -> str:
            if match.group(1) == "scan":
                return self._source.name
            if match.group(1) == "file":
                return match.group(0)
            self._problems.add(key_path, f"{match.group(0)} is unknown. Use {{scan}} or {{file}}.")
            return ""
        return _PLACEHOLDER.sub(fill, text)

    def _runs(self, values: dict[str, Any]) -> list[dict[str, Any]]:
        """Return the values of each run: one run per file that matches a pattern in the inputs."""
        named = [key for key, value in values.items()
                 if "path" in _said_of(self._fields[key], "format") and isinstance(value, str)]
        several = [key for key in named if self._is_pattern(key, values[key])]
        found = []
        for files in itertools.product(*(self._files(key, values[key]) for key in several)):
            stem = files[-1].stem if files else ""
            run = {key: value.replace("{file}", stem) if isinstance(value, str) else value
                   for key, value in values.items()} | dict(zip(several, files, strict=True))
            found.append(run | {key: self._file(key, run[key]) for key in named
                                if key not in several})
        return found

    def _is_pattern(self, key: str, name: str) -> bool:
        return self._fields[key]["group"] != "output" and glob.has_magic(name)

    def _file(self, key: str, name: str) -> Path:
        """Return the file that a field names, one to write or one to read."""
        find = (self._paths.written if self._fields[key]["group"] == "output"
                else self._paths.file)
        return find(name, (*self._key_path, key))

    def _files(self, key: str, pattern: str) -> list[Path]:
        """Return the files that match a pattern in an input."""
        key_path = (*self._key_path, key)
        matches = self._paths.files(pattern, key_path)
        if matches == []:
            self._problems.add(key_path, f"{key}: no file matches {pattern!r}.")
        return list(matches or ())

    def _checked(self, values: dict[str, Any]) -> Stage | None:
        try:
            return self._stage(**values)
        except ValidationError as error:
            for one in error.errors():
                self._report_refusal(one)
            return None

    def _report_refusal(self, refusal: Any) -> None:
        """Report why the stage's settings refuse a value."""
        key = str(refusal["loc"][0]) if refusal["loc"] else ""
        if key in self._refused:
            return
        unit = self._fields.get(key, {}).get("unit")
        seen = "" if refusal["type"] == "missing" else f", not {refusal['input']!r}"
        self._problems.add(self._key_paths.get(key, (*self._key_path, key)),
                           f"{self._name} {key}: {refusal['msg']}{seen}"
                           + (f" [{unit}]." if unit else "."))


def _trouble(name: str) -> str:
    """Return why ``run = name`` is impossible; an empty string if it is possible."""
    known = stage_summaries()
    if name in known:
        return why_not_in_batches(name)
    return "this stage does not exist. " + nearest(
        name, [each for each in known if not why_not_in_batches(each)])


def _said_of(about: dict[str, Any], key: str) -> set[str]:
    return {each.get(key, "") for each in about.get("anyOf", [about])}


CLUSTERS = ("local", "slurm", "pbs", "lsf", "sge", "oar", "moab", "htcondor")
"""Where a batch may run besides this process's own pool: a Dask cluster, local or on a queue."""
_KEYS = ("out", "work", "workers", "cluster", "time_limit", "memory_limit", "job")
_JOB_KEYS = ("scans", "folders", "stage", "sweep")
_MOST_BRANCHES = 100_000


def read_jobs(path: Path) -> JobFile:
    """Read and check a job file; InputError, with every problem and its line, if it is not TOML, or
    cannot be run."""
    path = Path(path)
    require_file(path, "A job file")
    try:
        content, text = read_toml(path, "a job file"), read_text(path, "a job file")
    except InputError as error:
        raise InputError(error.seen, "A job file is TOML with finite numbers.",
                         Command("batch", Option("help")), " shows what a job file looks "
                         "like.") from error
    return _Reader(path, content, Problems(path, toml_lines(text))).read()


class _Reader:
    """Reads one file."""

    def __init__(self, path: Path, content: dict[str, Any], problems: Problems):
        self.path, self.content, self.problems = path, content, problems
        self.paths = JobPaths(path.parent, problems)

    def read(self) -> JobFile:
        content, problems = self.content, self.problems
        problems.check_keys(content, _KEYS, ())
        self.paths.read_out(problems.typed(content, "out", str, (), ""),
                            problems.typed(content, "work", str, (), ""), self.path.stem)
        workers = problems.typed(content, "workers", int, (), None)
        if workers is not None and workers < 1:
            problems.add(("workers",), "workers must be at least 1.")
        cluster = problems.typed(content, "cluster", str, (), None)
        if cluster is not None and cluster not in CLUSTERS:
            problems.add(("cluster",), f"cluster = {cluster!r}: {nearest(cluster, CLUSTERS)}")
        limits = Limits(self.limit("time_limit", "s"), self.limit("memory_limit", "MB"))
        jobs = problems.tables(content, "job", ())
        if not jobs:
            problems.add((), "The file has no [[job]].")
        branches = [branch for number, job in enumerate(jobs)
                    for branch in self.job(job, ("job", number))]
        self.check_folders(branches)
        problems.stop()
        return JobFile(self.path, self.paths.out, tuple(branches), workers, cluster, limits,
                       self.paths.home)

    def limit(self, key: str, unit: str) -> float | None:
        if key not in self.content:
            return None
        try:
            value = in_unit(self.content[key], unit)
            if isinstance(value, bool) or not isinstance(value, int | float) or not value > 0:
                raise ValueError(f"{self.content[key]!r} is not a positive number of {unit}.")
            return float(value)
        except ValueError as error:
            self.problems.add((key,), f"{key}: {error}")
            return None

    def job(self, job: dict[str, Any], key_path: KeyPath) -> list[BranchJob]:
        self.problems.check_keys(job, _JOB_KEYS, key_path)
        stages = self.problems.tables(job, "stage", key_path)
        if not stages:
            self.problems.add(key_path, "The job has no [[job.stage]].")
        branches = itertools.product(self.sources(job, key_path),
                                     self.sweeps(job, stages, key_path))
        found = []
        for source, sweep in itertools.islice(branches, _MOST_BRANCHES):
            found.append(self.branch(source, sweep, stages, key_path))
        if next(branches, None) is not None:
            self.problems.add(key_path, f"The job has more than {_MOST_BRANCHES} branches.")
        return found

    def branch(self, source: Source, sweep: dict[str, Any], stages: list[dict[str, Any]],
               key_path: KeyPath) -> BranchJob:
        name = source.name + "".join(f"-{key.split('.')[-1]}-{_plain_name(value)}"
                                     for key, value in sweep.items())
        paths = self.paths
        folder = paths.out / f"{name}.branch" if source.is_scan else source.path
        home = paths.address_of(folder)
        if source.is_scan and paths.home:
            home = f"{paths.home}/{name}.branch"
        before = _scan_of(folder) if source.is_scan else ""
        if before and before != source.path.name:
            self.problems.add(key_path, f"{folder} was made from {before}, not from "
                              f"{source.path.name}, which would replace it. Use another `out`, or "
                              "remove that folder.")
        tasks = []
        for number, table in enumerate(stages):
            place, run = (*key_path, "stage", number), str(table.get("run"))
            if trouble := _trouble(run):
                self.problems.add((*place, "run"), f"run = {table.get('run')!r}: {trouble}")
            else:
                tasks += _StageTable(self, stage_class(run), table, place, source, folder,
                                     sweep).tasks()
        return BranchJob(name, folder, tuple(tasks), sweep,
                         paths.fetched([path for path in _paths_in(tasks) if path != folder]),
                         home)

    def sources(self, job: dict[str, Any], key_path: KeyPath) -> list[Source]:
        kinds = [key for key in ("scans", "folders") if key in job]
        if len(kinds) != 1:
            self.problems.add(key_path, "A job needs either scans or folders.")
            return []
        key, at = kinds[0], (*key_path, kinds[0])
        look = self.paths.files if key == "scans" else self.paths.folders
        found: list[Source] = []
        for pattern in self.problems.typed(job, key, list, key_path, []):
            if not isinstance(pattern, str):
                self.problems.add(at, f"{pattern!r} is not a path.")
                continue
            matches = look(pattern, at)
            if matches == []:
                what = "file" if key == "scans" else "branch folder"
                self.problems.add(at, f"No {what} matches {pattern!r}.")
            found += [Source(path, key == "scans") for path in matches or ()]
        return found

    def sweeps(self, job: dict[str, Any], stages: list[dict[str, Any]], key_path: KeyPath,
               ) -> list[dict[str, Any]]:
        table = job.get("sweep", {})
        at = (*key_path, "sweep")
        if not isinstance(table, dict):
            self.problems.add(at, "Write the sweep as a table: [job.sweep].")
            return [{}]
        if table and "folders" in job:
            self.problems.add(at, "A sweep over branch folders would overwrite its own results. "
                              "Sweep over scans, or give the results of the stages different "
                              "names.")
            return [{}]
        choices = []
        for key, values in table.items():
            stage, _, name = key.partition(".")
            if not name or stage not in [about.get("run") for about in stages]:
                self.problems.add((*at, key), f"{key!r} does not name a stage of this job and one "
                                  "of its settings. An example is \"reconstruct.mesh_spacing\".")
            elif not isinstance(values, list) or not values:
                self.problems.add((*at, key), f"{key} needs a list of values.")
            else:
                choices.append([(key, value) for value in values])
        count = math.prod(map(len, choices))
        if count > _MOST_BRANCHES:
            self.problems.add(at, f"The sweep has {count:.3g} combinations; {_MOST_BRANCHES} are "
                              "possible.")
            return [{}]
        return [dict(choice) for choice in itertools.product(*choices)]

    def check_folders(self, branches: list[BranchJob]) -> None:
        """Report branches that share a folder or a file that they write."""
        folders = [str(branch.folder.resolve()) for branch in branches]
        for group in same_named(folders):
            named = ", ".join(dict.fromkeys(branches[index].name for index in group))
            self.problems.add((), f"{len(group)} branches would be named {named}.branch. Give "
                              "the scans names that differ in more than their suffix or upper and "
                              "lower case, or use two job files with different `out`.")
        outputs = [(branch.name, str(path)) for branch in branches
                   for path in {path for task in branch.tasks
                                for path in task.outputs() if path != branch.folder}]
        for group in same_named([path for _, path in outputs]):
            self.problems.add((), f"{len(group)} branches would write {outputs[group[0]][1]}: "
                              f"{', '.join(outputs[index][0] for index in group[:5])}. Put "
                              "{scan} into the name.")


def _scan_of(folder: Path) -> str:
    """Return the name of the scan that a branch folder was made from; empty if there is none."""
    try:
        return str(read_manifest(folder).source.get("file", ""))
    except BranchFolderError:  # none there, or the stage reports its damage
        return ""


def _paths_in(tasks: list[Stage]) -> list[Path]:
    return [value for task in tasks for value in vars(task).values() if isinstance(value, Path)]


def _plain_name(value: Any) -> str:
    return re.sub(r"[^A-Za-z0-9.+-]+", "_", str(value)).strip("_.") or "_"
