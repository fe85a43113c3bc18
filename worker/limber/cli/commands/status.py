"""Show what a batch has done, and what failed, runs or waits."""

import shlex
from pathlib import Path
from typing import Any

import click

from limber.cli.main import Run, stage_command


@stage_command("status")
@click.argument("job_file", type=click.Path(path_type=Path), metavar="JOBS.toml")
def command(run: Run, job_file: Path) -> dict[str, Any]:
    """Show the progress of a job file's batch, also while it runs; each failure with its reason."""
    from limber.batch.batch_progress import RUNNING, Records, counts, failures
    from limber.batch.job_file import read_jobs

    jobs = read_jobs(job_file)
    records = Records(jobs)
    failed = failures(jobs, records)
    if failed:
        run.show("Failed", [["branch", "stage", "why"], *map(list, failed)])
    count = counts(jobs, records)
    run.close(f"Of {len(jobs.branches)} branches " + ", ".join(
        f"{number} {state}" for state, number in count.items() if number) + ".",
              then=f"limber batch {shlex.quote(str(job_file))}" if count["waiting"] else "")
    return {"branch_count": len(jobs.branches), **count,
            "running_now": [f"{branch.name} {task.label}" for branch in jobs.branches
                            for task in branch.tasks
                            if records.of(branch, task).status == RUNNING],
            "failures": [list(one) for one in failed]}
