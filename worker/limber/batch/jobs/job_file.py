"""The job file: which stages are run on which scans or branch folders, and with what settings.

::

    out = "results"                       # where the branch folders, the table and the page go
    time_limit = "1 h"                    # of each stage; memory_limit = "4 GB"
    cluster = "slurm"                     # or "local", "pbs" ...; default: this process's pool
    work = "/scratch/night"               # where to work if out is an address: "s3://bucket/night"

    [[job]]
    scans = ["scans/*.ply"]               # a branch each; or folders = ["old/*.branch"]

    [[job.stage]]
    run = "reconstruct"
    unit = "mm"

    [[job.stage]]
    run = "import-pull"
    source = "pulls/{scan}/*.csv"         # one run for each file
    name = "{file}"

    [[job.stage]]
    run = "estimate"

    [job.sweep]                           # a branch for each combination
    "reconstruct.mesh_spacing" = [2.0, 3.0]

It is checked whole against the stages' settings before anything runs. Nothing in it is executed;
what it makes stays in ``out``, or in the folders that it names. Scans, folders, inputs and ``out``
may be addresses, as fsspec knows them (:mod:`limber.batch.machines.staging`).
"""

import difflib
import glob
import hashlib
import itertools
import json
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from limber.batch.addresses import is_address
from limber.batch.jobs.job_addresses import JobAddresses
from limber.batch.jobs.toml_positions import Place, line_of, toml_lines
from limber.core.errors import InputError
from limber.core.files.atomic import require_file
from limber.core.files.reading import read_text, read_toml
from limber.core.json_values import plain
from limber.core.processes import Limits
from limber.core.settings import Settings
from limber.core.units import in_unit
from limber.stages.registry import stage_description, stage_schema, stage_summaries
from limber.store.manifest import MANIFEST

NOT_IN_BATCHES = {
    "record": "It moves a robot: somebody has to stand beside it.",
    "execute": "It may move a robot: run it at a terminal.",
    "generate": "It makes a scan, not a branch: run it before, and name its cloud under scans."}
CLUSTERS = ("local", "slurm", "pbs", "lsf", "sge", "oar", "moab", "htcondor")
"""Where a batch may run beside this process's own pool: a Dask cluster here, or of a queue."""
_KEYS = ("out", "work", "workers", "cluster", "time_limit", "memory_limit", "job")
_JOB_KEYS = ("scans", "folders", "stage", "sweep")
_PLACEHOLDER = re.compile(r"\{([^{}]*)\}")
_MOST_BRANCHES = 100_000
_SHOWN_PROBLEMS = 12


@dataclass(frozen=True)
class StageTask:
    """A stage to run on a branch, with checked inputs, settings and options."""

    stage: str
    inputs: Settings
    settings: Settings
    options: Settings

    @property
    def label(self) -> str:
        """The stage's name, with that of what it makes where there may be several."""
        name = getattr(self.inputs, "name", None) or getattr(self.settings, "name", None)
        return f"{self.stage}:{name}" if name else self.stage

    @property
    def fingerprint(self) -> str:
        """What the task is, its options left out: the same text for the same task."""
        told = json.dumps([self.stage, plain(self.inputs), plain(self.settings)], sort_keys=True)
        return hashlib.sha256(told.encode("utf-8")).hexdigest()[:16]


@dataclass(frozen=True)
class BranchJob:
    """What is run on one branch, in this order; ``sweep`` says which values are its own.

    ``fetched`` has the addresses of its inputs and where those go here, ``home`` the address that
    the branch folder itself has, or nothing.
    """

    name: str
    folder: Path
    tasks: tuple[StageTask, ...]
    sweep: dict[str, Any] = field(default_factory=dict)
    fetched: tuple[tuple[str, Path], ...] = ()
    home: str = ""

    @property
    def is_moved(self) -> bool:
        """Whether it, or what it needs, is elsewhere."""
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


