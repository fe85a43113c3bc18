"""The result of a stage: one model with labelled fields, from which all that shows it comes.

Its values are the entry of the manifest and the output of the command with ``--json``. For Python
users they are typed attributes; terminal, notebook and report show the labelled ones as rows::

    class Count(Result):
        '''Nodes of the skeleton.'''

        node_count: int = shown("nodes", ",")
        radius: float = shown("mean radius", ".2f mm")
        radius_interval: Interval | None = kept("its 95 % interval [m]")
        nodes: np.ndarray = of_files("positions of the nodes [m], shape [n, 3]")

:func:`shown` has a label, :func:`kept` none, :func:`of_files` is no value but an array or object
that :meth:`Result.of_folder` reads from the stage's files. In JSON the name of a value ends with
its unit, here ``radius_m``. One that may be missing is declared with ``| None``. Values that no
field declares are kept too. A stage names the model as ``About(..., result=Count)``.
"""

import functools
import html
import importlib
import io
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Self, get_args

import numpy as np
from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PlainSerializer,
    PrivateAttr,
    model_validator,
)

from limber.core.errors import InputError
from limber.core.files.reading import checked_as
from limber.core.json_values import number_array, plain
from limber.core.optional import require_extra
from limber.core.units import BESIDE, SCALES, text_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from limber.results.report.section import Section
    from limber.store import Branch

_MOST_PRINTED = 7  # values printed in one line; the notebook's table shows all


def frozen(values: Any) -> np.ndarray:
    """A copy that cannot be written to; JSON's null is NaN."""
    made = np.array(values, float)
    made.setflags(write=False)
    return made


def _numbers(count: int | None, values: Any) -> np.ndarray:
    held = number_array(values, gaps=True)
    if held.ndim != 1 or not len(held) or len(held) != (count or len(held)):
        raise ValueError(f"{count or 'some'} numbers were expected")
    return frozen(held)


def _array_of(count: int | None) -> tuple[BeforeValidator, PlainSerializer]:
    return BeforeValidator(functools.partial(_numbers, count)), PlainSerializer(plain)


Numbers = Annotated[np.ndarray, *_array_of(None)]
"""At least one number; JSON's null is NaN."""
Interval = Annotated[np.ndarray, *_array_of(2)]
"""Lower and upper end, NaN where open."""
Vector = Annotated[np.ndarray, *_array_of(3)]


@dataclass(frozen=True)
class _Label:
    """How a field is shown; attributes as of :func:`shown`."""

    title: str
    form: str
    interval: str
    of: Callable[[Any], Any] | None
    unless_zero: bool

    @property
    def unit(self) -> str:
        return self.form.partition(" ")[2]

    @property
    def heading(self) -> str:
        """The title with the unit; percent stand with the value."""
        return f"{self.title} [{self.unit}]" if self.unit not in BESIDE else self.title

    def text(self, value: Any) -> str:
        return text_of(value, self.form)

    def between(self, ends: Any) -> str:
        if ends is None or not np.isfinite(ends).all():
            return "not known"
        return " to ".join(map(self.text, ends))


def shown(title: str, form: str = "", *, interval: str = "", of: Callable[[Any], Any] | None = None,
          unless_zero: bool = False, meaning: str = "") -> Any:
    """Return the field of a value that is shown.

    Args:
        title: What it is, shortly.
        form: Its digits and unit, such as ".1f mm"; its value is in SI units.
        interval: The field with its 95 % interval; without it ``NAME_interval``, if there is one.
        of: The number that is shown of a vector or list.
        unless_zero: Not to show it if it is zero.
        meaning: What it is for the documentation; without it the title, with the SI unit.
    """
    unit = form.partition(" ")[2]
    si = SCALES.get(unit, (unit, 1))[0]
    extra: Any = {"label": _Label(title, form, interval, of, unless_zero)}
    return Field(None, description=meaning or (f"{title} [{si}]" if si else title),
                 json_schema_extra=extra)


def kept(meaning: str) -> Any:
    """Return the field of a value that is only read by its name."""
    return Field(None, description=meaning)


def of_files(meaning: str) -> Any:
    """Return the field of what :meth:`Result.of_folder` reads; it is no value of the result."""
    return Field(None, exclude=True, description=meaning)


def _key(name: str, meaning: str) -> str:
    """The name of a value in JSON: the attribute's with the unit of its meaning."""
    unit = re.search(r"\[([^\]]+)\]", meaning)
    return f"{name}_{_UNIT_NAMES.sub(_unit_name, unit[1].lower())}" if unit else name


def _unit_name(found: re.Match[str]) -> str:
    return {"/": "_", "%": "percent"}.get(found[0], "")


_UNIT_NAMES = re.compile(r"[ ^/%]")


Table = tuple[str, list[list[str]]]
"""A title, and rows of which the first is the header."""


def filled(*tables: Table) -> list[Table]:
    return [(title, rows) for title, rows in tables if rows]


