"""Command line options from a settings model, and the command line from settings.

A field's description is its option's help, its default the option's. ``bool`` fields become
``--name/--no-name``, ``tuple[float, float, float]`` takes three values, a tuple of such tuples may
be given several times. A field's ``json_schema_extra`` may also have: ``argument`` (given without
its name), ``short`` (a short option), ``switch`` (no ``--no-name``), ``metavar``.
"""

import re
import types
import typing
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, Literal

import click

from limber.core.errors import Command, Option, Text
from limber.core.settings import OneOf, Settings, checked_settings
from limber.stages.stage import Stage

Made = typing.TypeVar("Made", bound=Settings)


class GroupedOption(click.Option):
    """An option below a title in the help; an expert option is shown only by --help-all."""

    def __init__(self, *declarations: Any, group: str = "running", expert: bool = False,
                 **attributes: Any):
        super().__init__(*declarations, **attributes)
        self.group, self.expert = group, expert


class DescribedArgument(click.Argument):
    """An argument with a help text below a title."""

    def __init__(self, *declarations: Any, description: str, group: str, **attributes: Any):
        super().__init__(*declarations, **attributes)
        self.description, self.group = description, group


class GroupedCommand(click.Command):
    """A command whose help shows options below titles, and expert options on demand."""

    def __init__(self, *args: Any, **attributes: Any):
        super().__init__(*args, **attributes)
        self.params.append(GroupedOption(
            ["--help-all"], is_flag=True, is_eager=True, expose_value=False,
            callback=_show_all, help="Show this message with all options, and exit."))

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Read the arguments; a word may stand for all numbers of an option."""
        for param in self.get_params(ctx):
            if isinstance(param.type, _NumberOrWord):
                args = param.type.repeated(args, param)
        return super().parse_args(ctx, args)

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the options title by title."""
        sections: dict[str, list[tuple[str, str]]] = {}
        hidden = 0
        for param in self.get_params(ctx):
            if isinstance(param, DescribedArgument):
                sections.setdefault(param.group, []).append(
                    (param.make_metavar(ctx), param.description))
                continue
            if getattr(param, "expert", False) and not ctx.meta.get(_ALL):
                hidden += 1
                continue
            record = param.get_help_record(ctx)
            if record is not None:
                sections.setdefault(getattr(param, "group", "running"), []).append(record)
        # Options of the run itself come last in every command.
        running = sections.pop("running", [])
        for title, records in {**sections, "running": running}.items():
            if records:
                with formatter.section(title.capitalize()):
                    formatter.write_dl(records)
        if hidden:
            formatter.write_paragraph()
            formatter.write_text(f"{hidden} more options: --help-all")


class _Number(click.ParamType):
    """A number, with its unit or without: the model reads it, as it reads those of other doors."""

    name = "number"


class _NumberOrWord(_Number):
    """A number, or one of the words that stand for all numbers of an option."""

    def __init__(self, words: Collection[str]):
        self.words = words

    def repeated(self, args: list[str], param: click.Parameter) -> list[str]:
        """Return arguments in which a word is given as often as numbers would be."""
        found: list[str] = []
        for text in args:
            flag, is_joined, word = text.partition("=")
            if found[-1:] and found[-1] in param.opts and text in self.words:
                found += param.nargs * [text]
            elif is_joined and flag in param.opts and word in self.words:
                found += [flag, *param.nargs * [word]]
            else:
                found.append(text)
        return found

    def joined(self, _ctx: click.Context, _param: click.Parameter, values: Any) -> Any:
        """A word that was given for all numbers, or the numbers; a callback of click."""
        return values[0] if values and len({*values}) == 1 and values[0] in self.words else values


_ALL = "limber.help_all"


def _show_all(ctx: click.Context, _param: click.Parameter, wanted: bool) -> None:
    if wanted:
        ctx.meta[_ALL] = True
        click.echo(ctx.get_help())
        ctx.exit()


def options_of(command: click.Command) -> frozenset[str]:
    """Return the options of a command, as they are typed."""
    return frozenset(flag for param in command.params
                     if isinstance(param, click.Option) and not param.hidden
                     for flag in (*param.opts, *param.secondary_opts))


def without_foreign_options(message: Text, own: Collection[str]) -> str:
    """Return a message without the brackets and sentences that name options not among ``own``, for
    a command that runs others: its user cannot give theirs."""
    text = message.shown(lambda part: str(part) if is_own(part, own) else "\0")
    return " ".join(part for part in re.split(r"(?<=[.?!])\s+", re.sub(
        r"\s*\([^()]*\0[^()]*\)", "", text)) if "\0" not in part)


def is_own(part: Option | Command, own: Collection[str]) -> bool:
    """Whether a command with the options ``own`` can be given an option; any command can be run."""
    return isinstance(part, Command) or str(Option(part.name)) in own


def parameters(model: type[Settings]) -> list[click.Parameter]:
    """Return an argument or option for each field of a model."""
    return [_parameter(model, name) for name in _names(model)]


def made_of(model: type[Made], typed: Mapping[str, Any]) -> Made:
    """Return the model of what was typed, by the names of its fields; InputError if it is refused.
    """
    return checked_settings(model, {name: typed[name] for name in _names(model)
                                    if typed.get(name) is not None})


def _names(model: type[Settings]) -> list[str]:
    return model.names() if issubclass(model, Stage) else list(model.model_fields)


