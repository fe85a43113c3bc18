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
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from limber.batch.remote_files import checked_address, is_address, matching, plain_name
from limber.core.errors import BranchFolderError, Command, InputError, LimberError, Option
from limber.core.files.atomic import require_file
from limber.core.files.reading import read_text, read_toml
from limber.core.files.safe_names import same_named
from limber.core.json_values import plain, refusal_of
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
    address, or "", ``scan`` what it is made of, None for an existing folder."""

    name: str
    folder: Path
    tasks: tuple[Stage, ...] = ()
    sweep: dict[str, Any] = field(default_factory=dict)
    fetched: tuple[tuple[str, Path], ...] = ()
    home: str = ""
    scan: Path | None = None

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


# The stages of a job, ``[[job.stage]]``: each a task, or several, on every branch.

_SHOWN = 12
"""Problems that are listed."""
_KINDS = {str: "a text", int: "a whole number", list: "a list"}
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
    return _Reader(path, content, toml_lines(text)).read()


class _Reader:
    """Reads one file: collects its problems, and finds the files that it names, beside it or at
    addresses, which get local paths in ``out``, the folder of results; ``home`` is the address of
    these, or "", ``lines`` has the line of each key."""

    def __init__(self, path: Path, content: dict[str, Any], lines: dict[KeyPath, int]):
        self.path, self.content, self.lines = path, content, lines
        self.problems: list[tuple[int, str]] = []
        self.addresses: dict[Path, str] = {}
        self.out, self.home = path.parent / path.stem, ""

    def read(self) -> JobFile:
        content = self.content
        self.check_keys(content, _KEYS, ())
        self.read_out(self.typed(content, "out", str, (), ""),
                      self.typed(content, "work", str, (), ""))
        workers = self.typed(content, "workers", int, (), None)
        if workers is not None and workers < 1:
            self.refuse(("workers",), "workers must be at least 1.")
        cluster = self.typed(content, "cluster", str, (), None)
        if cluster is not None and cluster not in CLUSTERS:
            self.refuse(("cluster",), f"cluster = {cluster!r}: {nearest(cluster, CLUSTERS)}")
        limits = Limits(self.limit("time_limit", "s"), self.limit("memory_limit", "MB"))
        jobs = self.tables(content, "job", ())
        if not jobs:
            self.refuse((), "The file has no [[job]].")
        branches = [branch for number, job in enumerate(jobs)
                    for branch in self.job(job, ("job", number))]
        self.check_folders(branches)
        if self.problems:
            messages = [f"{self.path}, line {line}: {text}"
                        for line, text in sorted(dict.fromkeys(self.problems))]
            more = len(messages) - _SHOWN
            raise InputError("\n".join(messages[:_SHOWN]) + (
                f"\nand {more} more." if more > 0 else ""), "", "Nothing was run.")
        return JobFile(self.path, self.out, tuple(branches), workers, cluster, limits, self.home)

    def limit(self, key: str, unit: str) -> float | None:
        if key not in self.content:
            return None
        try:
            value = in_unit(self.content[key], unit)
            if isinstance(value, bool) or not isinstance(value, int | float) or not value > 0:
                raise ValueError(f"it is not a positive number of {unit}")
            return float(value)
        except ValueError as error:
            self.refuse((key,), f"{key} {self.content[key]!r}: {error}.")
            return None

    def job(self, job: dict[str, Any], key_path: KeyPath) -> list[BranchJob]:
        self.check_keys(job, _JOB_KEYS, key_path)
        stages = self.tables(job, "stage", key_path)
        if not stages:
            self.refuse(key_path, "The job has no [[job.stage]].")
        branches = itertools.product(self.sources(job, key_path),
                                     self.sweeps(job, stages, key_path))
        found = [self.branch(source, sweep, stages, key_path)
                 for source, sweep in itertools.islice(branches, _MOST_BRANCHES)]
        if next(branches, None) is not None:
            self.refuse(key_path, f"The job has more than {_MOST_BRANCHES} branches.")
        return found

    def sources(self, job: dict[str, Any], key_path: KeyPath) -> list[BranchJob]:
        """Return a branch without tasks for each scan or folder."""
        kinds = [key for key in ("scans", "folders") if key in job]
        if len(kinds) != 1:
            self.refuse(key_path, "A job needs either scans or folders.")
            return []
        key, at = kinds[0], (*key_path, kinds[0])
        is_scan = key == "scans"
        found: list[BranchJob] = []
        for pattern in self.typed(job, key, list, key_path, []):
            if not isinstance(pattern, str):
                self.refuse(at, f"{pattern!r} is not a path.")
                continue
            matches = (self.files if is_scan else self.folders)(pattern, at)
            if matches == []:
                self.refuse(at, f"No {'file' if is_scan else 'branch folder'} matches "
                                f"{pattern!r}.")
            found += [BranchJob(path.stem, self.out / f"{path.stem}.branch", scan=path)
                      if is_scan else BranchJob(path.name.removesuffix(".branch"), path)
                      for path in matches or ()]
        return found

    def branch(self, source: BranchJob, sweep: dict[str, Any], stages: list[dict[str, Any]],
               key_path: KeyPath) -> BranchJob:
        name = source.name + "".join(f"-{key.split('.')[-1]}-{_plain_name(value)}"
                                     for key, value in sweep.items())
        folder, home = source.folder, self.addresses.get(source.folder, "")
        if source.scan is not None:
            folder = self.out / f"{name}.branch"
            home = self.home and f"{self.home}/{name}.branch"
            before = _scan_of(folder)
            if before and before != source.scan.name:
                self.refuse(key_path, f"{folder} was made from {before}, not from "
                            f"{source.scan.name}, which would replace it. Use another `out`, or "
                            "remove that folder.")
        own = replace(source, folder=folder, sweep=sweep)
        tasks = []
        for number, table in enumerate(stages):
            place, run = (*key_path, "stage", number), str(table.get("run"))
            if trouble := _trouble(run):
                self.refuse((*place, "run"), f"run = {table.get('run')!r}: {trouble}")
            else:
                tasks += self.tasks(own, stage_class(run), table, place)
        fetched = tuple((self.addresses[path], path) for path in dict.fromkeys(_paths_in(tasks))
                        if path in self.addresses and path != folder)
        return replace(own, name=name, tasks=tuple(tasks), fetched=fetched, home=home)

    def tasks(self, branch: BranchJob, stage: type[Stage], table: dict[str, Any],
              key_path: KeyPath) -> list[Stage]:
        """Return the runs of a ``[[job.stage]]`` on a branch, which has its scan's name."""
        name, schema = stage.about.name, stage_schema(stage.about.name)
        fields = {key: about for part in PARTS
                  for key, about in schema[part].get("properties", {}).items()}
        given = {key: ((*key_path, key), value) for key, value in table.items() if key != "run"}
        for swept, value in branch.sweep.items():
            if (key := swept.removeprefix(f"{name}.")) != swept:
                given[key] = (*key_path[:2], "sweep", swept), value
        own = {"branch_folder": branch.folder} if "branch_folder" in fields else {
            next(key for key, about in fields.items() if about.get("argument")): branch.scan,
            "output": branch.folder}
        if None in own.values():
            self.refuse((), f"{name} makes a branch from a scan, but this job has branch folders.")
        refused: set[str] = {*own}
        values: dict[str, Any] = {}
        for key, (at, value) in given.items():
            if key in own:
                self.refuse(at, f"The batch sets {key!r} itself. Remove it.")
            elif key not in fields:
                self.refuse(at, f"{name} has no {key!r}. {nearest(key, list(fields))}")
            else:
                values[key] = self.value(branch, fields[key], at, value)
        tasks = []
        for run in self.runs(fields, {key: at for key, (at, _) in given.items()}, values):
            try:
                tasks.append(stage(**own | run))
            except ValidationError as error:
                for one in error.errors():
                    key = str(one["loc"][0]) if one["loc"] else ""
                    unit = fields.get(key, {}).get("unit")
                    why = refusal_of(one)
                    said = "" if one["type"] == "missing" or ", not " in why else (
                        f", not {one['input']!r}")
                    if key not in refused:
                        self.refuse(given[key][0] if key in given else (*key_path, key), (
                            f"{name} {key}: {why}{said}" + (f" [{unit}]." if unit else ".")))
        self.check_results(branch, tasks, {*given}, key_path)
        return tasks

    def value(self, branch: BranchJob, about: dict[str, Any], key_path: KeyPath, value: Any) -> Any:
        """Return a value with its placeholders resolved."""
        if "string" not in _said_of(about, "type"):
            return value

        def fill(match: re.Match) -> str:
            if match.group(1) == "scan":
                return branch.name
            if match.group(1) != "file":
                self.refuse(key_path, f"{match.group(0)} is unknown. Use {{scan}} or {{file}}.")
            return match.group(0)
        return _PLACEHOLDER.sub(fill, value) if isinstance(value, str) else value

    def runs(self, fields: dict[str, Any], key_paths: dict[str, KeyPath], values: dict[str, Any],
             ) -> list[dict[str, Any]]:
        """Return the values of each run: one run per file that matches a pattern in the inputs."""
        named = [key for key, value in values.items()
                 if "path" in _said_of(fields[key], "format") and isinstance(value, str)]
        written = [key for key in named if fields[key]["group"] == "output"]
        several = {key: self.files(values[key], key_paths[key]) for key in named
                   if key not in written and glob.has_magic(values[key])}
        for key, matches in several.items():
            if matches == []:
                self.refuse(key_paths[key], f"{key}: no file matches {values[key]!r}.")
        found = []
        for files in itertools.product(*(matches or () for matches in several.values())):
            run: dict[str, Any] = dict(zip(several, files, strict=True))
            stem = files[-1].stem if files else ""
            for key, value in values.items():
                if key not in several:
                    text = value.replace("{file}", stem) if isinstance(value, str) else value
                    find = self.written if key in written else self.file
                    run[key] = find(text, key_paths[key]) if key in named else text
            found.append(run)
        return found

    def check_results(self, branch: BranchJob, tasks: list[Stage], given: set[str],
                      key_path: KeyPath) -> None:
        """Report runs of one table that would replace each other's result."""
        for group in same_named([task.entry or " ".join(map(str, task.outputs()))
                                 or fingerprint(task) for task in tasks]):
            first = tasks[group[0]]
            files = [", ".join(path.name for key in first.parts()["inputs"]
                               if isinstance(path := getattr(tasks[index], key), Path)
                               and key in given) for index in group]
            self.refuse(key_path, (
                f"{len(group)} runs of {first.about.name} on {branch.name} would have one "
                f"result{f', {first.entry}' if first.entry else ''}: {'; '.join(files[:5])}. Each "
                "would replace the one before. Put {file} into the name, and give files that "
                "differ in their suffix only other names."))

    def sweeps(self, job: dict[str, Any], stages: list[dict[str, Any]], key_path: KeyPath,
               ) -> list[dict[str, Any]]:
        table = job.get("sweep", {})
        at = (*key_path, "sweep")
        if not isinstance(table, dict):
            self.refuse(at, "Write the sweep as a table: [job.sweep].")
            return [{}]
        if table and "folders" in job:
            self.refuse(at, "A sweep over branch folders would overwrite its own results. "
                        "Sweep over scans, or give the results of the stages different names.")
            return [{}]
        choices = []
        for key, values in table.items():
            stage, _, name = key.partition(".")
            if not name or stage not in [about.get("run") for about in stages]:
                self.refuse((*at, key), f"{key!r} does not name a stage of this job and one "
                            "of its settings. An example is \"reconstruct.mesh_spacing\".")
            elif not isinstance(values, list) or not values:
                self.refuse((*at, key), f"{key} needs a list of values.")
            else:
                choices.append([(key, value) for value in values])
        count = math.prod(map(len, choices))
        if count > _MOST_BRANCHES:
            self.refuse(at, f"The sweep has {count:.3g} combinations; {_MOST_BRANCHES} are "
                        "possible.")
            return [{}]
        return [dict(choice) for choice in itertools.product(*choices)]

    def check_folders(self, branches: list[BranchJob]) -> None:
        """Report branches that share a folder or a file that they write."""
        folders = [str(branch.folder.resolve()) for branch in branches]
        for group in same_named(folders):
            named = ", ".join(dict.fromkeys(branches[index].name for index in group))
            self.refuse((), f"{len(group)} branches would be named {named}.branch. Give "
                        "the scans names that differ in more than their suffix or upper and "
                        "lower case, or use two job files with different `out`.")
        outputs = [(branch.name, str(path)) for branch in branches
                   for path in {path for task in branch.tasks
                                for path in task.outputs() if path != branch.folder}]
        for group in same_named([path for _, path in outputs]):
            self.refuse((), f"{len(group)} branches would write {outputs[group[0]][1]}: "
                        f"{', '.join(outputs[index][0] for index in group[:5])}. Put "
                        "{scan} into the name.")

    # Problems: reported together, each with its line.

    def refuse(self, key_path: KeyPath, text: str) -> None:
        self.problems.append((line_of(self.lines, key_path), text))

    def check_keys(self, table: dict[str, Any], known: tuple[str, ...], key_path: KeyPath) -> None:
        for key in table:
            if key not in known:
                self.refuse((*key_path, key), f"{key!r} is unknown here. {nearest(key, known)}")

    def typed(self, table: dict[str, Any], key: str, kind: type, key_path: KeyPath,
              otherwise: Any) -> Any:
        """Return a value of this kind; ``otherwise`` if it is missing or has another type."""
        value = table.get(key, otherwise)
        if value is not otherwise and (not isinstance(value, kind) or isinstance(value, bool)):
            self.refuse((*key_path, key), f"{key} is {value!r}, but must be {_KINDS[kind]}.")
            return otherwise
        return value

    def tables(self, table: dict[str, Any], key: str, key_path: KeyPath) -> list[dict[str, Any]]:
        """Return the tables of a name, as ``[[job]]`` are; an empty list if it has another type."""
        found = table.get(key, [])
        if not isinstance(found, list) or not all(isinstance(one, dict) for one in found):
            names = ".".join(str(part) for part in (*key_path, key) if isinstance(part, str))
            self.refuse((*key_path, key), f"Write {key} as an array of tables: [[{names}]].")
            return []
        return found

    # Files: a remote one gets a local path.

    def read_out(self, out: str, work: str) -> None:
        """Results go to a folder; or to an address, with a local working folder."""
        if work and (is_address(work) or not is_address(out)):
            self.refuse(("work",), "work must be a folder on this computer, and needs an address "
                        "in `out`.")
        elif is_address(out):
            self.home = self._tried(checked_address, out, ("out",)) or ""
            self.out = self.path.parent / (work or self.path.stem)
        elif out:
            self.out = self.path.parent / out

    def files(self, pattern: str, key_path: KeyPath) -> list[Path] | None:
        """Return the files that a pattern names, sorted; None if it was refused."""
        if not is_address(pattern):
            return [self.path.parent / name for name in sorted(
                glob.glob(pattern, root_dir=self.path.parent, recursive=True))]
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
            return self.path.parent / name
        address = self._tried(checked_address, name, key_path)
        return self._file(address, key_path) if address else self.out

    def written(self, name: str, key_path: KeyPath) -> Path:
        """Return the path for a stage's output file: never outside ``out``."""
        path = (self.out / name).resolve()
        if is_address(name):
            if self._tried(checked_address, name, key_path):
                self.refuse(key_path, f"{name!r} is an address. Stages write their files to `out` "
                            "only.")
        elif not path.is_relative_to(self.out.resolve()):
            self.refuse(key_path, f"{name!r} is outside {self.out}.")
        return path

    def _tried(self, function: Callable[[str], Any], address: str, key_path: KeyPath) -> Any:
        """Return ``function(address)``; None if it refuses the address."""
        try:
            return function(address)
        except LimberError as error:
            self.refuse(key_path, str(error))
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
        self.addresses[folder / name] = address
        return folder / name


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
