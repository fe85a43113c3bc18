"""The registry: every stage described whole, its schema and command line round trips."""

import json
from dataclasses import replace

import click
import pytest

from limber.cli import main
from limber.cli.known import command_class, command_names, others
from limber.cli.stage_command import StageCommand
from limber.stages.command_line import command_line
from limber.stages.registry import all_schemas, schema_of, stage_schema, stage_summaries
from limber.stages.stage import Tool

NAMES = list(stage_summaries())
ALL = [name for name in command_names() if not command_class(name).about.prints]

# Values other than the defaults, of every kind of field.
OTHERS = {
    "reconstruct": {"cloud": "scan.ply", "output": "a.branch", "mask": "m.png",
                    "up": (0.0, -1.0, 0.0), "upright": False, "unit": "mm", "young": 2.5e8,
                    "plants": "largest", "gap_factor": 4.0},
    "simulate": {"branch_folder": "a.branch", "move": (-0.1, 0.0, 1e-3), "gravity": False,
                 "kind": "static", "load_at": ((0.0, 0.0, 0.1, 1.0, -2.0, 0.5),
                                               (0.0, 0.0, 0.2, 0.0, 0.0, -1.0))},
    "estimate": {"branch_folder": "-odd.branch", "pull": ("one", "two"),
                 "fractions": (0.25, 0.75), "quick": True},
    "ros gripper": {"position": 0.5, "arm": True},
}


def parsed(name, arguments):
    """Return the stage that a command line makes."""
    seen = []

    class Caught(command_class(name)):
        about = replace(command_class(name).about, result=None, found=())

        def run(self, progress=None):
            seen.append(type(self).__base__(**{field: getattr(self, field)
                                               for field in self.model_fields_set}))
            return {}
    with pytest.raises(SystemExit) as stop:
        StageCommand(Caught).main(arguments, standalone_mode=False)
    assert stop.value.code == 0
    return seen[0]


def sample(name):
    """Return a stage with values that are no defaults."""
    stage = command_class(name)
    required = {field: f"some-{field}" for field, about in stage.model_fields.items()
                if about.is_required()}
    return stage(**(required | OTHERS.get(name, {})
                    | ({"force": True} if "force" in stage.model_fields else {})))


@pytest.mark.parametrize("name", ALL)
def test_command_line_and_json_round_trip(name):
    """A stage becomes a command line, or JSON, that gives it back."""
    stage = sample(name)
    assert parsed(name, command_line(stage)) == stage
    again = command_class(name).checked(json.loads(json.dumps(stage.stated())))
    assert again == stage and again.model_fields_set == stage.model_fields_set


@pytest.mark.parametrize("name", ALL)
def test_schema_round_trip(name):
    """The schema is plain JSON, its defaults give the defaults, and the manifest has the settings.
    """
    schema = json.loads(json.dumps(schema_of(command_class(name)), allow_nan=False))
    stage = sample(name)
    defaults = {field: about["default"] for part in ("inputs", "settings", "options")
                for field, about in schema[part]["properties"].items() if "default" in about}
    needed = {field: getattr(stage, field) for field, about in type(stage).model_fields.items()
              if about.is_required()}
    assert type(stage).model_validate(needed | defaults) == type(stage)(**needed)
    assert list(stage.model_dump()) == list(schema["settings"]["properties"])
    assert {part: list(schema[part]["properties"]) for part in stage.parts()} == stage.parts()


@pytest.mark.parametrize("name", ALL)
def test_description_is_whole(name):
    """A stage's name is its file's; all that is grouped exists, and all is grouped and told."""
    stage = command_class(name)
    assert stage.about.name == name
    assert schema_of(stage)["summary"].endswith(".")
    for base in stage.__mro__:
        named = {field for names in vars(base).get("groups", {}).values() for field in names}
        assert named | set(vars(base).get("common", ())) <= set(getattr(base, "model_fields", {}))
    for field, about in stage.model_json_schema()["properties"].items():
        assert about["description"], field
        assert about["group"] != "options" or issubclass(stage, Tool), field
    for place in (stage.about.key, *stage.about.reads, *stage.about.writes):
        assert "{name}" not in place or "name" in stage.model_fields


def test_units_and_experts_are_in_the_schema():
    """A panel finds units, titles, groups and what only experts are shown."""
    properties = stage_schema("simulate")["settings"]["properties"]
    assert properties["young"]["unit"] == "Pa"
    assert properties["damping"]["expert"] and not properties["young"]["expert"]
    assert properties["damping"] | {"title": "Damping", "group": "material"} == (
        properties["damping"])


def test_help_shows_what_most_users_choose(capsys):
    """--help leaves other options out and says so; --help-all has them."""
    assert main.call(["simulate", "--help"]) == 0
    short = capsys.readouterr().out
    assert "--damping" not in short and "--help-all" in short and "Material:" in short
    assert main.call(["simulate", "--help-all"]) == 0
    assert "--damping" in capsys.readouterr().out


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
    told = printed("schema", "commands")
    assert list(told) == list(others()) and told["cache"] == printed("cache", "--schema")


def test_a_file_is_a_stage(tmp_path, monkeypatch):
    """A file in stages/ is all that a new stage takes: it is listed, and its command runs."""
    from limber.stages import registry

    (tmp_path / "probe.py").write_text(
        'class Probe(Stage):\n    """Looks at something.\n\n    More."""\n'
        '    about = About("probe", 5)\n')
    monkeypatch.setattr(registry, "__file__", str(tmp_path / "registry.py"))
    registry._stages.cache_clear()
    try:
        assert registry.stage_summaries() == {"probe": "Looks at something."}
        assert "probe" in main.main.list_commands(click.Context(main.main))
    finally:
        monkeypatch.undo()
        registry._stages.cache_clear()
