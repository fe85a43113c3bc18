"""What a message names is data: options and commands that exist, and a position."""

import ast
import functools
import json
import pickle
import re
from pathlib import Path

import click
import pytest
from pydantic import TypeAdapter

from limber.cli.main import call, main
from limber.core.errors import Command, InputError, Option, Text
from limber.stages.registry import stage_class, stage_summaries

ROOT = Path(__file__).parents[2]
TYPED = re.compile(r"(?<![\w-])--[a-z][a-z0-9-]+|`limber ")
FOREIGN = ("dask worker --no-nanny", "limber --follow-links")
"""What is typed, but is no option or command of ours."""


@functools.cache
def _source() -> list[tuple[Path, ast.Module]]:
    return [(path, ast.parse(path.read_text(encoding="utf-8")))
            for path in sorted((ROOT / "worker" / "limber").rglob("*.py"))]


def _commands(command: click.Command, name: str = ""):
    """Each command by name, with its options as they are typed."""
    yield name, {"--help"}.union(*((*param.opts, *param.secondary_opts)
                                   for param in command.params))
    if isinstance(command, click.Group):
        context = click.Context(command)
        for each in command.list_commands(context):
            yield from _commands(command.get_command(context, each), f"{name} {each}".strip())


@functools.cache
def _known() -> dict[str, set[str]]:
    return dict(_commands(main))


@functools.cache
def _all_calls() -> list[tuple[str, ast.Call, str]]:
    """The calls in the source, each with its place and the name after the last dot."""
    return [(f"{path.relative_to(ROOT)}:{node.lineno}", node, _name(node))
            for path, tree in _source() for node in ast.walk(tree) if isinstance(node, ast.Call)]


def _name(call: ast.Call) -> str:
    return getattr(call.func, "attr", getattr(call.func, "id", ""))


def _calls(*names: str):
    return [each for each in _all_calls() if each[2] in names]


def _values(node: ast.Call) -> list:
    """The arguments that are known before it runs."""
    return [each.value for each in node.args if isinstance(each, ast.Constant)]


def _is_taken(option: Option) -> bool:
    """Whether a command has the option; with a value, whether a stage's field of it takes that."""
    fields = [stage.model_fields[option.name] for stage in map(stage_class, stage_summaries())
              if option.name in stage.model_fields]

    def takes(field) -> bool:
        kept = [name for part in field.metadata for name in getattr(part, "kept", ())]
        try:
            return option.value in kept or bool(TypeAdapter(
                field.annotation).validate_python(option.value) or True)
        except ValueError:
            return False
    return any(str(Option(option.name)) in flags for flags in _known().values()) and (
        option.value is None or not fields or any(map(takes, fields)))


@pytest.mark.slow
def test_options_and_commands_of_messages_exist():
    """A command with the options that are named with it; an option with a value that it takes."""
    commands = _known()
    wrong = [place for place, node, name in _calls("Option", "Command") if (known := _values(node))
             and not (known[0] in commands and commands[known[0]].issuperset(
                 str(Option(*_values(each)[:1])) for each in node.args if isinstance(each, ast.Call)
                 and _name(each) == "Option")
                 if name == "Command" else _is_taken(Option(*known)))]
    assert not wrong


@pytest.mark.slow
def test_no_error_or_warning_names_an_option_in_its_text():
    """Only as data, which each interface shows in its own way."""
    names = {_name(node.exc) for _, tree in _source() for node in ast.walk(tree)
             if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call)}
    found = []
    for place, node, _ in _calls(*names, "warn", "warned", "Text"):
        for each in (*node.args, *(keyword.value for keyword in node.keywords)):
            text = "".join(part.value for part in ast.walk(each)
                           if isinstance(part, ast.Constant) and isinstance(part.value, str))
            if TYPED.search(text) and not any(part in text for part in FOREIGN):
                found.append((place, text))
    assert not found


def test_a_message_is_shown_by_its_parts():
    """As text it is what one types; nested, sent and read again it keeps its parts and place."""
    text = Text("Join them (", Option("plants", "joined"), "), or state ",
                Option("root", (1.5, -2)))
    assert text == "Join them (--plants joined), or state --root 1.5 -2"
    text = Text("Two. ", text.at(iter((1, 2.5, 3))), " Or ", Command("energy", Option("samples")))
    for same in (text, pickle.loads(pickle.dumps(text)),
                 Text.from_json(json.loads(json.dumps(text.as_json())))):
        assert same.endswith("--root 1.5 -2 Or `limber energy --samples`")
        assert [str(part) for part in same.named] == [
            "--plants joined", "--root 1.5 -2", "`limber energy --samples`"]
        assert same.shown(lambda part: "x") == "Two. Join them (x), or state x Or x"
    assert text.place == (1.0, 2.5, 3.0)


def test_an_error_offers_what_its_fix_names():
    """And the options in the rest of it without their values: the user may change them."""
    error = InputError(Text("Both ", Option("gust", 3.0), " and ", Option("wind"), " are given."),
                       "", "Omit ", Option("wind"), ", or ", Option("gravity", False), ".")
    assert error.remedies == (Option("wind"), Option("gravity", False), Option("gust"))
    assert str(error) == "Both --gust 3 and --wind are given. Omit --wind, or --no-gravity."
    again = pickle.loads(pickle.dumps(error.at([1, 2, 3])))
    assert str(again) == str(error) and again.remedies == error.remedies
    assert again.place == (1.0, 2.0, 3.0) and InputError("Two plants.").place is None
    assert InputError(Text("Two.").at([1, 2, 3])).place == (1.0, 2.0, 3.0)


def test_an_option_that_the_command_lacks_is_not_offered(tmp_path, capsys):
    """The text names it; a field of another command is none of this one's."""
    assert call(["verify", str(tmp_path / "no.branch"), "--json"]) == 2
    told = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert [each["command"] for each in told["remedies"]] == ["reconstruct"]
    assert "`limber reconstruct CLOUD -o NAME.branch`" in told["fix"]
