"""Print the inputs and outputs of all stages as JSON schemas."""

import json
from typing import Any, Literal

import click

from limber.cli.known import command_class, others
from limber.core.progress import SILENT, Progress
from limber.stages.registry import all_schemas, schema_of, stage_table
from limber.stages.stage import About, Tool, argument, option


class Schema(Tool):
    """Print what every stage takes, reads and writes as JSON; with `cell`, what a cell file takes.

    A stage's inputs, settings and options are JSON schemas with titles, groups and units: the
    add-on's panels and batch jobs are made from them. `limber STAGE --schema` prints one, `limber
    schema commands` prints those of the commands beside the stages.
    """

    about = About("schema", prints=True)

    what: Literal["stages", "commands", "cell"] = argument("What is described.", default="stages")
    table: bool = option("Print the table of stages of the guide instead.", False, switch=True)

    def run(self, progress: Progress = SILENT) -> dict[str, Any]:
        if self.what == "cell":
            from limber.cell.cell_file import Cell

            content = Cell.model_json_schema()
        elif self.what == "commands":
            content = {name: schema_of(command_class(name)) for name in others()}
        else:
            content = all_schemas()
        click.echo(stage_table() if self.table else json.dumps(content, indent=1))
        return {}
