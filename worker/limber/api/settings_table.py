"""The settings of a verb: their defaults and meanings."""

import html
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from limber.api.running import stage_of
from limber.core.errors import InputError
from limber.core.settings import nearest


def settings(verb: str) -> "SettingsTable":
    """Return the settings of a verb, or of a command, with their defaults and meanings.

    Raises:
        InputError: there is no such verb.

    >>> limber.settings("plan")["max_force"]
    Setting(meaning='Largest force of the gripper at any pose [N].', default=None)
    """
    from limber.cli.known import command_class

    stage = command_class(known_stage(verb))
    return SettingsTable(verb, {
        name: Setting(field.description or "",
                      "required" if field.is_required() else field.default)
        for name in stage.names() if name != "branch_folder"
        for field in [stage.model_fields[name]]})


@dataclass(frozen=True)
class Setting:
    """A setting of a verb.

    Attributes:
        meaning: With its unit in square brackets.
        default: Or ``required``.
    """

    meaning: str
    default: Any


class SettingsTable(Mapping[str, Setting]):
    """The settings of a verb by name; it prints as a list, and as a table in a notebook."""

    def __init__(self, verb: str, content: Mapping[str, Setting]):
        self._verb, self._content = verb, MappingProxyType({**content})

    def __getitem__(self, name: str) -> Setting:
        return self._content[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._content)

    def __len__(self) -> int:
        return len(self._content)

    def __repr__(self) -> str:
        return "\n".join([f"Settings of {self._verb}:", *(
            f"  {name} = {one.default!r}: {one.meaning}" for name, one in self.items())])

    def _repr_html_(self) -> str:
        rows = "".join(f"<tr><td><code>{name}</code></td><td>{html.escape(repr(one.default))}</td>"
                       f"<td>{html.escape(one.meaning)}</td></tr>" for name, one in self.items())
        return (f"<table><caption>{html.escape(self._verb)}</caption>"
                f"<tr><th>setting</th><th>default</th><th>meaning</th></tr>{rows}</table>")


def known_stage(verb: str) -> str:
    """Return the name of a verb's command.

    Raises:
        InputError: there is none.
    """
    from limber.cli.known import command_names

    name, known = stage_of(verb), command_names()
    if name not in known:
        raise InputError(f"There is no stage {verb!r}.", nearest(name, known))
    return name
