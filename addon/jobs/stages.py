"""Settings of the worker's stages, from ``stages.json``: the source of panels and settings.

``limber schema`` writes that file (``scripts/make_addon_schema``), so that the add-on knows every
setting without a worker. ``LIMBER_STAGES`` names another file, if the worker has stages of other
packages. No bpy here.
"""

import json
import os
import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

FORMAT = 1
_FILE = Path(os.environ.get("LIMBER_STAGES") or Path(__file__).parents[1] / "stages.json")


class SettingError(ValueError):
    """The worker would reject a value; states which one and what to give."""


@dataclass(frozen=True)
class Field:
    """One input, setting or option of a stage.

    Attributes:
        name: Name on the command line, with ``_``.
        kind: ``boolean``, ``integer``, ``number``, ``string``, ``path``, ``choice``, ``vector``
            (``length`` numbers), ``list`` (any number of texts or numbers) or ``rows`` (any number
            of vectors, ``length`` numbers each).
        title: Displayed title, without the unit.
        description: The tooltip.
        group: Title of its group.
        unit: Unit of its value, or empty.
        default: Value as in JSON; None if it may be left open.
        is_required: It has no default.
        is_optional: It may be left open.
        is_argument: Given on the command line without its name.
        is_expert: Shown on demand only.
        is_kept: False if no panel keeps it: it is typed each time, or has its own button.
        choices: Values of a choice.
        least, most: Bounds of a number, or None; ``is_open`` states that ``least`` itself is
        excluded.
        length: Length of a vector.
        word: What a vector may be instead of its numbers, or empty.
    """

    name: str
    kind: str
    title: str
    description: str
    group: str
    unit: str = ""
    default: Any = None
    is_required: bool = False
    is_optional: bool = False
    is_argument: bool = False
    is_expert: bool = False
    is_kept: bool = True
    choices: tuple[str, ...] = ()
    least: float | None = None
    most: float | None = None
    is_open: bool = False
    length: int = 0
    word: str = ""

    @property
    def label(self) -> str:
        """The title with the unit."""
        return f"{self.title} [{self.unit}]" if self.unit else self.title

    def about(self, choice: str) -> str:
        """Return what the description says of a choice, where it has the form "choice: text"; else
        all of it.
        """
        names = "|".join(re.escape(name) for name in (*self.choices, *([self.word] * bool(
            self.word))))
        parts = re.split(rf"(?:^|(?<=[.;:,] ))({names}): ", self.description)
        told = dict(zip(parts[1::2], parts[2::2], strict=True))
        return told.get(choice, self.description).rstrip(" ;,")

    def typed(self, value: Any) -> list[str]:
        """Return ``value`` as options of a command line; SettingError if it is invalid."""
        flag = "--" + self.name.replace("_", "-")
        if self.kind == "boolean":
            return [flag if value else f"--no-{flag[2:]}"]
        if self.word and value == self.word:
            return [flag, value]
        if self.kind == "vector":
            return [flag, *map(number_text, value)]
        if self.kind == "rows":
            return [text for row in rows_of(self, value) for text in (flag, *map(number_text, row))]
        if self.kind == "list":
            return [flag, ",".join(_items(value))]
        return [flag, number_text(value) if self.kind == "number" else str(value)]

    def is_default(self, value: Any) -> bool:
        """Whether ``value``, in Blender's single precision, is the default."""
        if self.kind in ("vector", "number") and value is not None and self.default is not None:
            return np.array_equal(np.asarray(value, np.float32),
                                  np.asarray(self.default, np.float32))
        if self.kind == "rows":
            return rows_of(self, value) == self.default
        if self.kind == "list":
            return _items(value) == [number_text(item) if isinstance(item, float) else str(item)
                                     for item in self.default]
        if self.kind in ("path", "string") and self.default is None:
            return not value
        return value == self.default

    def shown(self, value: Any) -> Any:
        """Return ``value``, as in JSON, in a panel's form: lists are text."""
        if self.kind == "rows":
            return "; ".join(" ".join(map(number_text, row)) for row in value)
        if self.kind == "list":
            return ", ".join(number_text(item) if isinstance(item, float) else str(item)
                             for item in value)
        return value


