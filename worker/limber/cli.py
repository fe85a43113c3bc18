"""The command ``limber``: finds the commands, and gives each the same way of running.

A command is a module in ``limber/commands`` with an object ``command`` made by
:func:`stage_command`. All of them take ``--json`` and ``--progress``, end with the exit codes of
``limber.errors`` and, with ``--json``, print one JSON object as their last line.
"""

import functools
import importlib
import json
import signal
import sys
import time
import traceback
import types
import typing
from collections.abc import Callable
from typing import Any, Literal

import click
from pydantic import BaseModel

from limber.errors import LimberError
from limber.plain import plain
from limber.progress import BarSink, JsonSink, Progress, Sink
from limber.settings import checked_settings
from limber.terminal import result_lines, table_lines
from limber.version import VERSION

# Command name to what `limber --help` says of it. Modules are imported when they are called:
# `limber --help` must not wait for the numerical packages.
COMMANDS = {
    "reconstruct": "Scan to tetrahedra: skeleton, radii, surface, mesh.",
    "mesh": "Closed surface (STL, PLY, OBJ) to tetrahedra.",
    "generate": "A generated branch with known truth, scanned as a scanner would.",
    "simulate": "Pull a branch by a pose or a force; writes motion, energy and forces.",
    "import-pull": "Bring a recording of a pull into the branch folder.",
    "virtual-pull": "Simulate a pull with a known Young's modulus and sensor noise.",
    "estimate": "Young's modulus along the branch, from pulls.",
    "predict": "Where a branch rests under another load, with its estimated modulus.",
    "energy": "Energy field over grasp poses.",
    "plan": "Paths to a goal: RRT* and deformation-aware D-RRT*, compared.",
    "session": "A branch held in a process that other programs bend, by JSON lines.",
    "report": "One self-contained HTML page with figures and tables of all results.",
    "scene": "A Blender scene with the branch, its motion and paths.",
    "demo": "The whole pipeline on one branch.",
    "doctor": "What is installed, what is missing and what then does not work.",
}


# Designed, not built: named so that nobody looks for them in vain.
NOT_YET = {
    "record": "record a pull with a robot (bring one with `limber import-pull`)",
    "execute": "follow a path with a robot (paths are in plans/NAME.csv)",
    "virtual-robot": "a UR controller in software",
    "batch": "many jobs, on this machine or a cluster (`limber reconstruct` takes a folder)",
}


