"""A stage's task as the command line that runs it, and back."""

from typing import Any

import click

from limber.batch.jobs.branch_jobs import StageTask
from limber.stages.command_line import command_line, stage_options
from limber.stages.registry import stage_description


def line_of_task(task: StageTask) -> list[str]:
    """Return the arguments after ``limber`` that run the task."""
    return [task.stage, *command_line(task.inputs, task.settings, task.options)]


def task_of_line(line: list[str]) -> StageTask:
    """Return the task that a command line runs.

    Raises:
        InputError: a value is refused.
        click.UsageError: it is not the command line of a stage.
    """
    stage = stage_description(line[0])

    @click.command(stage.name)
    @stage_options(stage)
    def command(values: dict[str, Any]) -> StageTask:
        return StageTask(stage.name, *stage.models(values))

    return command.main(line[1:], prog_name=f"limber {stage.name}", standalone_mode=False)
