"""The command ``limber``: finds the commands and runs each in the same way.

A stage's command is made from its description (:mod:`limber.stages.registry`). Any other command is
a module in ``limber/cli/commands`` with an object ``command``; its docstring is the help. Commands
made here take ``--json``, ``--verbose`` and ``--progress``, end with the exit codes of
``limber.core.errors`` and, with ``--json``, print one JSON object as their last line.
"""

import ast
import contextlib
import difflib
import functools
import importlib
import inspect
import json
import os
import re
import signal
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from limber.cli.terminal import (
    closing_lines,
    command_to_type,
    found_lines,
    result_lines,
    table_lines,
)
from limber.core.errors import LimberError, PartlyFailedError, SafetyStop, Text, WorkError
from limber.core.machine_errors import machine_error
from limber.core.processes.heartbeat import Heartbeat
from limber.core.progress import BarSink, JsonSink, LogSink, Progress, Sink, report_damage_to
from limber.stages.registry import stage_class, stage_schema, stage_summaries
from limber.version import VERSION

if TYPE_CHECKING:
    from limber.stages.stage import Stage


_CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]")


def command_summaries() -> dict[str, str]:
    """Return a summary of each command in one line, by name, importing none of them: `limber
    --help` must not wait for the numerical packages."""
    found = {}
    for path in sorted((Path(__file__).parent / "commands").glob("*.py")):
        if path.stem != "__init__":
            docstring = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
            found[path.stem.replace("_", "-")] = docstring.split("\n\n")[0].replace("\n", " ")
    return stage_summaries() | found


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
            close = difflib.get_close_matches(name, command_summaries(), 2)
            ctx.fail(f"There is no command '{name}'. " + (
                f"Did you mean {' or '.join(close)}?" if close else "`limber --help` lists all."))
        return super().resolve_command(ctx, args)

    def get_command(self, ctx: click.Context, name: str) -> click.Command | None:
        if name in stage_summaries():
            return command_of(stage_class(name))
        if name not in command_summaries():
            return None
        return importlib.import_module(f"limber.cli.commands.{name.replace('-', '_')}").command

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


class Run:
    """Arguments of a command's function besides its options.

    ``progress`` receives reports and warnings, ``say`` prints a line on standard error, ``show`` a
    table there. ``warnings`` are kept for the JSON result. ``close`` sets the last lines, which
    replace the full result.
    """

    def __init__(self, sink: Sink | None, say: Callable[[str], None]):
        self.progress = Progress(sink, self._warned)
        self.say = say
        self.warnings: list[Text] = []
        self.closing: list[str] = []

    def close(self, *found: str, where: object = "", then: str = "") -> None:
        """Print what was found, where it is and what to type next."""
        self.closing = closing_lines(found, where, then)

    def _warned(self, message: Text) -> None:
        self.warnings.append(message)
        self.say(f"warning: {message}")

    def show(self, title: str, rows: list[list[str]]) -> None:
        """Print a table; its first row is the header."""
        self.say("\n".join([f"\n{title}", *(f"  {line}" for line in table_lines(rows))]))


def stage_command(name: str) -> Callable[[Callable[..., dict[str, Any]]], click.Command]:
    """Make a click command of ``function(run, **options) -> result dict``.

    The docstring's first line is the help text. The result is printed for people, in the function's
    own closing lines or (``--verbose``) value by value, or, with ``--json``, as the last line
    together with ``command``, ``status``, ``seconds``, ``warnings`` and ``error``.
    """
    def wrap(function: Callable[..., dict[str, Any]]) -> click.Command:
        body = functools.update_wrapper(functools.partial(_execute, name, function), function)
        decorated = click.option(
            "--progress", "progress_style", type=click.Choice(["auto", "bar", "json", "none"]),
            default="auto", show_default=True,
            help="auto: a bar on a terminal, otherwise a line every ten seconds. json: one JSON "
                 "object per line on standard output.")(body)
        decorated = click.option(
            "-v", "--verbose", is_flag=True,
            help="Print every value of the result.")(decorated)
        decorated = click.option(
            "--json", "as_json", is_flag=True,
            help="Print the result as one JSON object in the last line.")(decorated)
        return click.command(name, cls=_grouped_command())(decorated)
    return wrap


def command_of(stage: "type[Stage]") -> click.Command:
    """Make the command of a stage: its fields become options."""
    from limber.stages.command_line import GroupedOption, settings_options

    about = stage.about

    @stage_command(about.name)
    @click.option("--schema", cls=GroupedOption, expert=True, is_flag=True, is_eager=True,
                  expose_value=False, callback=functools.partial(_show_schema, about.name),
                  help="Print the stage's inputs, settings and options as a JSON schema, and "
                       "exit.")
    @settings_options(stage, "made")
    def command(run: Run, made: "Stage") -> dict[str, Any]:
        result = made.run(run.progress)
        for title, rows in about.result.of(_plain(result)).tables() if about.result else ():
            run.show(title, rows)
        values = dict(made) | _plain(result)
        if found := list(found_lines(about.found, values)):
            run.close(*found, where=_result_folder(about.writes, values),
                      then=command_to_type(about.then, values))
        return result
    command.help = inspect.getdoc(stage)
    return command