def read_jobs(path: Path) -> JobFile:
    """Read and check a job file.

    Raises:
        InputError: it is no TOML, or says what cannot be run; every problem with its line.
    """
    require_file(Path(path), "A job file")
    try:
        content, text = read_toml(path, "a job file"), read_text(path, "a job file")
    except InputError as error:
        raise InputError(error.seen, "A job file is TOML, and its numbers are finite.",
                         "`limber batch --help` shows what a job file looks like.") from error
    return _Reader(Path(path), content, toml_lines(text)).read()


class _Reader:
    """Reads one file and gathers what is wrong with it."""

    def __init__(self, path: Path, content: dict[str, Any], lines: dict[Place, int]):
        self.path, self.content, self.lines = path, content, lines
        self.problems: list[tuple[int, str]] = []
        self.misfits: set[Place] = set()
        """Places whose value was refused before it came to the stage's settings."""
        self.out = path.parent / path.stem
        self.home = ""
        self.addresses = JobAddresses(self.problem)

    def read(self) -> JobFile:
        content = self.content
        self.check_keys(content, _KEYS, ())
        self.read_out(self.typed(content, "out", str, (), ""),
                      self.typed(content, "work", str, (), ""))
        workers = self.typed(content, "workers", int, (), None)
        if workers is not None and workers < 1:
            self.problem(("workers",), "workers is at least 1.")
        cluster = self.typed(content, "cluster", str, (), None)
        if cluster is not None and cluster not in CLUSTERS:
            self.problem(("cluster",), f"cluster = {cluster!r}: {_nearest(cluster, CLUSTERS)}")
        limits = Limits(self.limit("time_limit", "s"), self.limit("memory_limit", "MB"))
        branches: list[BranchJob] = []
        jobs = self.tables(content, "job", ())
        if not jobs:
            self.problem((), "It has no [[job]].")
        for number, job in enumerate(jobs):
            branches += self.job(job, ("job", number))
        self.check_folders(branches)
        self.stop_on_problems()
        return JobFile(self.path, self.out, tuple(branches), workers, cluster, limits,
                       self.home)

    def read_out(self, out: str, work: str) -> None:
        """Results go to a folder; or to an address, and are worked on in a folder here."""
        if work and (is_address(work) or not is_address(out)):
            self.problem(("work",), "work is a folder here, for results that go to an address.")
        elif is_address(out):
            self.home = self.addresses.checked(out, ("out",))
            if work:
                self.out = self.path.parent / work
        elif out:
            self.out = self.path.parent / out

    def problem(self, place: Place, text: str) -> None:
        self.problems.append((line_of(self.lines, place), text))

    def stop_on_problems(self) -> None:
        if not self.problems:
            return
        told = [f"{self.path}, line {line}: {text}"
                for line, text in sorted(dict.fromkeys(self.problems))]
        more = len(told) - _SHOWN_PROBLEMS
        raise InputError("\n".join(told[:_SHOWN_PROBLEMS]) + (
            f"\nand {more} more." if more > 0 else ""), "", "Nothing was run.")

    def check_keys(self, table: dict[str, Any], known: tuple[str, ...], place: Place) -> None:
        for key in table:
            if key not in known:
                self.problem((*place, key), f"{key!r} is not known here. {_nearest(key, known)}")

    def typed(self, table: dict[str, Any], key: str, kind: type, place: Place,
              otherwise: Any) -> Any:
        value = table.get(key, otherwise)
        if value is not otherwise and (not isinstance(value, kind) or isinstance(value, bool)):
            self.problem((*place, key), f"{key} is {value!r}; it takes "
                         f"{ {str: 'a text', int: 'a whole number', list: 'a list'}[kind]}.")
            return otherwise
        return value

    def tables(self, table: dict[str, Any], key: str, place: Place) -> list[dict[str, Any]]:
        found = table.get(key, [])
        if not isinstance(found, list) or not all(isinstance(one, dict) for one in found):
            self.problem((*place, key), f"Write {key} as tables: "
                         f"[[{'.'.join(str(p) for p in (*place, key) if isinstance(p, str))}]].")
            return []
        return found

    def limit(self, key: str, unit: str) -> float | None:
        if key not in self.content:
            return None
        try:
            value = in_unit(self.content[key], unit)
            if isinstance(value, bool) or not isinstance(value, int | float) or not value > 0:
                raise ValueError(f"{self.content[key]!r} is no positive number of {unit}.")
            return float(value)
        except ValueError as error:
            self.problem((key,), f"{key}: {error}")
            return None

    def job(self, job: dict[str, Any], place: Place) -> list[BranchJob]:
        self.check_keys(job, _JOB_KEYS, place)
        stages = self.tables(job, "stage", place)
        if not stages:
            self.problem(place, "The job has no [[job.stage]].")
        sources = self.sources(job, place)
        sweeps = self.sweeps(job, stages, place)
        found = []
        for (source, is_scan), sweep in itertools.product(sources, sweeps):
            name = source.name.removesuffix(".branch") if not is_scan else source.stem
            if sweep:
                name += "".join(f"-{key.split('.')[-1]}-{_plain_name(value)}"
                                for key, value in sweep.items())
            folder = self.out / f"{name}.branch" if is_scan else source
            home = self.addresses.of(folder)
            if is_scan and self.home:
                home = f"{self.home}/{name}.branch"
            reader = _TaskReader(self, source, is_scan, folder, sweep)
            tasks = [task for number, stage in enumerate(stages)
                     for task in reader.tasks(stage, (*place, "stage", number))]
            found.append(BranchJob(name, folder, tuple(tasks), sweep,
                                   self.fetched(tasks, folder), home))
            if len(found) > _MOST_BRANCHES:
                self.problem(place, f"The job has over {_MOST_BRANCHES} branches.")
                break
        return found

    def sources(self, job: dict[str, Any], place: Place) -> list[tuple[Path, bool]]:
        given = [key for key in ("scans", "folders") if key in job]
        if len(given) != 1:
            self.problem(place, "A job has either scans or folders.")
            return []
        key = given[0]
        found: list[tuple[Path, bool]] = []
        for pattern in self.typed(job, key, list, place, []):
            if not isinstance(pattern, str):
                self.problem((*place, key), f"{pattern!r} is no path.")
                continue
            if key == "folders":
                matches = self.folders(pattern, (*place, key))
            else:
                matches = self.matches(pattern, (*place, key))
            if matches is None:
                continue
            if not matches:
                what = "branch folder" if key == "folders" else "file"
                self.problem((*place, key), f"No {what} is {pattern!r}.")
            found += [(path, key == "scans") for path in matches]
        return found

    def matches(self, pattern: str, place: Place) -> list[Path] | None:
        """Return the paths that a pattern names, from the job file's folder, sorted.

        What is at an address gets a path here, where it goes before it is read; None where the
        address is refused, which has been said then.
        """
        if is_address(pattern):
            return self.addresses.files(pattern, self.out, place)
        return [Path(self.path.parent, name) for name in sorted(
            glob.glob(pattern, root_dir=self.path.parent, recursive=True))]

    def folders(self, pattern: str, place: Place) -> list[Path] | None:
        if is_address(pattern):
            return self.addresses.folders(pattern, self.out, place)
        return [path for path in self.matches(pattern, place) or () if (path / MANIFEST).is_file()]

    def fetched(self, tasks: list[StageTask], folder: Path) -> tuple[tuple[str, Path], ...]:
        """Return the addresses of what tasks read beside the branch, and where each goes."""
        return self.addresses.among([
            value for task in tasks for part in (task.inputs, task.settings, task.options)
            for value in vars(part).values() if isinstance(value, Path) and value != folder])

    def sweeps(self, job: dict[str, Any], stages: list[dict[str, Any]], place: Place,
               ) -> list[dict[str, Any]]:
        table = job.get("sweep", {})
        at = (*place, "sweep")
        if not isinstance(table, dict):
            self.problem(at, "Write the sweep as a table: [job.sweep].")
            return [{}]
        if table and "folders" in job:
            self.problem(at, "A sweep over branch folders would overwrite its own results. Sweep "
                         "over scans, or give the stages names of their own.")
            return [{}]
        choices = []
        for key, values in table.items():
            stage, _, name = key.partition(".")
            if not name or stage not in [about.get("run") for about in stages]:
                self.problem((*at, key), f"{key!r} names no stage of this job and setting of it, "
                             "as \"reconstruct.mesh_spacing\" does.")
            elif not isinstance(values, list) or not values:
                self.problem((*at, key), f"{key} takes a list of values.")
            else:
                choices.append([(key, value) for value in values])
        return [dict(choice) for choice in itertools.product(*choices)]

    def check_folders(self, branches: list[BranchJob]) -> None:
        """Two branches cannot share a folder; none leaves the folder that they go to."""
        seen: set[Path] = set()
        for branch in branches:
            folder = branch.folder.resolve()
            if folder in seen:
                self.problem((), f"Two branches would be {branch.name}.branch. Give the scans "
                             "different names, or run them as two job files.")
            seen.add(folder)


