"""The registry: every stage described whole, its schema and command line round trips."""

import inspect
import json

import click
import pytest

from limber.cli import main
from limber.stages.command_line import command_line
from limber.stages.inputs import PlacedInputs
from limber.stages.registry import (
    all_schemas,
    stage_description,
    stage_module,
    stage_schema,
    stage_summaries,
)

NAMES = list(stage_summaries())

# Values other than the defaults, of every kind of field.
OTHERS = {
    "reconstruct": ({"cloud": "scan.ply", "output": "a.branch", "mask": "m.png"},
                    {"up": (0.0, -1.0, 0.0), "upright": False, "unit": "mm", "young": 2.5e8,
                     "plants": "largest", "gap_factor": 4.0}),
    "simulate": ({"branch_folder": "a.branch"},
                 {"move": (-0.1, 0.0, 1e-3), "gravity": False, "kind": "static",
                  "load_at": ((0.0, 0.0, 0.1, 1.0, -2.0, 0.5), (0.0, 0.0, 0.2, 0.0, 0.0, -1.0))}),
    "estimate": ({"branch_folder": "-odd.branch"},
                 {"pull": ("one", "two"), "fractions": (0.25, 0.75), "quick": True}),
}


def parsed(name, arguments):
    """Return the inputs, settings and options that a command line gives a stage."""
    seen = []

    def run(*given):
        seen.extend(given[:3])
        return {}
    stage = stage_description(name)
    caught = type(stage)(**{**vars(stage), "run": run, "result": None, "found": ()})
    command = main.command_of(caught, stage_module(name).__doc__)
    with pytest.raises(SystemExit) as stop:
        command.main(arguments, standalone_mode=False)
    assert stop.value.code == 0
    return seen


def sample(name):
    """Return inputs, settings and options of a stage with values that are no defaults."""
    stage = stage_description(name)
    given, settings = OTHERS.get(name, ({}, {}))
    required = {field: f"some-{field}" for field, about in stage.inputs.model_fields.items()
                if about.is_required()}
    return (stage.inputs(**(required | given)), stage.settings(**settings),
            stage.options(**({"force": True} if "force" in stage.options.model_fields else {})))


@pytest.mark.parametrize("name", NAMES)
def test_command_line_round_trip(name):
    """Inputs, settings and options become a command line that gives them back."""
    models = sample(name)
    assert parsed(name, command_line(*models)) == list(models)


@pytest.mark.parametrize("name", NAMES)
def test_schema_round_trip(name):
    """The schema is plain JSON, its defaults give the defaults, and dumped settings come back."""
    schema = json.loads(json.dumps(stage_schema(name), allow_nan=False))
    stage = stage_description(name)
    for part, model in zip(("settings", "options"), sample(name)[1:], strict=True):
        kind = type(model)
        defaults = {field: about["default"]
                    for field, about in schema[part]["properties"].items()}
        assert kind.model_validate(defaults) == kind()
        assert kind.model_validate_json(model.model_dump_json()) == model
    assert set(schema["inputs"]["properties"]) == set(stage.inputs.model_fields)


@pytest.mark.parametrize("name", NAMES)
def test_description_is_whole(name):
    """A stage's name is its file's; all that is grouped exists, and all is grouped and told."""
    stage = stage_description(name)
    assert stage.name == name
    assert stage_summaries()[name].endswith(".")
    fields: set[str] = set()
    for model in (stage.inputs, stage.settings, stage.options):
        for base in model.__mro__:
            named = {field for names in vars(base).get("groups", {}).values() for field in names}
            assert named | set(vars(base).get("common", ())) <= set(
                getattr(base, "model_fields", {}))
        for field, about in model.model_json_schema().get("properties", {}).items():
            assert about["description"], field
            assert about["group"] != "options", field
        assert not fields & set(model.model_fields)
        fields |= set(model.model_fields)
    for place in (stage.key, *stage.reads, *stage.writes):
        assert "{name}" not in place or "name" in fields


def test_stages_pass_over_none_of_their_fields():
    """The functions that are called by name take every input, setting and option."""
    by_name = {}
    for name in NAMES:
        stage = stage_description(name)
        taken = inspect.getclosurevars(stage.run).nonlocals.get("taken")
        if taken is None:
            continue
        by_name[name] = {*taken.values()}
        lacking = {field for part in ("inputs", "settings", "options")
                   if part not in by_name[name]
                   for field in getattr(stage, part).model_fields} - by_name[name]
        # by_name itself moves the positions.
        lacking -= {*PlacedInputs.model_fields} if issubclass(stage.inputs, PlacedInputs) else {*()}
        assert not lacking, name
    assert len(by_name) > 10


def test_units_and_experts_are_in_the_schema():
    """A panel finds units, titles, groups and what only experts are shown."""
    properties = stage_schema("simulate")["settings"]["properties"]
    assert properties["young"]["unit"] == "Pa"
    assert properties["damping_mass"]["expert"] and not properties["young"]["expert"]
    assert properties["damping_mass"] | {"title": "Damping mass", "group": "material"} == (
        properties["damping_mass"])


def test_help_shows_what_most_users_choose(capsys):
    """--help leaves other options out and says so; --help-all has them."""
    assert main.call(["simulate", "--help"]) == 0
    short = capsys.readouterr().out
    assert "--damping-mass" not in short and "--help-all" in short and "Material:" in short
    assert main.call(["simulate", "--help-all"]) == 0
    assert "--damping-mass" in capsys.readouterr().out


def test_help_shows_at_most_ten_options():
    for name in NAMES:
        assert sum(not about["expert"] for part in ("inputs", "settings", "options")
                   for about in stage_schema(name)[part].get("properties", {}).values()) <= 10


def test_schema_commands_print_json(capsys):
    """`limber schema` has what `limber STAGE --schema` has of each stage."""
    def printed(*arguments):
        assert main.call([*arguments]) == 0
        return json.loads(capsys.readouterr().out)
    told = printed("schema")
    assert told == json.loads(json.dumps(all_schemas()))
    assert told["stages"]["plan"] == printed("plan", "--schema")


def test_a_file_is_a_stage(tmp_path, monkeypatch):
    """A file in stages/ is all that a new stage takes: it is listed, and its command runs."""
    from limber.stages import registry

    (tmp_path / "probe.py").write_text(
        '"""Looks at something.\n\nMore."""\n'
        'STAGE = StageDescription("probe", 5, run, Inputs, Settings, Options)\n')
    monkeypatch.setattr(registry, "__file__", str(tmp_path / "registry.py"))
    registry._stages.cache_clear()
    try:
        assert registry.stage_summaries() == {"probe": "Looks at something."}
        assert "probe" in main.main.list_commands(click.Context(main.main))
    finally:
        monkeypatch.undo()
        registry._stages.cache_clear()
