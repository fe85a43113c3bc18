"""User settings: the common base of their models, and errors on refused values.

A model is the single source of an option's name, type, range, default and help. It also defines its
position in ``--help``, in the JSON schema and in the add-on's panel, and its record in a manifest.
The description of a value states its unit in square brackets.
"""

import difflib
import math
import re
import shlex
from collections.abc import Callable, Sequence
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self, TypeVar, get_args

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    ValidationError,
    ValidationInfo,
    field_validator,
)
from pydantic_core import core_schema

from limber.core.errors import InputError, Option, Text
from limber.core.json_values import refusal_of, validated
from limber.core.units import in_unit

Model = TypeVar("Model", bound=BaseModel)

def _with_length(vector: tuple[float, float, float]) -> tuple[float, float, float]:
    length = math.hypot(*vector)
    if not 1e-9 < length < math.inf:
        raise ValueError("a direction must not be zero")
    return vector


Direction = Annotated[tuple[float, float, float], AfterValidator(_with_length)]
"""A direction: three numbers, not all 0; of any length."""


POSITION: dict[str, Any] = {"frame": "branch"}
"""Extra of a field whose position a stage also takes in the scan's coordinates."""
BOX: dict[str, Any] = {"frame": "branch axes"}
"""Extra of a field whose box has the axes of the branch's frame."""


YOUNG_PA, DENSITY_KG_M3 = (1e3, 1e11), (50.0, 3000.0)
MOST_FORCE_N = 1e5
"""Plausible ranges of the properties and loads of a branch or of a model of one."""


def possible_young(entered: Any) -> Any:
    """Validate one Young's modulus [Pa], several or None; ValueError names the likely mistake."""
    for value in _numbers(entered):
        if not YOUNG_PA[0] <= value <= YOUNG_PA[1]:
            likely = f"; for {value:g} GPa write {value:g}e9" if 1e-2 <= value < 1e3 else ""
            raise ValueError("it is in Pa, and that of a branch is between 1 kPa and 100 GPa"
                             + likely)
    return entered


def possible_density(entered: Any) -> Any:
    """Validate a density [kg/m^3] or None, likewise."""
    for value in _numbers(entered):
        if not DENSITY_KG_M3[0] <= value <= DENSITY_KG_M3[1]:
            likely = f"; for {value:g} g/cm^3 write {1000 * value:g}" if 0.05 <= value <= 3 else ""
            raise ValueError("it is in kg/m^3, and that of a branch is between 50 and 3000"
                             + likely)
    return entered


def possible_time(value: str | None) -> str | None:
    """Accept a date, or a date with a time of day (ISO 8601)."""
    if value is not None:
        try:
            datetime.fromisoformat(value)
        except ValueError as error:
            raise ValueError(f"{value!r} is no date such as 2026-05-01 or 2026-05-01T14:00"
                             ) from error
    return value


def possible_force(entered: Any) -> Any:
    """Validate a force [N], its components or None, likewise."""
    for value in _numbers(entered):
        if abs(value) > MOST_FORCE_N:
            raise ValueError(f"it is in N, and no branch bears {value:g} N; for {value:g} mN write "
                             f"{value / 1000:g}")
    return entered


def _numbers(value: Any) -> tuple[float, ...]:
    return () if value is None else value if isinstance(value, tuple) else (value,)


def within(*limits: tuple[float, float]) -> AfterValidator:
    """Return what validates each number of a vector (or None) by its least and greatest value."""
    def check(values: Any) -> Any:
        for value, (low, high) in zip(_numbers(values), limits, strict=False):
            if not low <= value <= high:
                raise ValueError(f"{value:g} is not between {low:g} and {high:g}")
        return values
    return AfterValidator(check)


class OneOf:
    """Annotates a text that is one of a registry's names, which are looked up when needed, or
    None."""

    def __init__(self, names: Callable[[], tuple[str, ...]]):
        self.names = names

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        return core_schema.no_info_after_validator_function(self._known, handler(source))

    def __get_pydantic_json_schema__(self, schema: Any, handler: Any) -> dict[str, Any]:
        made = handler(schema)
        return {**made, "enum": [*self.names(), *([None] if "anyOf" in made else [])]}

    def _known(self, name: str | None) -> str | None:
        if name is not None and name not in self.names():
            raise ValueError(f"it must be one of {', '.join(self.names())}")
        return name


GraspMode = Annotated[Literal["rigid", "point"], BeforeValidator(
    lambda mode: {"clamped": "rigid", "pinned": "point"}.get(str(mode), mode))]
"""Rigid (clamped): position and rotation of a piece are held; point (pinned): only its mean
position."""

Groups = dict[str, tuple[str, ...]]
"""Titles, each with the names of the fields below it."""

_UNIT = re.compile(r"\[([^\[\]]+)\]")