class _Commands(click.Group):
    """Loads each command's module only when that command is asked for."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, name: str) -> click.Command | None:
        if name in NOT_YET:
            raise click.UsageError(f"`limber {name}` is not there yet: {NOT_YET[name]}.")
        if name not in COMMANDS:
            return None
        module = importlib.import_module(f"limber.commands.{name.replace('-', '_')}")
        return module.command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl(list(COMMANDS.items()))
        with formatter.section("Not there yet"):
            formatter.write_dl(list(NOT_YET.items()))


@click.group(cls=_Commands, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(VERSION, prog_name="limber")
def main() -> None:
    """From the scan of a plant branch to a simulation that behaves like it, and to gentle motion.

    Exit codes: 0 done, 2 wrong usage or input, 3 the work failed, 4 stopped for safety,
    130 cancelled.
    """


class Run:
    """What a command's function gets besides its options.

    ``progress`` to report and warn to, ``say`` to print a line on standard error, ``show`` a
    table there. ``warnings`` are kept for the JSON result.
    """

    def __init__(self, sink: Sink | None, say: Callable[[str], None]):
        self.progress = Progress(sink, self._warned)
        self.say = say
        self.warnings: list[str] = []

    def _warned(self, message: str) -> None:
        self.warnings.append(message)
        self.say(f"warning: {message}")

    def show(self, title: str, rows: list[list[str]]) -> None:
        """Print a table, its first row the header."""
        self.say("\n".join([f"\n{title}", *(f"  {line}" for line in table_lines(rows))]))


def stage_command(name: str) -> Callable[[Callable[..., dict[str, Any]]], click.Command]:
    """Make a click command of ``function(run, **options) -> result dict``.

    The docstring's first line is the help text. The result is printed for a person to read,
    or, with ``--json``, as the last line together with ``command``, ``status``, ``seconds``,
    ``warnings`` and ``error``.
    """
    def wrap(function: Callable[..., dict[str, Any]]) -> click.Command:
        @functools.wraps(function)
        def body(as_json: bool, progress_style: str, **options: Any) -> None:
            sys.exit(_execute(name, function, as_json, progress_style, options))
        decorated = click.option(
            "--progress", "progress_style", type=click.Choice(["auto", "bar", "json", "none"]),
            default="auto", show_default=True,
            help="bar on a terminal; json: one JSON object a line on standard output.")(body)
        decorated = click.option(
            "--json", "as_json", is_flag=True,
            help="Print the result as one JSON object, the last line.")(decorated)
        return click.command(name)(decorated)
    return wrap


def settings_options(model: type[BaseModel]) -> Callable[[Callable], Callable]:
    """Add one option for each field of a settings model; the function gets ``settings=model(...)``.

    A field's description is its help text, its default the option's. ``bool`` fields become
    ``--name/--no-name``, ``tuple[float, float, float]`` take three values, a tuple of
    such tuples may be given several times (``json_schema_extra={"metavar": ...}`` names them).
    """
    def wrap(function: Callable) -> Callable:
        @functools.wraps(function)
        def body(*args: Any, **options: Any) -> Any:
            given = {name: options.pop(name) for name in model.model_fields}
            values = {name: value for name, value in given.items() if value is not None}
            return function(*args, settings=checked_settings(model, values), **options)
        for name, field in reversed(model.model_fields.items()):
            body = _option(name, field)(body)
        return body
    return wrap


def run(arguments: list[str] | None = None) -> None:
    """Entry point of the command ``limber``; does not return."""
    sys.exit(call(arguments))


def call(arguments: list[str] | None = None) -> int:
    """Run one command line and return its exit code; what Blender's command entry calls."""
    _terminate_like_interrupt()
    try:
        main.main(args=arguments, prog_name="limber", standalone_mode=False)
    except click.ClickException as error:
        error.show()
        return error.exit_code
    except (click.Abort, KeyboardInterrupt):
        return 130
    except LimberError as error:
        click.echo(f"error: {error}", err=True)
        return error.exit_code
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else int(stop.code is not None)
    return 0


def _execute(name: str, function: Callable[..., dict[str, Any]], as_json: bool,
             progress_style: str, options: dict[str, Any]) -> int:
    started = time.perf_counter()
    if progress_style == "auto":
        progress_style = "bar" if sys.stderr.isatty() else "none"
    outcome: dict[str, Any] = {"command": name, "status": "done", "error": None}
    result: dict[str, Any] = {}
    state = Run(JsonSink() if progress_style == "json" else None,
                functools.partial(click.echo, err=True))
    code = 0
    try:
        if progress_style == "bar":
            with BarSink(name) as bar:
                state = Run(bar, bar.say)
                result = function(state, **options)
        else:
            result = function(state, **options)
    except LimberError as error:
        code = error.exit_code
        outcome |= {"status": error.status, "error": str(error)}
    except KeyboardInterrupt:
        code = 130
        outcome |= {"status": "cancelled", "error": "Cancelled; earlier results are untouched."}
    except MemoryError:
        code = 3
        outcome |= {"status": "failed",
                    "error": "Out of memory. Use a coarser mesh or a thinner cloud."}
    except Exception as error:
        # A bug of ours: the trace goes to standard error, the contract of the last line holds.
        code = 3
        traceback.print_exc()
        outcome |= {"status": "failed", "error": f"internal error: {error!r}; please report it"}
    outcome |= {"seconds": round(time.perf_counter() - started, 3), "warnings": state.warnings}
    _print_outcome(outcome, result or {}, as_json)
    return code


