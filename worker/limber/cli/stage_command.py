"""The command of a stage: its fields become arguments and options, its result what is printed.

It ends with the exit codes of ``limber.core.errors``. With ``--json`` its last line is one JSON
object: the result, together with ``command``, ``status``, ``seconds``, ``warnings`` and ``error``.
"""

import contextlib
import inspect
import json
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import click

from limber.cli.input_files import input_files
from limber.cli.terminal import (
    closing_lines,
    command_to_type,
    found_lines,
    result_lines,
    say,
    table_text,
    without_control,
)
from limber.core.errors import LimberError, PartlyFailedError, SafetyStop, Text, WorkError
from limber.core.json_values import plain, stored
from limber.core.machine_errors import machine_error
from limber.core.processes.heartbeat import Heartbeat
from limber.core.progress import BarSink, JsonSink, LogSink, Progress
from limber.stages.command_line import (
    GroupedCommand,
    GroupedOption,
    is_own,
    made_of,
    options_of,
    parameters,
)
from limber.stages.registry import schema_of
from limber.stages.stage import Stage, Tool


class StageCommand(GroupedCommand):
    """The command of a stage; its docstring is the help."""

    def __init__(self, stage: type[Stage]):
        self.stage = stage
        super().__init__(stage.about.name.rpartition(" ")[2], help=inspect.getdoc(stage), params=[
            *([] if stage.about.prints else self._running()), *parameters(stage)])

    def invoke(self, ctx: click.Context) -> None:
        """Run the stage of what was typed, print its outcome and exit with its code."""
        if self.stage.about.prints:
            made_of(self.stage, ctx.params).run()
            return
        started = time.perf_counter()
        outcome: dict[str, Any] = {"command": self.name, "status": "done", "error": None}
        warnings: list[Text] = []
        result: dict[str, Any] = {}
        closing: list[str] = []
        code = 0
        try:
            with (self._progress(ctx.params["progress_style"], warnings,
                                 is_quiet=ctx.params["quiet"]) as progress,
                  input_files(self.params, ctx.params) as typed):
                stage = made_of(self.stage, typed)
                result = stored(plain(stage.run(progress)))
                closing = _closing(stage, result, progress)
        except KeyboardInterrupt:
            code = 130
            outcome |= {"status": "cancelled", "error": "Cancelled; earlier results are untouched."}
        except Exception as caught:
            error = caught if isinstance(caught, LimberError) else machine_error(caught)
            if error is None:
                # A bug: the traceback goes to standard error, and the last line is JSON all the
                # same.
                traceback.print_exc()
                error = WorkError(f"internal error: {caught!r}; please report it")
            code = error.exit_code
            result = (plain(error.result or {})
                      if isinstance(error, SafetyStop | PartlyFailedError) else {})
            own = options_of(self)
            outcome |= error.as_json() | {"remedies": [
                # Without options that this command lacks.
                part.as_json() for part in error.remedies if is_own(part, own)]}
        outcome |= {"seconds": round(time.perf_counter() - started, 3), "warnings": warnings}
        if told := [text for text in warnings if text.named or text.place]:
            outcome["warning_parts"] = [{"text": text, "parts": text.as_json(),
                                         "place": text.place} for text in told]
        _print_outcome(outcome, result, closing, ctx.params)
        sys.exit(code)

    def _running(self) -> list[click.Parameter]:
        """The options of each command's run."""
        return [
            GroupedOption(["--json", "as_json"], is_flag=True,
                          help="Print the result as one JSON object in the last line."),
            GroupedOption(["-v", "--verbose"], is_flag=True,
                          help="Print every value of the result."),
            GroupedOption(["-q", "--quiet"], is_flag=True,
                          help="Print warnings and errors only."),
            GroupedOption(["--progress", "progress_style"], default="auto", show_default=True,
                          type=click.Choice(["auto", "bar", "json", "none"]),
                          help="auto: a bar on a terminal, otherwise a line every ten seconds. "
                               "json: one JSON object per line on standard output."),
            GroupedOption(["--schema"], expert=not issubclass(self.stage, Tool), is_flag=True,
                          is_eager=True, expose_value=False, callback=self._show_schema,
                          help="Print the stage's inputs, settings and options as a JSON schema, "
                               "and exit.")]

    def _show_schema(self, ctx: click.Context, _param: click.Parameter, wanted: bool) -> None:
        if wanted:
            click.echo(json.dumps(schema_of(self.stage), indent=1))
            ctx.exit()

    @contextlib.contextmanager
    def _progress(self, style: str, warnings: list[Text], *, is_quiet: bool = False,
                  ) -> Iterator[Progress]:
        """The progress of a run in a style; its warnings are printed and kept."""
        title, is_quiet = str(self.name), is_quiet and not self.stage.about.moves_robot
        style = "none" if is_quiet else style
        if style == "auto":
            style = "bar" if sys.stderr.isatty() else "log"

        def on_warning(message: Text) -> None:
            warnings.append(message)
            told(f"warning: {message}")
        told: Callable[[str], None] = say
        sink: Any = None
        with contextlib.ExitStack() as around:
            if style == "bar":
                sink = around.enter_context(BarSink(title))
                told = sink.say
            elif style == "log":
                sink = around.enter_context(LogSink(title))
            elif style == "json":
                sink = JsonSink()
                around.enter_context(Heartbeat(sink.say))
            progress = Progress(sink, on_warning, (lambda _line: None) if is_quiet else told)
            yield progress


def _closing(stage: Stage, result: dict[str, Any], progress: Progress) -> list[str]:
    """Show the tables of a result; return its last lines, which replace its values: what was
    found, where it is and what to type next."""
    about, values = stage.about, dict(stage) | result
    for title, rows in about.result.of(result).tables() if about.result else ():
        progress.say(table_text(title, rows))
    found = list(found_lines(about.found, values))
    where = (_written(about.writes, values) if about.where is None
             else next(found_lines([about.where], values), ""))
    return closing_lines(found, where, command_to_type(about.then, values)) if found else []


def _written(writes: tuple[str, ...], values: dict[str, Any]) -> object:
    """The first file or folder that a stage wrote, if any."""
    folder = values.get("branch_folder")
    if folder is None or "output" in values:
        return values.get("output") or values.get("data") or values.get("folder") or folder or ""
    written = Path(folder, writes[0].replace("{name}", str(values.get("name"))) if writes else "")
    return written if written.exists() else folder


def _print_outcome(outcome: dict[str, Any], result: dict[str, Any], closing: list[str],
                   typed: Mapping[str, Any]) -> None:
    if typed["as_json"]:
        print(json.dumps(plain(outcome | result), allow_nan=False), flush=True)
    if outcome["error"]:
        say(f"error: {outcome['error']}")
    elif not typed["as_json"] and not typed["quiet"]:
        # Warnings were printed when they occurred.
        summary = {k: v for k, v in result.items() if k != "warnings"}
        is_short = bool(closing) and not typed["verbose"]
        for line in closing if is_short else [*result_lines(summary), *closing]:
            click.echo(without_control(line))
        click.echo(f"{outcome['command']}: done in {outcome['seconds']:.1f} s"
                   + (" (--verbose shows all values)" if is_short else ""))
