"""A job file as a script for other schedulers: a Slurm array, or a Snakefile.

Each branch is one task: its stages one after the other, as command lines. Up-to-date results are
kept, so an interrupted task can simply be run again.
"""

import math
import shlex
from collections.abc import Iterator
from pathlib import Path

from limber.batch.job_file import BranchJob, JobFile
from limber.core.errors import InputError, Option
from limber.core.files.atomic import write_atomically
from limber.stages.command_line import command_line

KINDS = ("slurm", "snakemake")
_HOURS = 24.0
"""Limits of a task if the job file sets none."""


def emitted(jobs: JobFile, kind: str) -> str:
    """Return the script; ``kind`` is one of :data:`KINDS`."""
    return "\n".join((_slurm if kind == "slurm" else _snakemake)(jobs)) + "\n"


def write_script(jobs: JobFile, kind: str) -> Path:
    """Write the script into the job file's results folder, as JOBS.slurm or JOBS.smk; InputError if
    inputs or results are at addresses."""
    if jobs.home or any(branch.is_moved for branch in jobs.branches):
        raise InputError(f"{jobs.path} contains addresses.", "A script runs stages on local "
                         "files. Only the batch itself fetches and uploads remote files.",
                         "Run it without ", Option("emit"), ", or fetch the files first.")
    jobs.out.mkdir(parents=True, exist_ok=True)
    path = jobs.out / f"{jobs.path.stem}.{'slurm' if kind == 'slurm' else 'smk'}"
    write_atomically(path, emitted(jobs, kind))
    return path


def commands(branch: BranchJob) -> list[str]:
    """Return a branch's stages as they are typed, quoted for a shell."""
    return [shlex.join(["limber", task.about.name, *command_line(task)]) for task in branch.tasks]


def _minutes(jobs: JobFile, branch_tasks: int) -> int:
    seconds = jobs.limits.seconds
    return math.ceil(branch_tasks * seconds / 60) if seconds else int(60 * _HOURS)


def _slurm(jobs: JobFile) -> Iterator[str]:
    longest = max(len(branch.tasks) for branch in jobs.branches)
    yield "#!/usr/bin/env bash"
    yield f"# Made from {jobs.path.name} by `limber batch --emit slurm`. Submit with sbatch, where"
    yield "# `limber` is on the PATH; submit again to continue after a stop."
    yield f"#SBATCH --job-name=limber-{shlex.quote(jobs.path.stem)}"
    yield f"#SBATCH --array=0-{len(jobs.branches) - 1}"
    yield "#SBATCH --cpus-per-task=1"
    yield f"#SBATCH --time={_minutes(jobs, longest)}"
    if jobs.limits.memory_mb:
        yield f"#SBATCH --mem={math.ceil(jobs.limits.memory_mb)}M"
    yield "set -euo pipefail"
    yield f"cd {shlex.quote(str(Path.cwd()))}"
    yield 'export LIMBER_CORES="${SLURM_CPUS_PER_TASK:-1}"'
    yield 'case "$SLURM_ARRAY_TASK_ID" in'
    for number, branch in enumerate(jobs.branches):
        yield f"{number})  # {_comment(branch.name)}"
        for line in commands(branch):
            yield f"  {line}"
        yield "  ;;"
    yield '*) echo "no branch $SLURM_ARRAY_TASK_ID" >&2; exit 2 ;;'
    yield "esac"


def _snakemake(jobs: JobFile) -> Iterator[str]:
    yield f"# Made from {jobs.path.name} by `limber batch --emit snakemake`:"
    yield "# snakemake --cores N -s FILE"
    yield f"workdir: {str(Path.cwd())!r}"
    names = [f"branch_{number}" for number in range(len(jobs.branches))]
    marks = [str(jobs.out / ".snakemake-done" / name) for name in names]
    yield "rule all:"
    yield "    input:"
    for mark in marks:
        yield f"        {mark!r},"
    for branch, name, mark in zip(jobs.branches, names, marks, strict=True):
        yield ""
        yield f"rule {name}:  # {_comment(branch.name)}"
        yield f"    output: touch({mark!r})"
        yield "    threads: 1"
        memory = math.ceil(jobs.limits.memory_mb) if jobs.limits.memory_mb else 4000
        yield (f"    resources: mem_mb={memory}, "
               f"runtime={_minutes(jobs, len(branch.tasks))}")
        # Braces are Snakemake's own.
        joined = " && ".join(commands(branch)).replace("{", "{{").replace("}", "}}")
        yield f"    shell: {('LIMBER_CORES={threads}; export LIMBER_CORES; ' + joined)!r}"


def _comment(name: str) -> str:
    return "".join(c if c.isprintable() else "?" for c in name)