@dataclass(frozen=True)
class Picture:
    """A figure of a result.

    Attributes:
        function: Draws it: module and name below ``limber.results.report``.
        caption: Below the figure in the report.
        arguments: The result's attributes that the function takes.
    """

    function: str
    caption: str
    arguments: tuple[str, ...]

    def drawn(self, result: "Result") -> "Figure":
        """Draw it."""
        module, _, name = self.function.rpartition(".")
        draw = getattr(importlib.import_module(f"limber.results.report.{module}"), name)
        return draw(*(getattr(result, each) for each in self.arguments))


POSE = "x_m y_m z_m rx_rad ry_rad rz_rad"
FORCE = "fx_n fy_n fz_n"


class Result(BaseModel):
    """Result of a stage: frozen, in SI units; it prints, and becomes rows, a table or a figure.

    Attributes:
        values: The output of its command with ``--json``; the names contain the units.

    >>> limber.open("a.branch").results["reconstruct"].values["watertight"]
    True
    """

    model_config = ConfigDict(frozen=True, extra="allow", arbitrary_types_allowed=True,
                              allow_inf_nan=False)

    heading: ClassVar[str] = ""
    """Title of its section in the report; {name} is that of the entry. Empty: none."""
    missing: ClassVar[str] = ""
    """The command that would make it, for a report that says what is not there yet."""
    pictures: ClassVar[tuple[Picture, ...]] = ()
    columns: ClassVar[Mapping[str, str]] = {}
    """Attributes that its table shows, each with the names of its columns."""
    keys: ClassVar[Mapping[str, str]] = {}
    """Names of values in JSON that are not those of their attributes with the unit."""
    _keys: ClassVar[Mapping[str, str]] = {}
    _values: Mapping[str, Any] = PrivateAttr(default_factory=lambda: MappingProxyType({}))

    @classmethod
    def __pydantic_init_subclass__(cls, **_options: Any) -> None:
        told = [f"        {name}: {meaning[:1].upper()}{meaning[1:]}.\n" for name, field
                in cls.model_fields.items() if (meaning := field.description)]
        cls._keys = {**cls.keys} | {_key(name, field.description or ""): name for name, field
                                in cls.model_fields.items() if not field.exclude}
        cls.__doc__ = "".join([f"{cls.__doc__}\n    Attributes:\n", *told])

    @model_validator(mode="before")
    @classmethod
    def _by_attribute(cls, values: Any) -> Any:
        if not isinstance(values, Mapping):
            return values
        of_files = {name for name, field in cls.model_fields.items() if field.exclude}
        return {cls._keys.get(key, key): value for key, value in values.items()
                if key not in of_files}

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> Self:
        """Return the result of a command's output, without its files."""
        made = cls.model_validate({**values})
        made._values = MappingProxyType({**values})
        return made

    @classmethod
    def read(cls, branch: "Branch | None", key: str, values: Mapping[str, Any]) -> Self:
        """Return the result of an entry ``key`` of a branch's manifest, including its files.

        Raises:
            InputError: the values or a file are damaged.
        """
        place = Path("the output")
        if branch is not None:
            place, values = cls.content(branch, key, values)
        made = checked_as(place, cls, {**values}, f"the result of {key}")
        made._values = MappingProxyType({**values})
        if branch is not None:
            for name, value in made.of_folder(branch, key).items():
                object.__setattr__(made, name, value)
        for name, field in cls.model_fields.items():
            if getattr(made, name) is None and not (
                    field.exclude or type(None) in get_args(field.annotation)):
                raise InputError(f"{place}: the result of {key} has no {name}.", "It is damaged, "
                                 "or was written by another program.", "Make it again.")
        return made

    @classmethod
    def content(cls, branch: "Branch", key: str, values: Mapping[str, Any],
                ) -> tuple[Path, Mapping[str, Any]]:
        """Return the file with all values of the result, and the values: the manifest's."""
        return branch.folder / "branch.json", values

    def of_folder(self, branch: "Branch", key: str) -> dict[str, Any]:
        """Return the fields that the branch's files have, by name."""
        return {}

    @property
    def values(self) -> Mapping[str, Any]:
        """The output of its command with ``--json``, in SI units that the names contain."""
        return self._values

    @property
    def warnings(self) -> tuple[str, ...]:
        """The warnings of the stage."""
        return tuple(self.values.get("warnings", ()))

    def _labelled(self) -> Iterator[tuple[_Label, str, str]]:
        """Each shown field: its label, value and interval."""
        for name, field in type(self).model_fields.items():
            value, extra = getattr(self, name), field.json_schema_extra
            if isinstance(value, Result):
                yield from value._labelled()
            if value is None or not isinstance(extra, dict):
                continue
            label: Any = extra["label"]
            value = label.of(value) if label.of else value
            if label.unless_zero and not value:
                continue
            interval = label.interval or f"{name}_interval"
            has_interval = interval in type(self).model_fields
            ends = getattr(self, interval) if has_interval else None
            if isinstance(value, np.ndarray):
                yield label, "; ".join(
                    f"{label.text(each)} ({label.between(pair)})" if has_interval
                    else label.text(each) for each, pair in zip(
                        value, value if ends is None else ends, strict=True)), ""
            else:
                yield label, label.text(value), label.between(ends) if has_interval else ""

    def rows(self) -> list[list[str]]:
        """Return the labelled values as a table: quantity, value and 95 % interval."""
        rows = [[label.heading, value, between] for label, value, between in self._labelled()]
        return [["quantity", "value", "95 % interval"], *rows] if any(
            row[2] for row in rows) else [["quantity", "value"], *(row[:2] for row in rows)]

    def against(self, other: Self, titles: Sequence[str],
                remarks: Mapping[str, str] = MappingProxyType({})) -> list[list[str]]:
        """Return the labelled values of this and the ``other`` as a table below ``titles``, with
        the change in percent, and, if there are any, with ``remarks`` by field."""
        rows, notes = [["measure", *titles, "change"]], ["beyond reach"]
        for name, field in type(self).model_fields.items():
            before, after = getattr(self, name), getattr(other, name)
            extra = field.json_schema_extra
            if before is None or after is None or not isinstance(extra, dict):
                continue
            label: Any = extra["label"]
            rows.append([label.heading, label.text(before), label.text(after),
                         f"{100 * (after / before - 1):+.1f} %" if before else "-"])
            notes.append(remarks.get(name, ""))
        return [[*row, note] for row, note in zip(rows, notes, strict=True)] if any(
            notes[1:]) else rows

    def sentences(self, branch: "Branch") -> list[str]:
        """Return what was found, for the report's first section and the end of a command."""
        return []

    def section(self, branch: "Branch", key: str) -> "Section | None":
        """Return its section in the report, None without: its rows and its figure."""
        from limber.results.report.section import Section

        if not self.heading:
            return None
        rows = self.rows()
        section = Section(self.heading.format(name=key.partition(":")[2]), tables=[
            *([("", rows)] if len(rows) > 1 else []), *self.tables()])
        self.illustrate(section, branch, key)
        return section

    def tables(self) -> list[Table]:
        """Return tables that terminal and report show beside the rows: titles and rows."""
        return []

    def illustrate(self, section: "Section", branch: "Branch", key: str) -> None:
        """Add texts, tables and figures to its section: its pictures."""
        for picture in self.pictures:
            try:
                section.draw(picture.drawn(self), picture.caption)
            except InputError as error:
                section.text.append(f"It cannot be drawn: {error}")

    def plot(self) -> "Figure":
        """Draw what the report shows of it first.

        Raises:
            InputError: there is no picture of it, or a file is damaged.
        """
        if not self.pictures:
            raise InputError(f"There is no picture of {type(self).__name__}.", "", "")
        return drawn(lambda: self.pictures[0].drawn(self))

    def table(self) -> dict[str, np.ndarray]:
        """Return columns by name, as ``pandas.DataFrame(...)`` takes them; units in the names."""
        return {name: column for attribute, names in self.columns.items() for name, column in zip(
            names.split(), np.atleast_2d(getattr(self, attribute).T), strict=True)}

    def _shown(self) -> dict[str, str]:
        """The printed values, by label."""
        found = {label.title: f"{value}{f' ({between})' if between else ''}"
                 f"{f' {label.unit}' if label.unit not in BESIDE else ''}"
                 for label, value, between in self._labelled()}
        return found or {name: f"{value:.4g}" if isinstance(value, float) else str(value)
                         for name, value in self.values.items()
                         if isinstance(value, bool | int | float)}

    def __str__(self) -> str:
        return repr(self)

    def __repr__(self) -> str:
        parts = [f"{label} {text}" for label, text in self._shown().items()]
        if len(parts) > _MOST_PRINTED:
            parts[_MOST_PRINTED:] = ["..."]
        return f"{type(self).__name__}({', '.join(parts)})"

    def _repr_html_(self) -> str:
        rows = "".join(f"<tr><td>{html.escape(label)}</td><td>{html.escape(text)}</td></tr>"
                       for label, text in self._shown().items())
        return f"<table><caption>{type(self).__name__}</caption>{rows}</table>"


class Written(Result):
    """A written file.

    >>> limber.open("a.branch").export("a.swc").path.suffix
    '.swc'
    """

    keys = dict.fromkeys(("report", "scene", "output"), "path")
    path: Path | None = shown("path")


def drawn(draw: "Callable[[], Figure]") -> "Figure":
    """Draw a figure that a notebook shows once, regardless of its figure settings."""
    require_extra("report", ("matplotlib",), "A picture")
    import matplotlib.pyplot as plt

    figure = draw()
    # An open figure is shown when the cell ends, and again as the value of the cell.
    plt.close(figure)
    vars(figure)["_repr_png_"] = functools.partial(_png, figure)
    return figure


def _png(figure: "Figure") -> bytes:
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=100, bbox_inches="tight")
    return stream.getvalue()
