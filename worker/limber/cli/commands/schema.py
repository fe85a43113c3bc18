"""Print the inputs and outputs of all stages as JSON schemas."""

import json

import click

from limber.stages.registry import all_schemas, stage_table


@click.command("schema")
@click.argument("what", required=False, type=click.Choice(["stages", "cell"]), default="stages")
@click.option("--table", is_flag=True, help="Print the table of stages of the guide instead.")
def command(what: str, table: bool) -> None:
    """Print what every stage takes, reads and writes as JSON; with `cell`, what a cell file takes.

    A stage's inputs, settings and options are JSON schemas with titles, groups and units: the
    add-on's panels and batch jobs are made from them. `limber STAGE --schema` prints one.
    """
    if what == "cell":
        from limber.cell.cell_file import Cell

        click.echo(json.dumps(Cell.model_json_schema(), indent=1))
        return
    click.echo(stage_table() if table else json.dumps(all_schemas(), indent=1))
