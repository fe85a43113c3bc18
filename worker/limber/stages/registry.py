"""The registry of stages: the single source of commands, options, schemas and job tables.

A stage is a module that assigns ``STAGE = StageDescription("name", ...)``: below this folder, in
another package that names it under the entry points ``limber.stages``, or given to
:func:`register`. Its docstring is the command's help; ``limber --help`` shows the first line. The
names are found without importing a stage, so that ``limber --help`` imports no heavy package.
"""

import ast
import importlib
import importlib.metadata
import importlib.util
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, Literal

from limber.core.errors import InputError
from limber.core.progress import Progress

if TYPE_CHECKING:
    from limber.core.settings import Settings
    from limber.stages.result import Result
    from limber.store import Branch

FORMAT = 1
"""Format version of the schemas that :func:`all_schemas` returns."""


@dataclass(frozen=True)
class StageDescription:
    """Description of a stage, read by everything that needs to know the stage.

    Attributes:
        name: Name of the command.
        position: Its position in ``limber --help``, in the order in which stages run.
        run: Called with inputs, settings, options of the run and progress; returns the result.
        inputs: Files, folders and names: source and target.
        settings: What the result depends on beside the inputs; the manifest records them.
        options: Options of the run, which do not change the result.
        result: What it returns; None: values without labels.
        key: Key of its entry in the manifest; ``{name}`` is replaced by that input or setting.
            Empty: it makes none.
        reads: Names of the branch folder's files that it reads; ``{name}`` as in ``key``.
        writes: Names of the files that it writes.
        found: Lines of findings, which :func:`limber.cli.terminal.found_lines` fills from inputs,
            settings and result; without any, the whole result is shown.
        then: The usual next command, its names and paths filled in likewise.
        step: Its panel in the add-on (:data:`addon.steps.STEPS`); empty: none.
        label: Label of its button there.
        moves_robot: Whether it moves a robot; batches then do not run it.
    """

    name: str
    position: int
    run: "Callable[[Any, Any, Any, Progress], dict[str, Any]]"
    inputs: "type[Settings]"
    settings: "type[Settings]"
    options: "type[Settings]"
    result: "type[Result] | None" = None
    key: str = ""
    reads: tuple[str, ...] = ()
    writes: tuple[str, ...] = ()
    found: "Sequence[str | Callable[[Mapping[str, Any]], str | None]]" = ()
    then: str = ""
    step: str = ""
    label: str = ""
    moves_robot: Literal["", "when armed", "always"] = ""

    def models(self, values: Mapping[str, Any]) -> "tuple[Settings, Settings, Settings]":
        """Return inputs, settings and options from values by name; each name is in only one.

        Raises:
            InputError: a name is unknown, an input is missing, or a value is refused.
        """
        from limber.core.errors import InputError
        from limber.core.settings import checked_settings, nearest

        kinds = (self.inputs, self.settings, self.options)
        known = [name for kind in kinds for name in kind.model_fields]
        for name in values:
            if name not in known:
                raise InputError(f"{self.name} has no {name!r}.", nearest(name, known))
        inputs, settings, options = (
            checked_settings(kind, {name: value for name, value in values.items()
                                    if name in kind.model_fields})
            for kind in kinds)
        return inputs, settings, options

    def entry(self, inputs: "Settings", settings: "Settings") -> str:
        """Return the name of the manifest's entry for these models; empty if there is none."""
        name = getattr(inputs, "name", None) or getattr(settings, "name", None) or ""
        return self.key.replace("{name}", name)


_registered: list[ModuleType] = []


def register(module: ModuleType) -> None:
    """Add a module's ``STAGE`` in this process; entry points add it in all."""
    _registered.append(module)
    _stages.cache_clear()


@cache
def _stages() -> dict[str, tuple[str, str]]:
    """Return the module and the summary of each stage, in the order in which they run."""
    found = {(module.STAGE.position, module.STAGE.name, _summary(module.__doc__), module.__name__)
             for module in _registered} | {*_in_files()}
    stages: dict[str, tuple[str, str]] = {}
    for _position, name, summary, module in sorted(found):
        if name in stages:
            raise InputError(f"Two modules make a stage {name}: {stages[name][0]} and {module}.",
                             "", "Uninstall the package of one of them.")
        stages[name] = (module, summary)
    return stages


def _in_files() -> Iterator[tuple[int, str, str, str]]:
    """Position, name, summary and module of the stages in this folder and in other packages."""
    folder = Path(__file__).parent
    for path in folder.rglob("*.py"):
        if about := _described(path):
            yield *about, ".".join((__package__, *path.relative_to(folder).with_suffix("").parts))
    for entry in importlib.metadata.entry_points(group="limber.stages"):
        try:
            spec = importlib.util.find_spec(entry.module)
        except ImportError:
            spec = None
        about = _described(Path(spec.origin)) if spec and spec.origin else None
        if about is None:
            raise InputError(f"The stage {entry.name} should be in {entry.module}, which is not "
                             "there or assigns no STAGE.", "",
                             "Install its package again, or uninstall it.")
        yield *about, entry.module


def _described(path: Path) -> tuple[int, str, str] | None:
    """Return position, name and summary of the stage in a file; None if it has none."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in tree.body:
        if (isinstance(node, ast.Assign) and isinstance(node.value, ast.Call)
                and getattr(node.targets[0], "id", "") == "STAGE"):
            name, position = (ast.literal_eval(part) for part in node.value.args[:2])
            return position, name, _summary(ast.get_docstring(tree))
    return None


def _summary(docstring: str | None) -> str:
    return (docstring or "").split("\n\n")[0].replace("\n", " ")


def stage_summaries() -> dict[str, str]:
    """Return what each stage does in one line, by name, in the order in which they run."""
    return {name: summary for name, (_module, summary) in _stages().items()}


def stage_module(name: str) -> Any:
    """Return the module of a stage."""
    return importlib.import_module(_stages()[name][0])


def stage_description(name: str) -> StageDescription:
    """Return the description of a stage.

    Raises:
        KeyError: there is no such stage.
    """
    if name not in stage_summaries():
        raise KeyError(name)
    return stage_module(name).STAGE


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
    stages = map(stage_description, stage_summaries())
    # Where two stages make the same entry, it is of the one that it is named after.
    kinds: dict[str, type[Result]] = {}
    for stage in stages:
        word = stage.key.partition(":")[0]
        if stage.result and (stage.name == word or word not in stage_summaries()):
            kinds[word] = stage.result
    return kinds | ({"replay": kinds["simulate"]} if "simulate" in kinds else {})


def stage_schema(name: str) -> dict[str, Any]:
    """Return what a program needs to know to run a stage, as plain JSON.

    ``inputs``, ``settings`` and ``options`` are JSON schemas. Their properties also have ``group``
    (their title), ``expert`` and possibly ``unit``; ``panel`` is false if no panel may store it. An
    input with ``argument`` is given without its name; ``short`` is its short option.
    """
    stage = stage_description(name)
    return {
        "name": name, "summary": stage_summaries()[name], "key": stage.key,
        "reads": list(stage.reads), "writes": list(stage.writes),
        "step": stage.step, "label": stage.label, "moves_robot": stage.moves_robot,
        "inputs": stage.inputs.model_json_schema(),
        "settings": stage.settings.model_json_schema(),
        "options": stage.options.model_json_schema()}


def all_schemas() -> dict[str, Any]:
    """Return the schemas of all stages by name, the format's version, the presets of species and
    sensors, and the largest size [m] without a question about the unit.
    """
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
