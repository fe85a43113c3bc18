"""Presets of sensors: they set what the stage that reads the sensor's data takes, with a source."""


from types import SimpleNamespace

import pytest
from tests.addon.conftest import part
from tests.addon.test_panels import Layout

from limber.recordings.sensor_checks import SENSORS
from limber.stages.registry import stage_class


@pytest.mark.parametrize("name", SENSORS)
def test_each_is_valid_for_its_stage(name):
    """Of settings that the stage has, other than its defaults, and with a source."""
    preset = SENSORS[name]
    stage = stage_class(preset.stage)
    assert preset.settings.keys() <= {*stage.parts()["settings"]}
    needed = {name: "some" for name, field in stage.model_fields.items() if field.is_required()}
    assert stage.checked(needed | preset.settings)
    assert len(preset.source) > 20


def test_a_camera_of_millimetres(bpy, registered):
    """Its unit, its up and its place are set; undone by the preset of another sensor."""
    settings = bpy.context.scene.limber.reconstruct
    assert bpy.ops.limber.sensor(sensor="azure_kinect") == {"FINISHED"}
    assert (settings.unit, list(settings.up)) == ("mm", [0.0, -1.0, 0.0])
    assert settings.use_camera_at and list(settings.camera_at) == [0.0] * 3
    bpy.ops.limber.sensor(sensor="laser_scanner")
    assert (settings.unit, list(settings.up)) == ("m", [0.0, 0.0, 1.0])
    assert not settings.use_camera_at


def test_up_is_opposite_to_the_axis_that_points_down(bpy, registered):
    """A camera's own frame has y down; the files of RealSense's Viewer are turned upright."""
    settings = bpy.context.scene.limber.reconstruct
    for sensor, up in (("depth_camera", -1.0), ("realsense_ply", 1.0), ("zivid", -1.0),
                       ("kinect_v2", 1.0)):
        bpy.ops.limber.sensor(sensor=sensor)
        assert list(settings.up) == [0.0, up, 0.0] and list(settings.camera_at) == [0.0] * 3


def test_a_force_sensor(bpy, registered):
    """Half of the precision of its data sheet; the torque only where it is known."""
    settings = bpy.context.scene.limber.import_pull
    bpy.ops.limber.sensor(sensor="ur5e")
    assert settings.force_sigma == pytest.approx(1.75)
    assert settings.use_torque_sigma and settings.torque_sigma == pytest.approx(0.1)
    bpy.ops.limber.sensor(sensor="ft300")
    assert settings.force_sigma == pytest.approx(0.6) and not settings.use_torque_sigma


def test_menus_offer_the_sensors_of_their_stage(bpy, registered):
    """Every sensor in one menu, its title as text, its values and source as tooltip."""
    presets = part("jobs.presets")
    offered = {}
    for stage in presets.SENSED:
        menu, layout = getattr(bpy.types, presets.sensor_menu(stage)), Layout()
        menu.draw(SimpleNamespace(layout=layout, stage=stage), bpy.context)
        offered[stage] = [text for _, _, text in layout.calls]
    assert offered == {stage: [known.title for known in SENSORS.values() if known.stage == stage]
                       for stage in presets.SENSED}
    text = presets.LIMBER_OT_sensor.description(bpy.context, SimpleNamespace(sensor="ur5e"))
    assert "1.75 N" in text and "data sheet" in text
