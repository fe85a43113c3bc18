"""Run the stages of a job file on many branches; continues where it stopped."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from limber.batch.job_file import CLUSTERS
from limber.cli.terminal import table_text
from limber.core.errors import InputError, Option, Text, WorkError
from limber.core.progress import SILENT, Progress
from limber.core.settings import OneOf
from limber.stages.stage import About, Tool, argument, option

_NAMED = 10
"""Failed branches that the error names; the page has all."""


def _end(values: Mapping[str, Any]) -> str:
    count = values["branch_count"]
    if values["emit"] is not None:
        return f"A script for {count} branches."
    if values["dry_run"]:
        return f"{values['task_count']} stages on {count} branches would run."
    return f"All {count} branches are done. Open the page in a browser."


class Batch(Tool):
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
    source = "pulls/{scan}/markers/*.csv"       # one run for each file that is found
    robot = "pulls/{scan}/robot/{file}.csv"     # the gripper's table of the same name
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

    about = About("batch", found=(_end,), then="{planned:if}limber batch {job_file}",
                  where=lambda values: values.get("script") or values.get("page"))

    job_file: Path = argument("The job file.", metavar="JOBS.toml")
    dry_run: bool = option("Only check the file and list what would run.", False, switch=True)
    retry_failed: bool = option("Also run stages again that failed before.", False, switch=True)
    emit: Literal["slurm", "snakemake"] | None = option(
        "Run nothing, but write a Slurm array job with one task per branch, or a Snakefile.")
    cluster: Annotated[str | None, OneOf(lambda: CLUSTERS)] = option(
        "Run on a Dask cluster that is started here (local, loopback only) or by a queue, with "
        "the settings of dask-jobqueue (jobqueue.slurm and so on in Dask's configuration).")
    scheduler: str | None = option(
        "Run on the Dask cluster of this scheduler; tcp:// only on loopback.",
        metavar="tls://HOST:PORT")
    workers: int | None = option(
        "Largest number of branches at a time. Default: as the file states, or one per core. "
        "With a queue: number of jobs.", limits={"ge": 1})

    def run(self, progress: Progress = SILENT) -> dict[str, Any]:
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

        if self.cluster is not None and self.scheduler is not None:
            raise InputError(
                Text("Both ", Option("cluster"), " and ", Option("scheduler"), " were given."),
                "One starts a cluster, the other uses an existing one.", "Omit one of them.")
        jobs = read_jobs(self.job_file)
        if self.emit is not None:
            from limber.batch.scheduler_scripts import write_script

            return {"branch_count": len(jobs.branches), "script": write_script(jobs, self.emit)}
        records = Records(jobs)
        if self.dry_run:
            planned = [[branch.name, task.label, state] for branch, task, state in plan_of(
                jobs, records, retry_failed=self.retry_failed)]
            progress.say(table_text("What would run", [["branch", "stage", ""], *planned]))
            return {"branch_count": len(jobs.branches), "task_count": len(planned),
                    "planned": planned}
        try:
            run_jobs(jobs, records, retry_failed=self.retry_failed, workers=self.workers,
                     cluster=self.cluster, scheduler=self.scheduler, progress=progress)
        except BaseException:
            # Results so far are written if possible; the original error is what counts.
            try:
                if jobs.out.is_dir():
                    write_table(jobs, records)
                    write_page(jobs, records)
            except OSError as error:
                progress.warn(f"The summary could not be written ({error}).")
            raise
        write_table(jobs, records)
        write_page(jobs, records)
        put_summary(jobs)
        failed = failures(jobs, records)
        if failed:
            names = ", ".join(name for name, _stage, _why in failed[:_NAMED]) + (
                f" and {len(failed) - _NAMED} more" if len(failed) > _NAMED else "")
            others = "The others are done." if len(failed) < len(jobs.branches) else ""
            raise WorkError(f"{len(failed)} of {len(jobs.branches)} branches failed: {names}; "
                            f"{': '.join(failed[0])}", others, f"See {path_of_page(jobs)}, correct "
                            "the cause, and run this with ", Option("retry_failed", True), ".")
        return {"branch_count": len(jobs.branches), **counts(jobs, records),
                "table": path_of_table(jobs), "page": path_of_page(jobs)}
