"""The command ``limber``: finds the commands and runs each in the same way.

Each is made from a class with its fields (:mod:`limber.cli.known`), by
:class:`limber.cli.stage_command.StageCommand`.
"""

import contextlib
import difflib
import json
import os
import signal
import sys
from typing import Any

import click

from limber.cli.known import command_class, command_names, command_summaries, group_help
from limber.cli.terminal import say
from limber.core.errors import LimberError
from limber.stages.registry import stage_summaries
from limber.version import VERSION


class _Commands(click.Group):
    """Loads each command's module only when that command is used."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(command_summaries())

    def resolve_command(self, ctx: click.Context, args: list[str],
                        ) -> tuple[str | None, click.Command | None, list[str]]:
        """Find a command by its name; for an unknown one, the error lists similar names."""
        name = args[0]
        if name not in command_summaries() and not name.startswith("-"):
            # Loads no package: it is the first thing that a new user runs.
            known = {each.split()[-1]: each for each in (*command_summaries(), *command_names())}
            close = [known[each] for each in difflib.get_close_matches(name, known, 2)]
            ctx.fail(f"There is no command '{name}'. " + (
                f"Did you mean {' or '.join(close)}?" if close else "`limber --help` lists all."))
        return super().resolve_command(ctx, args)

    def get_command(self, ctx: click.Context, name: str) -> click.Command | None:
        if name not in command_summaries():
            return None
        from limber.cli.stage_command import StageCommand

        if name in command_names():
            return StageCommand(command_class(name))
        return click.Group(name, help=group_help(name), commands=[
            StageCommand(command_class(each)) for each in command_names()
            if each.startswith(f"{name} ")])

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        stages = stage_summaries()
        others = {name: summary for name, summary in command_summaries().items() if name not
                  in stages}
        for title, commands in (("Stages", stages), ("Other commands", others)):
            with formatter.section(title):
                formatter.write_dl(list(commands.items()))


@click.group(cls=_Commands, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(VERSION, prog_name="limber")
@click.option("--follow-links", is_flag=True, help=(
    "Follow links inside branch folders and recordings, which may lead anywhere: only for those "
    "that you made yourself."))
def main(follow_links: bool) -> None:
    """Turn the scan of a plant branch into a simulation that behaves like it, and move it gently.

    Exit codes: 0 done, 2 wrong usage or input, 3 the work failed, 4 stopped for safety,
    130 cancelled.
    """
    if follow_links:
        from limber.core.files.safe_names import FOLLOW_LINKS

        os.environ[FOLLOW_LINKS] = "1"
        click.get_current_context().call_on_close(lambda: os.environ.pop(FOLLOW_LINKS, None))


def call(arguments: list[str] | None = None) -> int:
    """Run one command line and return its exit code; called by Blender's command entry."""
    _terminate_like_interrupt()
    if "LIMBER_PARENT_PIPE" in os.environ:
        from limber.core.processes.end_with_parent import end_with_parent_pipe

        end_with_parent_pipe()
    try:
        main.main(args=arguments, prog_name="limber", standalone_mode=False)
        sys.stdout.flush()
    except click.ClickException as error:
        return _misused(error, "--json" in (sys.argv if arguments is None else arguments))
    except (click.Abort, KeyboardInterrupt):
        return 130
    except LimberError as error:
        say(f"error: {error}")
        return error.exit_code
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else int(stop.code is not None)
    except OSError as error:
        return _output_lost(error)
    return 0


def _misused(error: click.ClickException, as_json: bool) -> int:
    """State an error in what was typed, as other errors are; return its exit code."""
    seen, path = error.format_message(), getattr(getattr(error, "ctx", None), "command_path", "")
    if as_json:
        print(json.dumps({"command": path.partition(" ")[2], "status": "failed", "seconds": 0.0,
                          "warnings": [], "error": seen}))
    say(f"error: {seen}" + (
        f" `{path} --help` lists what it takes." if path and "--help" not in seen else ""))
    return error.exit_code


def _output_lost(error: OSError) -> int:
    """State that standard output is closed; a command's other output is complete."""
    with contextlib.suppress(OSError, ValueError):
        # Python flushes it again at exit, and would report that as an error of ours.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    if not isinstance(error, BrokenPipeError):
        click.echo(f"error: Standard output cannot be written ({error.strerror or error}).",
                   err=True)
    return 3


def _terminate_like_interrupt() -> None:
    """Let SIGTERM and a closed terminal end a command like Ctrl-C: with its clean-up and exit
    code 130."""
    def interrupt(_signal: int, _frame: Any) -> None:
        raise KeyboardInterrupt
    try:
        signal.signal(signal.SIGTERM, interrupt)
        # nohup lets a command ignore it.
        if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) == signal.SIG_DFL:
            signal.signal(signal.SIGHUP, interrupt)
    except ValueError:
        # Not the main thread (Blender may call from another): the default handler stays.
        return


run = call
"""Name of the entry point in installed versions."""
