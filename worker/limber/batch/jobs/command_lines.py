"""A stage's task as the command line that runs it, and back."""

import click

from limber.batch.jobs.branch_jobs import StageTask
from limber.core.settings import Settings
from limber.stages.command_line import command_line, settings_options
from limber.stages.registry import stage_description


def line_of_task(task: StageTask) -> list[str]:
    """Return what is typed after ``limber`` to run the task."""
    return [task.stage, *command_line(task.inputs, task.settings, task.options)]


def task_of_line(line: list[str]) -> StageTask:
    """Return the task that a command line runs.

    Raises:
        InputError: a value is refused.
        click.UsageError: it is no command line of a stage.
    """
    stage = stage_description(line[0])

    @click.command(stage.name)
    @settings_options(stage.inputs, "inputs")
    @settings_options(stage.settings, "settings")
    @settings_options(stage.options, "options")
    def command(**models: Settings) -> StageTask:
        return StageTask(stage.name, **models)

    return command.main(line[1:], prog_name=f"limber {stage.name}", standalone_mode=False)
