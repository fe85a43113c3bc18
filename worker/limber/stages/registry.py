"""The registry of stages: the single source of commands, options, schemas and job tables.

A stage is a class (:mod:`limber.stages.stage`) in a module below this folder, in one of another
package that names it under the entry points ``limber.stages``, or given to :func:`register`. The
names are found without importing a stage, so that ``limber --help`` imports no heavy package.
"""

import ast
import importlib
import importlib.metadata
import importlib.util
import inspect
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from limber.core.errors import InputError

if TYPE_CHECKING:
    from limber.stages.result import Result
    from limber.stages.stage import Stage
    from limber.store import Branch

FORMAT = 1
"""Format version of the schemas that :func:`all_schemas` returns."""
_MARKS = ("part", "common")


_registered: "list[type[Stage]]" = []


@dataclass(frozen=True, order=True)
class Found:
    """A stage's class, found without importing it: where it is, and what ``--help`` shows."""

    position: int
    name: str
    summary: str
    module: str
    kind: str

    def stage(self) -> "type[Stage]":
        """Import the class."""
        return getattr(importlib.import_module(self.module), self.kind)


def register(stage: "type[Stage]") -> None:
    """Add a stage in this process; entry points add it in all."""
    _registered.append(stage)
    _stages.cache_clear()


@cache
def _stages() -> dict[str, Found]:
    """Return all stages by name, in the order in which they run."""
    stages: dict[str, Found] = {}
    for found in sorted({*_in_files()} | {
            Found(kind.about.position, kind.about.name, first_words(kind.__doc__), kind.__module__,
                  kind.__qualname__) for kind in _registered}):
        if (other := stages.setdefault(found.name, found)) is not found:
            raise InputError(f"Two modules make a stage {found.name}: {other.module} and "
                             f"{found.module}.", "", "Uninstall the package of one of them.")
    return stages


def _in_files() -> Iterator[Found]:
    """Stages in this folder and in other packages."""
    yield from found_in(Path(__file__).parent, __package__)
    for entry in importlib.metadata.entry_points(group="limber.stages"):
        try:
            spec = importlib.util.find_spec(entry.module)
        except ImportError:
            spec = None
        found = [one for one in _described(Path(spec.origin), entry.module)
                 if one.kind == entry.attr] if spec and spec.origin else []
        if not found:
            raise InputError(f"The stage {entry.name} should be in {entry.module}, which is not "
                             f"there or has no class {entry.attr or 'of a stage'}.", "",
                             "Install its package again, or uninstall it.")
        yield from found


def found_in(folder: Path, package: str) -> Iterator[Found]:
    """Return the stages in the files of a package's folder."""
    for path in folder.rglob("*.py"):
        yield from _described(path, ".".join((
            package, *path.relative_to(folder).with_suffix("").parts)))


def _described(path: Path, module: str) -> Iterator[Found]:
    """The stages in a file: classes with ``about = About(NAME, POSITION, ...)``."""
    text = path.read_text(encoding="utf-8")
    for kind in ast.parse(text).body if "About(" in text else ():
        if not isinstance(kind, ast.ClassDef):
            continue
        for node in kind.body:
            if (isinstance(node, ast.Assign) and isinstance(node.value, ast.Call)
                    and getattr(node.targets[0], "id", "") == "about"):
                name, position, *_ = *map(ast.literal_eval, node.value.args[:2]), 0
                yield Found(position, name, first_words(ast.get_docstring(kind)), module, kind.name)


def first_words(docstring: str | None) -> str:
    """Return the first paragraph of a docstring in one line."""
    return inspect.cleandoc(docstring or "").split("\n\n")[0].replace("\n", " ")


def stage_summaries() -> dict[str, str]:
    """Return what each stage does in one line, by name, in the order in which they run."""
    return {name: found.summary for name, found in _stages().items()}


def stage_class(name: str) -> "type[Stage]":
    """Return the class of a stage; KeyError if there is no such stage."""
    found = _stages()[name]
    registered = [kind for kind in _registered if kind.about.name == name]
    return registered[0] if registered else found.stage()


def result_of(branch: "Branch", key: str, values: Mapping[str, Any]) -> "Result":
    """Return the typed result of an entry of a branch's manifest.

    Args:
        key: The entry's name, such as ``plan:to-light``.
        values: The stage's result.

    Raises:
        InputError: the values, or a file that belongs to them, are damaged.
    """
    from limber.stages.result import Result

    return (result_kinds().get(key.partition(":")[0]) or Result).read(branch, key, values)


@cache
def result_kinds() -> "dict[str, type[Result]]":
    """Return the results' models by the first words of the manifest's entries."""
    # Where two stages make the same entry, it is of the one that it is named after.
    kinds: dict[str, type[Result]] = {}
    for about in (stage_class(name).about for name in stage_summaries()):
        word = about.key.partition(":")[0]
        if about.result and (about.name == word or word not in stage_summaries()):
            kinds[word] = about.result
    return kinds | ({"replay": kinds["simulate"]} if "simulate" in kinds else {})


def stage_schema(name: str) -> dict[str, Any]:
    """Return the schema of the stage of this name, as :func:`schema_of` does."""
    return schema_of(stage_class(name))


def schema_of(stage: "type[Stage]") -> dict[str, Any]:
    """Return what a program needs to know to run a stage, as plain JSON.

    ``inputs``, ``settings`` and ``options`` are JSON schemas. Their properties also have ``group``
    (their title), ``expert`` and possibly ``unit``; ``panel`` is false if no panel may store it. An
    input with ``argument`` is given without its name; ``short`` is its short option.
    """
    about, whole = stage.about, stage.model_json_schema()
    fields = {field: {key: value for key, value in content.items() if key not in _MARKS}
              for field, content in whole["properties"].items()}
    return {
        "name": about.name, "summary": first_words(stage.__doc__), "key": about.key,
        "reads": list(about.reads), "writes": list(about.writes),
        "step": about.step, "label": about.label, "moves_robot": about.moves_robot} | {
        part: {"additionalProperties": False,
               "properties": {field: fields[field] for field in names},
               **({"required": needed} if (needed := [
                   field for field in names if field in whole.get("required", ())]) else {}),
               "type": "object"}
        for part, names in stage.parts().items()}


def all_schemas() -> dict[str, Any]:
    """Return the schemas of all stages by name, the format's version, the presets of species and
    sensors, and the largest size [m] without a question about the unit."""
    from limber.geometry.cloud.preparation import LONGEST
    from limber.mechanics.materials.materials import SOURCE, SPECIES
    from limber.recordings.sensor_checks import SENSORS

    return {"format": FORMAT,
            "species": {"source": SOURCE,
                        "presets": {name: asdict(known) for name, known in SPECIES.items()}},
            "longest_m": LONGEST,
            "sensors": {name: asdict(known) for name, known in SENSORS.items()},
            "stages": {name: stage_schema(name) for name in stage_summaries()}}


def stage_table() -> str:
    """Return the Markdown table of stages: the shortest command of each, and its summary."""
    rows = ["| stage | what it does |", "|---|---|"]
    for name, summary in stage_summaries().items():
        words = [f"limber {name}"]
        for field, about in stage_schema(name)["inputs"]["properties"].items():
            if about.get("argument"):
                words.append(field.upper())
            elif "example" in about:
                option = about.get("short") or f"--{field.replace('_', '-')}"
                words.append(f"{option} {about['example'].format(stem='NAME')}")
        rows.append(f"| `{' '.join(words)}` | {summary} |")
    return "\n".join(rows)
