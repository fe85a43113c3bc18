"""Print the inputs and outputs of all stages as JSON schemas."""

import json

import click

from limber.stages.registry import all_schemas, stage_table


@click.command("schema")
@click.option("--table", is_flag=True, help="Print the table of stages of the guide instead.")
def command(table: bool) -> None:
    """Print what every stage takes, reads and writes as JSON.

    A stage's inputs, settings and options are JSON schemas with titles, groups and units: the
    add-on's panels and batch jobs are made from them. `limber STAGE --schema` prints one.
    """
    click.echo(stage_table() if table else json.dumps(all_schemas(), indent=1))
