"""The worker's texts in the words of the panels instead of options and commands. No bpy."""

import re

from .stages import Field, Stage, stages

_OPTION = re.compile(r"--(?P<name>[a-z][a-z0-9-]*)(?:[ =](?P<value>[^\s,;:()]+))?")
_COMMAND = re.compile(r"`limber (?P<name>[a-z-]+)[^`]*`")
_BUTTONS = {"doctor": "Check the Worker"}
"""Buttons of commands that are no stages."""
_SENTENCE = re.compile(r"(?<=[.?!])\s+(?=[A-Z])")


def plain(text: str, stage: Stage | None = None) -> str:
    """Return a text with the titles of settings for options, and of buttons for commands.

    ``--plants largest`` becomes ``Plants: largest``, `` `limber energy` `` becomes ``Sample the
    Energy``. Options without a panel stay. An option that several stages have is that of ``stage``.
    """
    text = _COMMAND.sub(lambda match: _label(match["name"]) or match[0], text)
    return _OPTION.sub(lambda match: _setting(match, stage), text)


def first_sentence(text: str) -> str:
    """Return the first sentence of a text: what was seen."""
    return _SENTENCE.split(text.strip(), maxsplit=1)[0]


def stages_in(text: str) -> list[Stage]:
    """Return the stages with a button whose commands the worker's text names, each once.

    One that makes a branch replaces it, and one that moves a robot is started from its own panel.
    """
    named = [stages().get(match["name"]) for match in _COMMAND.finditer(text)]
    return [stage for number, stage in enumerate(named) if stage is not None and stage.step
            and not stage.makes_branch and not stage.moves_robot and stage not in named[:number]]


def settings_in(text: str, stage: Stage) -> list[Field]:
    """Return the settings of ``stage`` that the worker's text names without a value, each once.

    Only the user knows the value. Switches are buttons of their own.
    """
    named = [match["name"].replace("-", "_") for match in _OPTION.finditer(text)
             if not _is_value(stage.fields.get(match["name"].replace("-", "_")), match["value"])]
    return [stage.fields[name] for name in dict.fromkeys(named)
            if name in stage.fields and stage.fields[name] in stage.own_fields
            and stage.fields[name].kind != "boolean"]


def choice_title(stage: Stage, option: str, value: object) -> str:
    """Return the button's title of a choice; empty if the stage has no such setting."""
    field = stage.fields.get(option)
    if field is None:
        return ""
    if field.kind == "boolean":
        return f"{field.title}: {'on' if value else 'off'}"
    shown = (f"{value:g}" if isinstance(value, float) else str(value).replace("_", " ")
             if not isinstance(value, list) else " ".join(f"{number:g}" for number in value))
    return f"{field.title}: {shown}{f' {field.unit}' if field.unit else ''}"


def _label(name: str) -> str:
    stage = stages().get(name)
    return stage.label if stage is not None and stage.label else _BUTTONS.get(name, "")


def _setting(match: re.Match, stage: Stage | None) -> str:
    name, value = match["name"].replace("-", "_"), match["value"]
    field = _field(name, stage)
    if field is None:
        # A word may follow, as in "use --no-gravity and".
        off = _field(name.removeprefix("no_"), stage)
        return match[0] if off is None or off.kind != "boolean" else (
            f"{off.title}: off{f' {value}' if value else ''}")
    if not value:
        return field.title
    return f"{field.title}: {value}" if _is_value(field, value) else f"{field.title} {value}"


def _is_value(field: Field | None, word: str | None) -> bool:
    """Whether the word after an option is its value; it may as well be the next of the sentence."""
    if field is None or not word:
        return False
    return word.rstrip(".") in (*field.choices, field.word) or (
        field.kind in ("choice", "number", "integer") and word[0].isdigit())


def _field(name: str, stage: Stage | None) -> Field | None:
    for each in (*([stage] if stage is not None else []), *stages().values()):
        if name in each.fields:
            return each.fields[name]
    return None