@dataclass(frozen=True)
class Stage:
    """A stage of the worker: its fields by name, and the files it reads and writes.

    ``step`` names its panel (empty: it has none), ``label`` is the text of its button,
    ``moves_robot`` is whether it moves the robot: ``always``, ``when armed`` or empty.
    """

    name: str
    summary: str
    key: str
    reads: tuple[str, ...]
    writes: tuple[str, ...]
    fields: dict[str, Field]
    settings: frozenset[str]
    step: str
    label: str
    moves_robot: str

    @property
    def makes_branch(self) -> bool:
        """Whether it makes a branch folder; all other stages work in one."""
        return "branch_folder" not in self.fields

    @property
    def own_fields(self) -> list[Field]:
        """The fields of its panel: all but the branch folder, which the scene provides."""
        folder = "output" if self.makes_branch else "branch_folder"
        return [field for field in self.fields.values() if field.is_kept and field.name != folder]

    def keeps_entry(self, values: Mapping[str, Any]) -> bool:
        """Whether the branch folder keeps the result of a run with these values."""
        is_dry_run = self.moves_robot == "when armed"
        return bool(self.key) and not is_dry_run and (
            "{name}" not in self.key or bool(values.get("name")))

    def groups(self) -> dict[str, list[Field]]:
        """Return the panel's fields by the title of their group, in the worker's order."""
        found: dict[str, list[Field]] = {}
        for field in self.own_fields:
            found.setdefault(field.group, []).append(field)
        return found

    def arguments(self, values: Mapping[str, Any], stated: Collection[str] = ()) -> list[str]:
        """Return the command line that gives the stage these values.

        Defaults are omitted, except of the fields in ``stated``. Fields missing in ``values`` keep
        the worker's default.

        Raises:
            SettingError: a required value is missing, or a text is not a list as required.
        """
        options: list[str] = []
        arguments: list[str] = []
        for field in self.fields.values():
            if field.name not in values and not field.is_required:
                continue
            value = values.get(field.name)
            if field.is_required and not value:
                raise SettingError(f"{field.title} is missing: {field.description}")
            if field.is_argument:
                arguments.append(str(value))
            elif value is not None and (field.name in stated or not field.is_default(value)):
                options += field.typed(value)
        return [self.name, *options, "--", *arguments]


@cache
def stages() -> dict[str, Stage]:
    """Return the stages by name, in the order in which they run.

    Raises:
        RuntimeError: the file is of another version than this add-on.
    """
    return {name: _stage(name, told) for name, told in _content()["stages"].items()}


def species() -> dict[str, Any]:
    """Return the species presets: ``source``, and ``presets`` by name, with ``title``, ``young``
    and ``strength`` [Pa], and ``density`` [kg/m^3], which may be None.
    """
    return _content()["species"]


def sensors(stage: str) -> dict[str, Any]:
    """Return the sensor presets of a stage by name: ``title``, ``source`` and ``settings``."""
    return {name: known for name, known in _content()["sensors"].items()
            if known["stage"] == stage}


def longest_m() -> float:
    """Return the largest size of a plant [m] of which the unit is not asked."""
    return _content()["longest_m"]


@cache
def _content() -> dict[str, Any]:
    content = json.loads(_FILE.read_text(encoding="utf-8"))
    if content.get("format") != FORMAT:
        raise RuntimeError(f"{_FILE.name} has format {content.get('format')}, but this add-on "
                           f"reads format {FORMAT}. Install the add-on again.")
    return content


def number_text(value: Any) -> str:
    """Return a number as short as its single precision allows: 0.1, not 0.10000000149; 6e+07."""
    if isinstance(value, int):
        return str(value)
    number = float(str(np.float32(value)))
    short = f"{number:.6g}"
    return short if len(short) < len(str(number)) - 2 and float(short) == number else str(number)


def _stage(name: str, told: dict[str, Any]) -> Stage:
    fields = {}
    for part in ("inputs", "settings", "options"):
        required = told[part].get("required", [])
        for field, about in told[part].get("properties", {}).items():
            fields[field] = _field(field, about, is_required=field in required)
    return Stage(name, told["summary"], told["key"], tuple(told["reads"]), tuple(told["writes"]),
                 fields, frozenset(told["settings"].get("properties", {})),
                 told["step"], told["label"], told["moves_robot"])


def _field(name: str, about: dict[str, Any], *, is_required: bool) -> Field:
    kinds = [kind for kind in about.get("anyOf", [about]) if kind.get("type") != "null"]
    kind = kinds[0]
    least = kind.get("minimum", kind.get("exclusiveMinimum"))
    return Field(
        name, _kind(kind), about["title"], about.get("description", ""), about["group"],
        unit=about.get("unit", ""), default=about.get("default"), is_required=is_required,
        is_optional=not is_required and about.get("default") is None,
        is_argument=about.get("argument", False), is_expert=about["expert"],
        is_kept=about.get("panel", True),
        choices=tuple(kind.get("enum", ())), least=least,
        most=kind.get("maximum", kind.get("exclusiveMaximum")),
        is_open="exclusiveMinimum" in kind,
        length=len((kind.get("items", kind) if kind["type"] == "array" else {}).get(
            "prefixItems", ())),
        word=next((other["const"] for other in kinds[1:] if "const" in other), ""))


def _kind(about: dict[str, Any]) -> str:
    if "enum" in about:
        return "choice"
    if about["type"] == "array":
        if "prefixItems" in about:
            return "vector"
        return "rows" if about["items"].get("type") == "array" else "list"
    return "path" if about.get("format") == "path" else about["type"]


def _items(text: str) -> list[str]:
    return [part.strip() for part in text.split(",") if part.strip()]


def rows_of(field: Field, text: str) -> list[list[float]]:
    """Return the rows of numbers that a panel keeps as text; SettingError if it is invalid."""
    try:
        rows = [[float(part) for part in row.split()] for row in text.split(";") if row.strip()]
    except ValueError as error:
        raise SettingError(f"{field.title}: {error}. {_ROWS_HELP}") from error
    if any(len(row) != field.length for row in rows):
        raise SettingError(f"{field.title} needs {field.length} numbers per group. {_ROWS_HELP}")
    return rows


_ROWS_HELP = "Separate numbers by spaces, and groups by semicolons."
