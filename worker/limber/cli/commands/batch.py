"""Run the stages of a job file on many branches; continues where it stopped."""

import shlex
from pathlib import Path
from typing import Any

import click

from limber.batch.job_file import CLUSTERS
from limber.cli.main import Run, stage_command
from limber.core.errors import Option, Text

_NAMED = 10
"""Failed branches that the error names; the page has all."""


@stage_command("batch")
@click.argument("job_file", type=click.Path(path_type=Path), metavar="JOBS.toml")
@click.option("--dry-run", is_flag=True, help="Only check the file and list what would run.")
@click.option("--retry-failed", is_flag=True, help="Also run stages again that failed before.")
@click.option("--emit", type=click.Choice(["slurm", "snakemake"]), help=(
    "Run nothing, but write a Slurm array job with one task per branch, or a Snakefile."))
@click.option("--cluster", type=click.Choice(CLUSTERS), help=(
    "Run on a Dask cluster that is started here (local, loopback only) or by a queue, with the "
    "settings of dask-jobqueue (jobqueue.slurm and so on in Dask's configuration)."))
@click.option("--scheduler", metavar="tls://HOST:PORT", help=(
    "Run on the Dask cluster of this scheduler; tcp:// only on loopback."))
@click.option("--workers", type=click.IntRange(min=1), help=(
    "Largest number of branches at a time. Default: as the file states, or one per core. With a "
    "queue: number of jobs."))
def command(run: Run, job_file: Path, dry_run: bool, retry_failed: bool, emit: str | None,
            cluster: str | None, scheduler: str | None, workers: int | None) -> dict[str, Any]:
    """Run stages on many branches in parallel.

    \b
    out = "results"                     # where all goes; default: the file's name
    workers = 2
    time_limit = "1 h"                  # of each stage; memory_limit = "4 GB"
    cluster = "slurm"                   # or local, pbs, ...; default: the cores of this computer
    [[job]]
    scans = ["scans/*.ply"]             # a branch each; or folders = ["old/*.branch"]
    [[job.stage]]
    run = "reconstruct"                 # settings as in `limber reconstruct --help-all`, with _
    leaves = "keep"
    [[job.stage]]
    run = "import-pull"
    source = "pulls/{scan}/*.csv"       # one run for each file that is found
    name = "{file}"
    [[job.stage]]
    run = "estimate"
    [job.sweep]                         # a branch for each combination
    "reconstruct.mesh_spacing" = [2.0, 3.0]

    Scans, folders, inputs and out may be addresses that fsspec knows (s3://bucket/scans/*.ply).
    They are fetched before a branch is started, and its results are uploaded after it; work =
    "/scratch" sets the local folder.

    A number may have its unit: grasp_radius = "8 mm". The whole file is checked before anything
    runs. Run it again after a stop, or after inputs have changed: results that are up to date are
    kept. The results are in OUT/JOBS.csv, one row per branch, and OUT/JOBS.html.
    """
    from limber.batch.batch_progress import (
        Records,
        counts,
        failures,
        path_of_page,
        path_of_table,
        write_page,
        write_table,
    )
    from limber.batch.job_file import read_jobs
    from limber.batch.run import plan_of, run_jobs
    from limber.batch.staging import put_summary
    from limber.core.errors import InputError, WorkError

    if cluster is not None and scheduler is not None:
        raise InputError(
            Text("Both ", Option("cluster"), " and ", Option("scheduler"), " were given."), "One "
            "starts a cluster, the other uses an existing one.", "Omit one of them.")
    jobs = read_jobs(job_file)
    if emit is not None:
        from limber.batch.scheduler_scripts import write_script

        script = write_script(jobs, emit)
        run.close(f"A script for {len(jobs.branches)} branches.", where=script)
        return {"branch_count": len(jobs.branches), "script": script}
    records = Records(jobs)
    if dry_run:
        planned = plan_of(jobs, records, retry_failed=retry_failed)
        run.show("What would run", [["branch", "stage", ""], *(
            [branch.name, task.label, state] for branch, task, state in planned)])
        run.close(f"{len(planned)} stages on {len(jobs.branches)} branches would run.",
                  then=f"limber batch {shlex.quote(str(job_file))}")
        return {"branch_count": len(jobs.branches), "task_count": len(planned),
                "planned": [[branch.name, task.label, state] for branch, task, state in planned]}
    try:
        run_jobs(jobs, records, retry_failed=retry_failed, workers=workers,
                 cluster=cluster, scheduler=scheduler, progress=run.progress)
    except BaseException:
        # Results so far are written if possible; the original error is what counts.
        try:
            if jobs.out.is_dir():
                write_table(jobs, records)
                write_page(jobs, records)
        except OSError as error:
            run.progress.warn(f"The summary could not be written ({error}).")
        raise
    write_table(jobs, records)
    write_page(jobs, records)
    put_summary(jobs)
    failed = failures(jobs, records)
    if failed:
        names = ", ".join(name for name, _stage, _why in failed[:_NAMED]) + (
            f" and {len(failed) - _NAMED} more" if len(failed) > _NAMED else "")
        raise WorkError(f"{len(failed)} of {len(jobs.branches)} branches failed: {names}; "
                        f"{': '.join(failed[0])}", "The others are done.", "See "
                        f"{path_of_page(jobs)}, correct the cause, and run this with ",
                        Option("retry_failed", True), ".")
    run.close(f"All {len(jobs.branches)} branches are done. Open the page in a browser.",
              where=path_of_page(jobs))
    return {"branch_count": len(jobs.branches), **counts(jobs, records),
            "table": path_of_table(jobs), "page": path_of_page(jobs)}
