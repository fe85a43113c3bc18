"""The worker's messages in the words of the panels instead of options and commands. No bpy.

The worker writes a message as a list of texts and of what it names: ``option`` with ``value``, or
``command``, with the ``text`` that a terminal shows.
"""

from typing import Any

from .stages import Field, Stage, stages

_BUTTONS = {"doctor": "Check the Worker"}
"""Buttons of commands that are no stages."""


def error_texts(outcome: dict[str, Any], stage: Stage | None = None) -> list[str]:
    """Return what the worker saw, why it is wrong and what to do; all in one where it is unknown.

    An option that several stages have is that of ``stage``.
    """
    parts = outcome.get("parts") or [[outcome["error"]]]
    return [text for text in (_shown(part, stage) for part in parts) if text]


def warning_text(outcome: dict[str, Any], warning: str, stage: Stage | None = None) -> str:
    """Return a warning of an outcome."""
    return next((_shown(told["parts"], stage) for told in outcome.get("warning_parts", ())
                 if told["text"] == warning), warning)


def choice_title(field: Field, value: object) -> str:
    """Return a setting and its value in words: the button's title of a choice."""
    if field.kind == "boolean":
        return f"{field.title}: {'on' if value else 'off'}"
    shown = (f"{value:g}" if isinstance(value, float) else str(value).replace("_", " ")
             if not isinstance(value, list) else " ".join(f"{number:g}" for number in value))
    return f"{field.title}: {shown}{f' {field.unit}' if field.unit else ''}"


def _shown(parts: list[Any], stage: Stage | None) -> str:
    return "".join(part if isinstance(part, str) else _title(part, stage) for part in parts)


def _title(part: dict[str, Any], stage: Stage | None) -> str:
    if part["command"]:
        other = stages().get(part["command"])
        return (other.label if other else _BUTTONS.get(part["command"])) or part["text"]
    field = next((each.fields[part["option"]] for each in (stage, *stages().values())
                  if each is not None and part["option"] in each.fields), None)
    if field is None:
        return part["text"]
    return field.title if part["value"] is None else choice_title(field, part["value"])
