"""The stages of a job, ``[[job.stage]]``: each a task, or several, on every branch."""

import glob
import itertools
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from limber.batch.jobs.branch_jobs import StageTask
from limber.batch.jobs.job_paths import JobPaths
from limber.batch.jobs.problems import Problems
from limber.batch.jobs.toml_positions import KeyPath
from limber.core.files.safe_names import same_named
from limber.core.settings import Settings, nearest
from limber.core.units import in_unit
from limber.stages.registry import (
    StageDescription,
    stage_description,
    stage_schema,
    stage_summaries,
)

_PLACEHOLDER = re.compile(r"\{([^{}]*)\}")
_ROBOTS = {"always": "It moves a robot, which a person must supervise.",
           "when armed": "It may move a robot. Run it at a terminal."}


def why_not_in_batches(name: str) -> str:
    """Return why a stage is not allowed in a job file; an empty text if it is allowed.

    Raises:
        KeyError: there is no such stage.
    """
    stage = stage_description(name)
    if stage.moves_robot:
        return _ROBOTS[stage.moves_robot]
    if not stage.inputs.model_fields.keys() & {"branch_folder", "output"}:
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


@dataclass(frozen=True)
class StageTables:
    """Makes the tasks of one branch; ``sweep`` has the branch's own values."""

    problems: Problems
    paths: JobPaths
    source: Source
    folder: Path
    sweep: dict[str, Any]

    def tasks(self, tables: list[dict[str, Any]], key_path: KeyPath) -> list[StageTask]:
        """Return the tasks of all stages of a job."""
        return [task for number, table in enumerate(tables)
                for task in self._tasks_of(table, (*key_path, "stage", number))]

    def _tasks_of(self, table: dict[str, Any], key_path: KeyPath) -> list[StageTask]:
        name = str(table.get("run"))
        if trouble := _trouble(name):
            self.problems.add((*key_path, "run"), f"run = {table.get('run')!r}: {trouble}")
            return []
        entries = {key: (value, (*key_path, key)) for key, value in table.items() if key != "run"}
        for swept, value in self.sweep.items():
            stage, _, key = swept.partition(".")
            if stage == name:
                entries[key] = value, (*key_path[:2], "sweep", swept)
        return _StageValues(self, stage_description(name), entries, key_path).tasks()


class _StageValues:
    """The values of one stage on one branch, each with its position in the file."""

    def __init__(self, of: StageTables, stage: StageDescription,
                 entries: dict[str, tuple[Any, KeyPath]], key_path: KeyPath):
        self._of, self._problems, self._stage, self._key_path = of, of.problems, stage, key_path
        self._key_paths = {key: where for key, (_, where) in entries.items()}
        self._values = {key: value for key, (value, _) in entries.items()}
        schema = stage_schema(stage.name)
        self._fields = {key: about for part in ("inputs", "settings", "options")
                        for key, about in schema[part].get("properties", {}).items()}
        self._refused: set[str] = set()
        """Fields whose value was refused before reaching the stage's settings."""

    def tasks(self) -> list[StageTask]:
        own = self._own_inputs()
        values: dict[str, Any] = {}
        for key, value in self._values.items():
            if key in own:
                self._problems.add(self._key_paths[key],
                                   f"The batch sets {key!r} itself. Remove it.")
            elif key not in self._fields:
                self._problems.add(self._key_paths[key], f"{self._stage.name} has no {key!r}. "
                                   f"{nearest(key, list(self._fields))}")
            else:
                values[key] = self._value(key, value)
        tasks = [task for each in self._runs(values)
                 if (task := self._checked(own | each)) is not None]
        self._check_results(tasks)
        return tasks

    def _check_results(self, tasks: list[StageTask]) -> None:
        """Report runs of this table that would replace each other's result."""
        for group in same_named([self._stage.entry(task.inputs, task.settings) or " ".join(
                map(str, written_by(task))) or task.fingerprint for task in tasks]):
            files = [", ".join(path.name for key, path in vars(tasks[index].inputs).items()
                               if isinstance(path, Path) and key in self._values)
                     for index in group]
            same = self._stage.entry(tasks[group[0]].inputs, tasks[group[0]].settings)
            self._problems.add(self._key_path, (
                f"{len(group)} runs of {self._stage.name} on {self._of.source.name} would have one "
                f"result{f', {same}' if same else ''}: {'; '.join(files[:5])}. Each would replace "
                "the one before. Put {file} into the name, and give files that differ in their "
                "suffix only other names."))

    def _models(self) -> tuple[type[Settings], ...]:
        return self._stage.inputs, self._stage.settings, self._stage.options

    def _own_inputs(self) -> dict[str, Any]:
        """Return the inputs that follow from the branch."""
        if "branch_folder" in self._fields:
            return {"branch_folder": self._of.folder}
        source = next(key for key, about in self._fields.items() if about.get("argument"))
        if not self._of.source.is_scan:
            self._problems.add((), f"{self._stage.name} makes a branch from a scan, but this job "
                               "has branch folders.")
        return {source: self._of.source.path, "output": self._of.folder}

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
                return self._of.source.name
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
        key_path = (*self._key_path, key)
        paths = self._of.paths
        return (paths.written if self._fields[key]["group"] == "output" else paths.file)(
            name, key_path)

    def _files(self, key: str, pattern: str) -> list[Path]:
        """Return the files that match a pattern in an input."""
        key_path = (*self._key_path, key)
        matches = self._of.paths.files(pattern, key_path)
        if matches == []:
            self._problems.add(key_path, f"{key}: no file matches {pattern!r}.")
        return list(matches or ())

    def _checked(self, values: dict[str, Any]) -> StageTask | None:
        made = []
        for model in self._models():
            own = {key: value for key, value in values.items() if key in model.model_fields}
            try:
                made.append(model(**own))
            except ValidationError as error:
                for one in error.errors():
                    self._report_refusal(one)
        return StageTask(self._stage.name, *made) if len(made) == 3 else None

    def _report_refusal(self, refusal: Any) -> None:
        """Report why the stage's settings refuse a value."""
        key = str(refusal["loc"][0]) if refusal["loc"] else ""
        if key in self._refused:
            return
        unit = self._fields.get(key, {}).get("unit")
        seen = "" if refusal["type"] == "missing" else f", not {refusal['input']!r}"
        self._problems.add(self._key_paths.get(key, (*self._key_path, key)),
                           f"{self._stage.name} {key}: {refusal['msg']}{seen}"
                           + (f" [{unit}]." if unit else "."))


def written_by(task: StageTask) -> list[Path]:
    """Return the files and folders that a task writes and its inputs name."""
    model = type(task.inputs)
    return [value for key, value in vars(task.inputs).items()
            if isinstance(value, Path) and model.group_of(key) == "output"]


def _trouble(name: str) -> str:
    """Return why ``run = name`` is impossible; an empty string if it is possible."""
    known = stage_summaries()
    if name in known:
        return why_not_in_batches(name)
    return "this stage does not exist. " + nearest(
        name, [each for each in known if not why_not_in_batches(each)])


def _said_of(about: dict[str, Any], key: str) -> set[str]:
    return {each.get(key, "") for each in about.get("anyOf", [about])}
