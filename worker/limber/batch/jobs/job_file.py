"""The job file: which stages are run on which scans or branch folders, and with what settings.

`limber batch --help` shows one. The whole file is checked against the stages' settings before
anything runs. No part of it is executed; results stay in ``out``, or in the folders that it names.
Scans, folders, inputs and ``out`` may be addresses for fsspec
(:mod:`limber.batch.machines.staging`).
"""

import itertools
import math
import re
from pathlib import Path
from typing import Any

from limber.batch.jobs.branch_jobs import BranchJob, JobFile, StageTask
from limber.batch.jobs.job_paths import JobPaths
from limber.batch.jobs.problems import Problems
from limber.batch.jobs.stage_tables import Source, StageTables, written_by
from limber.batch.jobs.toml_positions import KeyPath, toml_lines
from limber.core.errors import BranchFolderError, InputError
from limber.core.files.atomic import require_file
from limber.core.files.reading import read_text, read_toml
from limber.core.files.safe_names import same_named
from limber.core.processes import Limits
from limber.core.settings import nearest
from limber.core.units import in_unit
from limber.store.manifest import read_manifest

CLUSTERS = ("local", "slurm", "pbs", "lsf", "sge", "oar", "moab", "htcondor")
"""Where a batch may run besides this process's own pool: a Dask cluster, local or on a queue."""
_KEYS = ("out", "work", "workers", "cluster", "time_limit", "memory_limit", "job")
_JOB_KEYS = ("scans", "folders", "stage", "sweep")
_MOST_BRANCHES = 100_000


def read_jobs(path: Path) -> JobFile:
    """Read and check a job file.

    Raises:
        InputError: it is not TOML, or cannot be run; lists every problem with its line.
    """
    path = Path(path)
    require_file(path, "A job file")
    try:
        content, text = read_toml(path, "a job file"), read_text(path, "a job file")
    except InputError as error:
        raise InputError(error.seen, "A job file is TOML with finite numbers.",
                         "`limber batch --help` shows what a job file looks like.") from error
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
        tasks = StageTables(self.problems, paths, source, folder, sweep).tasks(stages, key_path)
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
                                for path in written_by(task) if path != branch.folder}]
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


def _paths_in(tasks: list[StageTask]) -> list[Path]:
    return [value for task in tasks for part in (task.inputs, task.settings, task.options)
            for value in vars(part).values() if isinstance(value, Path)]


def _plain_name(value: Any) -> str:
    return re.sub(r"[^A-Za-z0-9.+-]+", "_", str(value)).strip("_.") or "_"
