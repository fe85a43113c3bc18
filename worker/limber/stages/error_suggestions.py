"""What an error's text offers: options of the stage with their values, and a position."""

import re
from typing import Any

_OPTION = re.compile(r"--(?P<name>[a-z][a-z0-9-]*)(?:[ =](?P<value>[^\s,;:()]+))?")

_NUMBER = r"-?\d+(?:\.\d*)?(?:e[-+]?\d+)?"
_PLACE = re.compile(rf"[(\[]\s*({_NUMBER})[,\s]\s*({_NUMBER})[,\s]\s*({_NUMBER})\s*[)\]] m\b"
                    r"(?! in the)")


def position_in(schema: dict[str, Any], text: str) -> list[float] | None:
    """Return the first position that a text names, in the branch's frame [m]; None without.

    Args:
        schema: Schema of the stage. One that makes a branch has no frame yet, and one that moves a
            robot may mean the frame of the robot's base: theirs are not taken from the text.
        text: What the user reads, for example "inside the post at (0.1, 0.2, 0.3) m".
    """
    if schema["moves_robot"] or "branch_folder" not in schema["inputs"].get("properties", {}):
        return None
    match = _PLACE.search(text)
    return [float(value) for value in match.groups()] if match else None


def offers(schema: dict[str, Any], text: str) -> list[dict[str, Any]]:
    """Return the options that a text offers with a value, in its order, each once.

    Args:
        schema: Schema of the stage, from :func:`limber.stages.registry.stage_schema`.
        text: What the user reads, for example "join them (--plants joined)".

    Returns:
        For each the ``option`` (the name of its field) and its ``value``. Options without a value
        are excluded: only the user knows the value.
    """
    fields = {name: about for part in ("inputs", "settings", "options")
              for name, about in schema[part].get("properties", {}).items()}
    found: list[dict[str, Any]] = []
    for match in _OPTION.finditer(text):
        name, value = match["name"].replace("-", "_"), (match["value"] or "").rstrip(".")
        one = _switch(fields, name)
        if one is None and value and name in fields:
            one = _valued(name, fields[name], value, text[match.start("value"):])
        if one is not None and one not in found:
            found.append(one)
    return found


def _switch(fields: dict[str, Any], name: str) -> dict[str, Any] | None:
    for field, value in ((name, True), (name.removeprefix("no_"), False)):
        if (value or field != name) and fields.get(field, {}).get("type") == "boolean":
            return {"option": field, "value": value}
    return None


def _valued(name: str, about: dict[str, Any], value: str, rest: str) -> dict[str, Any] | None:
    for kind in about.get("anyOf", [about]):
        if value in kind.get("enum", [kind.get("const")]):
            return {"option": name, "value": value}
        if kind.get("maxItems"):
            numbers = re.match(" ".join(kind["maxItems"] * [f"({_NUMBER})"]), rest)
            if numbers:
                return {"option": name, "value": [float(each) for each in numbers.groups()]}
        if kind.get("type") in ("number", "integer"):
            try:
                number = float(value)
            except ValueError:
                continue
            return {"option": name,
                    "value": int(number) if kind["type"] == "integer" else number}
    return None