class Settings(BaseModel):
    """Base of all settings and inputs: frozen, and refusing unknown names.

    Attributes:
        groups: Titles, each with the names of the fields below it; a derived model adds to those of
            its bases.
        common: Fields that ``--help`` shows besides required ones: those that most users choose.
            ``--help-all`` shows the others too.
        results_version: Increased when the same settings on the same input give other results than
            before. Branches then count as out of date, and a batch runs the stage again.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    groups: ClassVar[Groups] = {}
    common: ClassVar[tuple[str, ...]] = ()
    results_version: ClassVar[int] = 1

    @classmethod
    def of(cls, settings: "Settings", **more: Any) -> Self:
        """Return these settings as another model that knows them, with further values."""
        return settings if isinstance(settings, cls) and not more else cls(**{
            name: getattr(settings, name) for name in settings.model_fields_set
            if name in cls.model_fields} | more)

    @field_validator("*", mode="before")
    @classmethod
    def _in_its_unit(cls, value: Any, info: ValidationInfo) -> Any:
        """Take a number with a unit, such as "2.5 mm", in the unit that the description states."""
        field = cls.model_fields[str(info.field_name)]
        return in_unit(value, _unit(field.description)) if _is_number(field.annotation) else value

    @classmethod
    def group_of(cls, name: str) -> str:
        """Return the title that a field belongs to."""
        if group := _extra(cls, name).get("group"):
            return group
        for base in cls.__mro__:
            for title, names in vars(base).get("groups", {}).items():
                if name in names:
                    return title
        return "options"

    @classmethod
    def is_expert(cls, name: str) -> bool:
        """Whether a field is shown on demand only."""
        return not (cls.model_fields[name].is_required() or _extra(cls, name).get("common") or any(
            name in vars(base).get("common", ()) for base in cls.__mro__))

    @classmethod
    def __get_pydantic_json_schema__(cls, core_schema: Any, handler: Any) -> dict[str, Any]:
        schema = handler.resolve_ref_schema(handler(core_schema))
        for name, content in schema.get("properties", {}).items():
            content["title"] = name.replace("_", " ").capitalize()
            content["group"] = cls.group_of(name)
            content["expert"] = cls.is_expert(name)
            if unit := _unit(content.get("description")):
                content["unit"] = unit
        return schema


def _unit(description: str | None) -> str:
    found = _UNIT.search(description or "")
    return found.group(1) if found else ""


def _is_number(annotation: Any) -> bool:
    """Whether a field takes a number, or several, and no free text."""
    parts = get_args(annotation)
    return annotation in (int, float) or (str not in parts and any(map(_is_number, parts)))


def _extra(model: type[BaseModel], name: str) -> dict[str, Any]:
    extra = model.model_fields[name].json_schema_extra if name in model.model_fields else None
    return extra if isinstance(extra, dict) else {}


def nearest(name: str, known: Sequence[str]) -> str:
    """Return the sentence that names the known names closest to an unknown one."""
    close = difflib.get_close_matches(name, known, 3)
    return f"Did you mean {' or '.join(close)}?" if close else f"Known: {', '.join(known)}."


def checked_settings(model: type[Model], values: dict[str, Any]) -> Model:
    """Return ``model(**values)``; a refused value becomes an :class:`InputError` that names it."""
    try:
        return validated(model, values)
    except ValidationError as error:
        raise _refusal(model, values, error) from error


def _refusal(model: type[BaseModel], values: dict[str, Any], error: ValidationError) -> InputError:
    missing = [str(one["loc"][0]) for one in error.errors()
               if one["type"] == "missing" and len(one["loc"]) == 1]
    if missing:
        return _missing(model, values, missing)
    first = error.errors()[0]
    message = refusal_of(first)
    if not first["loc"]:
        # It concerns several values, and names them.
        return InputError(Text(message, "."), "", "See the options' help.")
    given = first.get("input")
    # A number is a text where it was typed, but not to who typed it.
    typed = given if isinstance(given, str) and re.fullmatch(r"[-+.\d]\S*", given) else repr(given)
    return InputError(Text(Option(str(first["loc"][0])), f" {typed}: ", message, "."),
                      "The stage cannot use this value.",
                      "See the option's help for its range.")


def _missing(model: type[BaseModel], values: dict[str, Any], names: list[str]) -> InputError:
    """State which options are missing, explain each, and propose values."""
    stem = next((value.resolve().stem for value in values.values() if isinstance(value, Path)),
                "NAME")
    seen, meant, proposed = [], [], []
    for name in names:
        field, extra = model.model_fields[name], _extra(model, name)
        short = str(extra["short"]) if "short" in extra else Option(name)
        seen.append(Text(short, " (", Option(name), ")") if "short" in extra else short)
        meant.append(Text(short, f": {field.description}") if len(names) > 1
                     else field.description or "")
        proposed.append(Text(short, " ", shlex.quote(
            str(extra.get("example", name.upper())).format(stem=stem))))
    what = "option" if len(names) == 1 else "options"
    return InputError(Text(f"Missing {what} ", Text.joined(" and ", seen), "."),
                      Text.joined(" ", meant), "Add, for example: ", Text.joined(" ", proposed))