def _print_outcome(outcome: dict[str, Any], result: dict[str, Any], as_json: bool) -> None:
    if as_json:
        print(json.dumps(plain(outcome | result), allow_nan=False), flush=True)
    if outcome["error"]:
        click.echo(f"error: {outcome['error']}", err=True)
    elif not as_json:
        # Warnings were said when they came up.
        for line in result_lines({k: v for k, v in plain(result).items() if k != "warnings"}):
            click.echo(line)
        click.echo(f"{outcome['command']}: done in {outcome['seconds']:.1f} s")


def _option(name: str, field: Any) -> Callable:
    kind, optional = _plain_type(field.annotation)
    flag = "--" + name.replace("_", "-")
    hidden = field.is_required() or optional
    default = None if hidden else field.get_default(call_default_factory=True)
    common = {"default": None, "help": _help(name, field, kind, default)}
    if kind is bool:
        return click.option(f"{flag}/--no-{name.replace('_', '-')}", name, **common)
    if typing.get_origin(kind) is Literal:
        return click.option(flag, name, type=click.Choice(typing.get_args(kind)), **common)
    if typing.get_origin(kind) is tuple:
        items = typing.get_args(kind)
        metavar = (field.json_schema_extra or {}).get("metavar")
        if items[-1] is Ellipsis and typing.get_origin(items[0]) is tuple:
            parts = typing.get_args(items[0])
            return click.option(flag, name, nargs=len(parts), type=parts[0], multiple=True,
                                metavar=metavar, **common)
        if items[-1] is Ellipsis:
            # Given twice it adds up: the last one alone would drop the others without a word.
            return click.option(flag, name, callback=_listed, metavar="A,B,...", multiple=True,
                                **common)
        if len(items) == 3:
            metavar = "X Y Z"
        return click.option(flag, name, nargs=len(items), type=items[0], metavar=metavar, **common)
    return click.option(flag, name, type=kind, **common)


def _listed(_ctx: click.Context, _param: click.Parameter, texts: tuple[str, ...]) -> Any:
    return tuple(part.strip() for text in texts for part in text.split(",")) or None


def _plain_type(annotation: Any) -> tuple[Any, bool]:
    if typing.get_origin(annotation) in (typing.Union, types.UnionType):
        kinds = [kind for kind in typing.get_args(annotation) if kind is not type(None)]
        return kinds[0], len(kinds) < len(typing.get_args(annotation))
    return annotation, False


def _help(name: str, field: Any, kind: Any, default: Any) -> str:
    """A field's description, then its default and range as they are typed."""
    told = []
    if default is not None and default != ():
        if kind is bool:
            shown = name if default else f"no_{name}"
            told.append(f"default: --{shown.replace('_', '-')}")
        elif isinstance(default, tuple):
            # Lists of any length are typed with commas, vectors with spaces.
            between = "," if typing.get_args(kind)[-1] is Ellipsis else " "
            told.append(f"default: {between.join(map(_shown, default))}")
        else:
            told.append(f"default: {_shown(default)}")
    told += _bounds(field)
    return f"{field.description or ''}  [{'; '.join(told)}]" if told else field.description or ""


def _bounds(field: Any) -> list[str]:
    words = {"gt": "more than", "ge": "at least", "lt": "less than", "le": "at most"}
    return [f"{word} {_shown(float(limit))}" for key, word in words.items()
            for part in field.metadata if (limit := getattr(part, key, None)) is not None]


def _shown(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _terminate_like_interrupt() -> None:
    """Let SIGTERM end a command as Ctrl-C does: with its clean-up and exit code 130."""
    def interrupt(_signal: int, _frame: Any) -> None:
        raise KeyboardInterrupt
    try:
        signal.signal(signal.SIGTERM, interrupt)
    except ValueError:
        # Not the main thread (Blender may call us from one): the default handler stays.
        return
