"""The schema that the add-on ships: it is the worker's, and gives the worker's command lines."""

import json

import pytest
from tests.addon.conftest import ADDON, part
from tests.stages.test_registry import NAMES, parsed, sample

from limber.core.json_values import plain
from limber.stages.registry import all_schemas


@pytest.fixture()
def stages(addon):
    return part("jobs.stages").stages()


def test_the_shipped_schema_is_the_workers():
    """Run scripts/make_addon_schema when a stage's settings have changed."""
    shipped = json.loads((ADDON / "stages.json").read_text(encoding="utf-8"))
    assert shipped == json.loads(json.dumps(all_schemas())), "run scripts/make_addon_schema"


def test_every_stage_has_its_place_in_the_add_on(stages):
    """A new stage stands in a step, with a label; `generate` makes no branch, and `scene` draws
    what `limber.open_result` does."""
    steps = {step.name for step in part("jobs.steps").STEPS}
    assert {stage.name for stage in stages.values() if not stage.step} == {"generate", "scene"}
    assert {stage.step for stage in stages.values()} <= {*steps, ""}
    assert all(bool(stage.label) == bool(stage.step) for stage in stages.values())


@pytest.mark.parametrize("name", NAMES)
def test_a_command_line_gives_the_worker_what_the_panel_has(stages, name):
    """Values other than the defaults reach the worker's models as they are."""
    made = sample(name)
    values, stage = plain(dict(made)), stages[name]
    shown = {key: None if value is None else stage.fields[key].shown(value)
             for key, value in values.items()}
    given = parsed(name, stage.arguments(shown)[1:])
    assert plain(dict(given)) == values


@pytest.mark.parametrize("name", NAMES)
def test_defaults_are_the_workers(bpy, registered, stages, name):
    """What a panel shows at first is left out of the command line: the worker's default holds."""
    properties = part("properties")
    stage = stages[name]
    values = properties.values_of(properties.group_of(bpy.context.scene, stage), stage)
    needed = {key: f"some-{key}" for key, field in stage.fields.items() if field.is_required}
    given = stage.arguments(values | needed)
    options = given[1:given.index("--")]
    flags = {f"--{key.replace('_', '-')}" for key in needed}
    assert {text for text in options if text.startswith("--")} <= flags


def test_limits_and_units_are_the_workers(bpy, registered):
    """A number that the worker refuses cannot be set; its unit stands beside its name."""
    group = bpy.context.scene.limber.reconstruct
    about = group.bl_rna.properties
    assert about["density"].name == "Density [kg/m^3]"
    group.poisson = 7.0
    assert group.poisson == 0.5
    assert {item.identifier for item in about["unit"].enum_items} == {"m", "cm", "mm", "in", "um"}


def test_a_text_that_is_no_list_is_refused(stages):
    """Loads are rows of six numbers; anything else is told before a worker is started."""
    stage = stages["simulate"]
    given = {"branch_folder": "a.branch"}
    assert stage.arguments(given | {"load_at": "0 0 1 0 0 -2; 0 0 2 1 0 0"})[1:-2] == [
        "--load-at", *"0.0 0.0 1.0 0.0 0.0 -2.0".split(),
        "--load-at", *"0.0 0.0 2.0 1.0 0.0 0.0".split()]
    for text in ("1 2 3", "a b c d e f"):
        with pytest.raises(ValueError, match="Load at"):
            stage.arguments(given | {"load_at": text})
