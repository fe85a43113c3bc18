"""Show what a batch has done, and what failed, runs or waits."""

import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from limber.cli.terminal import table_text
from limber.core.progress import SILENT, Progress
from limber.stages.stage import About, Tool, argument


def _states(values: Mapping[str, Any]) -> str:
    return f"Of {values['branch_count']} branches " + ", ".join(
        f"{values[state]} {state}" for state in ("done", "failed", "running", "waiting")
        if values[state]) + "."


def _next(values: Mapping[str, Any]) -> str:
    return f"next  limber batch {shlex.quote(str(values['job_file']))}" if values["waiting"] else ""


class Status(Tool):
    """Show the progress of a job file's batch, also while it runs; each failure with its reason."""

    about = About("status", found=(_states, _next))

    job_file: Path = argument("The job file.", metavar="JOBS.toml")

    def run(self, progress: Progress = SILENT) -> dict[str, Any]:
        from limber.batch.batch_progress import RUNNING, Records, counts, failures
        from limber.batch.job_file import read_jobs

        jobs = read_jobs(self.job_file)
        records = Records(jobs)
        failed = failures(jobs, records)
        if failed:
            progress.say(table_text("Failed", [["branch", "stage", "why"], *map(list, failed)]))
        return {"branch_count": len(jobs.branches), **counts(jobs, records),
                "running_now": [f"{branch.name} {task.label}" for branch in jobs.branches
                                for task in branch.tasks
                                if records.of(branch, task).status == RUNNING],
                "failures": [list(one) for one in failed]}