def _result_folder(writes: tuple[str, ...], values: dict[str, Any]) -> object:
    """The first file or folder that a stage wrote, if any."""
    folder = values.get("branch_folder")
    if folder is None or "output" in values:
        return values.get("output") or values.get("data") or values.get("folder") or folder or ""
    written = Path(folder, writes[0].replace("{name}", str(values.get("name"))) if writes else "")
    return written if written.exists() else folder


def _grouped_command() -> type[click.Command]:
    from limber.stages.command_line import GroupedCommand

    return GroupedCommand


def _show_schema(name: str, ctx: click.Context, _param: click.Parameter, wanted: bool) -> None:
    if wanted:
        click.echo(json.dumps(stage_schema(name), indent=1))
        ctx.exit()


def _plain(value: Any) -> Any:
    # Loads numpy and pydantic: not for `limber --help`.
    from limber.core.json_values import plain

    return plain(value)


def run(arguments: list[str] | None = None) -> None:
    """Entry point of the command ``limber``; does not return."""
    sys.exit(call(arguments))


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
        error.show()
        return error.exit_code
    except (click.Abort, KeyboardInterrupt):
        return 130
    except LimberError as error:
        _say(f"error: {error}")
        return error.exit_code
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else int(stop.code is not None)
    except OSError as error:
        return _output_lost(error)
    return 0


def _output_lost(error: OSError) -> int:
    """State that standard output is closed; a command's other output is complete."""
    with contextlib.suppress(OSError, ValueError):
        # Python flushes it again at exit, and would report that as an error of ours.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    if not isinstance(error, BrokenPipeError):
        click.echo(f"error: Standard output cannot be written ({error.strerror or error}).",
                   err=True)
    return 3


def _execute(name: str, function: Callable[..., dict[str, Any]], /, *, as_json: bool,
             verbose: bool, progress_style: str, **options: Any) -> None:
    """Run a command's function, print its outcome and exit with its code."""
    started = time.perf_counter()
    style = "json" if as_json else "verbose" if verbose else "short"
    if progress_style == "auto":
        progress_style = "bar" if sys.stderr.isatty() else "log"
    outcome: dict[str, Any] = {"command": name, "status": "done", "error": None}
    result: dict[str, Any] = {}
    lines = JsonSink() if progress_style == "json" else None
    state = Run(lines, _say)
    code = 0
    try:
        with contextlib.ExitStack() as around:
            if progress_style == "bar":
                bar = around.enter_context(BarSink(name))
                state = Run(bar, bar.say)
            elif progress_style == "log":
                state = Run(around.enter_context(LogSink(name)), _say)
            elif lines is not None:
                around.enter_context(Heartbeat(lines.say))
            around.enter_context(report_damage_to(state.progress.warn))
            result = function(state, **options)
    except KeyboardInterrupt:
        code = 130
        outcome |= {"status": "cancelled", "error": "Cancelled; earlier results are untouched."}
    except Exception as caught:
        error = caught if isinstance(caught, LimberError) else machine_error(caught)
        if error is None:
            # A bug: the traceback goes to standard error, and the last line is JSON all the same.
            traceback.print_exc()
            error = WorkError(f"internal error: {caught!r}; please report it")
        code = error.exit_code
        if isinstance(error, SafetyStop | PartlyFailedError):
            result = error.result
        outcome |= error.as_json() | {"remedies": _remedies(error)}
    outcome |= {"seconds": round(time.perf_counter() - started, 3), "warnings": state.warnings}
    if told := [text for text in state.warnings if text.named or text.place]:
        outcome["warning_parts"] = [{"text": text, "parts": text.as_json(), "place": text.place}
                                    for text in told]
    _print_outcome(outcome, result or {}, style, state.closing)
    sys.exit(code)


def _remedies(error: LimberError) -> list[dict[str, Any]]:
    """The error's remedies, without options that the command at hand lacks."""
    from limber.stages.command_line import is_own, options_of

    own = options_of(click.get_current_context().command)
    return [part.as_json() for part in error.remedies if is_own(part, own)]


def _say(text: str) -> None:
    """Print on standard error; names and texts of files cannot control the terminal."""
    click.echo(_CONTROL.sub("?", text), err=True)


def _print_outcome(outcome: dict[str, Any], result: dict[str, Any], style: str,
                   closing: list[str]) -> None:
    if style == "json":
        print(json.dumps(_plain(outcome | result), allow_nan=False), flush=True)
    if outcome["error"]:
        _say(f"error: {outcome['error']}")
    elif style != "json":
        # Warnings were printed when they occurred.
        summary = {k: v for k, v in _plain(result).items() if k != "warnings"}
        is_short = bool(closing) and style == "short"
        for line in closing if is_short else [*result_lines(summary), *closing]:
            click.echo(_CONTROL.sub("?", line))
        click.echo(f"{outcome['command']}: done in {outcome['seconds']:.1f} s"
                   + (" (--verbose shows all values)" if is_short else ""))


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