class _TaskReader:
    """Makes the tasks of one branch."""

    def __init__(self, reader: _Reader, source: Path, is_scan: bool, folder: Path,
                 sweep: dict[str, Any]):
        self.reader, self.source, self.is_scan = reader, source, is_scan
        self.folder, self.sweep = folder, sweep

    def tasks(self, table: dict[str, Any], place: Place) -> list[StageTask]:
        name = table.get("run")
        if name in NOT_IN_BATCHES or name not in stage_summaries():
            known = tuple(each for each in stage_summaries() if each not in NOT_IN_BATCHES)
            self.reader.problem((*place, "run"), f"run = {name!r}: " + NOT_IN_BATCHES.get(
                str(name), f"there is no such stage. {_nearest(str(name), known)}"))
            return []
        stage = stage_description(name)
        schema = stage_schema(name)
        fields = {key: (part, about) for part in ("inputs", "settings", "options")
                  for key, about in schema[part].get("properties", {}).items()}
        given = {key: value for key, value in table.items() if key != "run"}
        given |= {key.partition(".")[2]: value for key, value in self.sweep.items()
                  if key.partition(".")[0] == name}
        own = self.own_inputs(name, fields)
        values: dict[str, Any] = {}
        for key, value in given.items():
            if key in own:
                self.reader.problem((*place, key), f"{key!r} is given by the batch.")
            elif key not in fields:
                self.reader.problem(self.place_of(place, name, key),
                                    f"{name} has no {key!r}. {_nearest(key, tuple(fields))}")
            else:
                values[key] = self.value(value, fields[key][1], self.place_of(place, name, key))
        models = (stage.inputs, stage.settings, stage.options)
        return [task for each in self.runs(values, fields, place)
                if (task := self.checked(name, models, own | each, fields, place)) is not None]

    def place_of(self, place: Place, stage: str, key: str) -> Place:
        swept = f"{stage}.{key}"
        return (*place[:2], "sweep", swept) if swept in self.sweep else (*place, key)

    def own_inputs(self, name: str, fields: dict[str, Any]) -> dict[str, Any]:
        """Return the inputs that follow from the branch."""
        if "branch_folder" in fields:
            return {"branch_folder": self.folder}
        source = next(key for key, (_, about) in fields.items() if about.get("argument"))
        if not self.is_scan:
            raise_at = f"{name} makes a branch of a scan; this job has branch folders."
            self.reader.problem((), raise_at)
        return {source: self.source, "output": self.folder}

    def value(self, value: Any, about: dict[str, Any], place: Place) -> Any:
        """Return a value with its unit and its placeholders resolved."""
        try:
            if about.get("unit") or "string" not in _types(about):
                return in_unit(value, about.get("unit", ""))
        except ValueError as error:
            self.reader.misfits.add(place)
            self.reader.problem(place, f"{place[-1]}: {error}")
        return self.filled(value, place) if isinstance(value, str) else value

    def filled(self, text: str, place: Place) -> str:
        known = {"scan": self.source.name.removesuffix(".branch") if not self.is_scan
                 else self.source.stem}

        def fill(match: re.Match) -> str:
            if match.group(1) == "file":
                return match.group(0)
            if match.group(1) not in known:
                self.reader.problem(place, f"{match.group(0)} is not known; {{scan}} and {{file}} "
                                    "are.")
                return ""
            return known[match.group(1)]
        return _PLACEHOLDER.sub(fill, text)

    def runs(self, values: dict[str, Any], fields: dict[str, Any], place: Place,
             ) -> list[dict[str, Any]]:
        """Return the values of each run: as many as a pattern among the inputs has files."""
        found = [values]
        for key, value in values.items():
            _, about = fields[key]
            if "path" not in _formats(about) or not isinstance(value, str):
                continue
            if about["group"] == "output":
                found = [each | {key: self.inside(value, (*place, key))} for each in found]
            elif glob.has_magic(value):
                matches = self.reader.matches(value, (*place, key))
                if matches == []:
                    self.reader.problem((*place, key), f"{key}: no file is {value!r}.")
                found = [each | {key: path, "": path.stem}
                         for each in found for path in matches or []]
            else:
                path = self.literal(value, (*place, key))
                found = [each | {key: path} for each in found]
        return [_with_file(each) for each in found]

    def literal(self, value: str, place: Place) -> Path:
        reader = self.reader
        if not is_address(value):
            return reader.path.parent / value
        address = reader.addresses.checked(value, place)
        return reader.addresses.file(address, reader.out, place) if address else reader.out

    def inside(self, value: str, place: Place) -> Path:
        """Return where a file goes: in the branch's own folder of files, never outside ``out``."""
        path = (self.reader.out / value).resolve()
        if is_address(value):
            if self.reader.addresses.checked(value, place):
                self.reader.problem(
                    place, f"{value!r} is an address; what stages write goes to `out`.")
        elif not path.is_relative_to(self.reader.out.resolve()):
            self.reader.problem(place, f"{value!r} leads out of {self.reader.out}.")
        return path

    def checked(self, name: str, models: tuple, values: dict[str, Any], fields: dict[str, Any],
                place: Place) -> StageTask | None:
        made = []
        for model in models:
            own = {key: value for key, value in values.items() if key in model.model_fields}
            try:
                made.append(model(**own))
            except ValidationError as error:
                for one in error.errors():
                    key = str(one["loc"][0]) if one["loc"] else ""
                    unit = fields.get(key, ("", {}))[1].get("unit")
                    at = self.place_of(place, name, key)
                    if at in self.reader.misfits:
                        continue
                    self.reader.problem(
                        at, f"{name} {key}: {one['msg']}"
                        + ("" if one["type"] == "missing" else f", not {one['input']!r}")
                        + (f" [{unit}]." if unit else "."))
        return StageTask(name, *made) if len(made) == len(models) else None


def _with_file(values: dict[str, Any]) -> dict[str, Any]:
    """Put the name of the file that a pattern has found where ``{file}`` stands."""
    stem = values.pop("", "")
    return {key: value.replace("{file}", stem) if isinstance(value, str) else value
            for key, value in values.items()}


def _nearest(key: str, known: tuple[str, ...]) -> str:
    close = difflib.get_close_matches(key, known, 3)
    return f"Did you mean {' or '.join(close)}?" if close else f"Known: {', '.join(known)}."


def _plain_name(value: Any) -> str:
    return re.sub(r"[^A-Za-z0-9.+-]+", "_", str(value)).strip("_.") or "_"


def _kinds(about: dict[str, Any]) -> list[dict[str, Any]]:
    return about.get("anyOf", [about])


def _types(about: dict[str, Any]) -> set[str]:
    return {each.get("type", "") for each in _kinds(about)}


def _formats(about: dict[str, Any]) -> set[str]:
    return {each.get("format", "") for each in _kinds(about)}