def command_line(model: Settings) -> list[str]:
    """Return the arguments that give a command these values; defaults are omitted."""
    arguments: list[str] = []
    options: list[str] = []
    kind = type(model)
    for name in _names(kind):
        field, value = kind.model_fields[name], getattr(model, name)
        # A stated value counts even if it is the default: the unit would be asked for.
        if not field.is_required() and name not in model.model_fields_set and (
                value == field.get_default(call_default_factory=True)):
            continue
        extra: Any = field.json_schema_extra or {}
        if extra.get("argument"):
            arguments.append(str(value))
        else:
            options += _typed(name, field, value)
    return [*options, "--", *arguments] if arguments else options


def _typed(name: str, field: Any, value: Any) -> list[str]:
    """An option as it is typed."""
    flag = "--" + name.replace("_", "-")
    if isinstance(value, bool):
        return [flag if value else f"--no-{flag[2:]}"]
    if not isinstance(value, tuple):
        return [flag, str(value)]
    kinds = typing.get_args(_plain_type(field.annotation)[0])
    if kinds[-1] is not Ellipsis:
        return [flag, *map(str, value)]
    if typing.get_origin(kinds[0]) is tuple:
        return [text for item in value for text in (flag, *map(str, item))]
    return [flag, ",".join(map(str, value))]


def _parameter(model: type[Settings], name: str) -> click.Parameter:
    field: Any = model.model_fields[name]
    extra = field.json_schema_extra or {}
    kind, optional = _plain_type(field.annotation)
    group = model.group_of(name)
    if extra.get("argument"):
        own = name.upper() if field.is_required() else f"[{name.upper()}]"
        return DescribedArgument([name], metavar=extra.get(
            "metavar", None if typing.get_origin(kind) is Literal else own),
                                 type=_click_type(kind), required=field.is_required(),
                                 description=field.description or "", group=group)
    hidden = field.is_required() or optional
    default = None if hidden else field.get_default(call_default_factory=True)
    flag = "--" + name.replace("_", "-")
    flags = [extra["short"], flag] if "short" in extra else [flag]
    common = {"default": None, "required": field.is_required(), "group": group,
              "expert": model.is_expert(name), "help": _help(name, field, kind, default)}
    if "metavar" in extra:
        common["metavar"] = extra["metavar"]
    if kind is bool and extra.get("switch"):
        return GroupedOption([*flags, name], is_flag=True, **common | {"help": field.description})
    if kind is bool:
        return GroupedOption([f"{flag}/--no-{flag[2:]}", name], **common)
    if typing.get_origin(kind) is tuple:
        return _tuple_option([*flags, name], typing.get_args(kind), common,
                             _words(field.annotation))
    for part in field.metadata:
        if isinstance(part, OneOf):
            return GroupedOption([*flags, name], type=click.Choice(part.names()), **common)
    return GroupedOption([*flags, name], type=_click_type(kind), **common)


def _words(annotation: Any) -> list[str]:
    """The words that a field takes besides its numbers."""
    return [word for kind in typing.get_args(annotation) if typing.get_origin(kind) is Literal
            for word in typing.get_args(kind)]


def _tuple_option(names: list[str], items: tuple, common: dict[str, Any], words: list[str],
                  ) -> click.Option:
    if items[-1] is Ellipsis and typing.get_origin(items[0]) is tuple:
        parts = typing.get_args(items[0])
        return GroupedOption(names, nargs=len(parts), type=_click_type(parts[0]), multiple=True,
                             **common)
    if items[-1] is Ellipsis:
        # Repeated values add up: using only the last would silently drop the others.
        return GroupedOption(names, callback=_listed, multiple=True,
                             **{"metavar": "A,B,...", **common})
    if len(items) == 3:
        common = {"metavar": "|".join(["X Y Z", *words]), **common}
    if words:
        kind = _NumberOrWord(words)
        common = {"callback": kind.joined, **common}
        return GroupedOption(names, nargs=len(items), type=kind, **common)
    return GroupedOption(names, nargs=len(items), type=_click_type(items[0]), **common)


def _click_type(kind: Any) -> Any:
    if kind in (int, float):
        return _Number()
    if typing.get_origin(kind) is Literal:
        return click.Choice(typing.get_args(kind))
    return click.Path(path_type=Path) if kind is Path else kind


def _listed(_ctx: click.Context, _param: click.Parameter, texts: tuple[str, ...]) -> Any:
    return tuple(part.strip() for text in texts for part in text.split(",")) or None


def _plain_type(annotation: Any) -> tuple[Any, bool]:
    if typing.get_origin(annotation) in (typing.Union, types.UnionType):
        kinds = [kind for kind in typing.get_args(annotation) if kind is not type(None)]
        return kinds[0], len(kinds) < len(typing.get_args(annotation))
    return annotation, False


def _help(name: str, field: Any, kind: Any, default: Any) -> str:
    """A field's description, then its default and range as they are typed."""
    parts = []
    if default not in (None, "", ()):
        if kind is bool:
            flag = name if default else f"no_{name}"
            parts.append(f"default: --{flag.replace('_', '-')}")
        elif isinstance(default, tuple):
            # Lists of any length are typed with commas, vectors with spaces.
            between = "," if typing.get_args(kind)[-1] is Ellipsis else " "
            parts.append(f"default: {between.join(map(_shown, default))}")
        else:
            parts.append(f"default: {_shown(default)}")
    parts += _bounds(field)
    return f"{field.description or ''}  [{'; '.join(parts)}]" if parts else field.description or ""


def _bounds(field: Any) -> list[str]:
    words = {"gt": "more than", "ge": "at least", "lt": "less than", "le": "at most"}
    return [f"{word} {_shown(float(limit))}" for key, word in words.items()
            for part in field.metadata if (limit := getattr(part, key, None)) is not None]


def _shown(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
