"""Take over the numbers of a preset: of a species, or of a sensor."""

from typing import ClassVar

import bpy

from .. import properties
from .stages import Field, sensors, species, stages

_SOURCE = species()["source"]
_KNOWN = {name: known for name, known in species()["presets"].items() if known["density"]}
SENSED = ("reconstruct", "import-pull")
"""Stages that read what a sensor has recorded."""
_SENSORS = {name: known for stage in SENSED for name, known in sensors(stage).items()}


class LIMBER_OT_material(bpy.types.Operator):
    bl_idname = "limber.material"
    bl_label = "Material"
    bl_description = (f"Set the initial Young's modulus, the density and the strength. {_SOURCE}")
    bl_options: ClassVar = {"REGISTER", "UNDO"}

    material: bpy.props.EnumProperty(name="Material", items=[
        (name, known["title"], f"E {known['young'] / 1e9:g} GPa, strength "
                               f"{known['strength'] / 1e6:g} MPa, {known['density']:g} kg/m³")
        for name, known in _KNOWN.items()])

    def execute(self, context):
        known, settings = _KNOWN[self.material], context.scene.limber
        settings.reconstruct.young, settings.reconstruct.use_young = known["young"], True
        settings.reconstruct.density = known["density"]
        settings.scene.strength, settings.scene.use_strength = known["strength"], True
        self.report({"INFO"}, f"{known['title']} is set. Reconstruct again to use it. {_SOURCE}")
        return {"FINISHED"}


class LIMBER_OT_sensor(bpy.types.Operator):
    """Set how the files of this sensor are read, or how noisy it is"""

    bl_idname = "limber.sensor"
    bl_label = "Sensor"
    bl_options: ClassVar = {"REGISTER", "UNDO"}

    sensor: bpy.props.EnumProperty(name="Sensor", items=[
        (name, known["title"], known["source"]) for name, known in _SENSORS.items()])

    @classmethod
    def description(cls, context, given):
        known = _SENSORS[given.sensor]
        return f"{_words(known)}. {known['source']}"

    def execute(self, context):
        known = _SENSORS[self.sensor]
        stage = stages()[known["stage"]]
        # What only other sensors decide has its default again.
        before = dict.fromkeys(name for each in sensors(stage.name).values()
                               for name in each["settings"])
        properties.take_over(properties.group_of(context.scene, stage), stage,
                             before | known["settings"])
        self.report({"INFO"}, f"{_words(known)}. {known['source']}")
        return {"FINISHED"}


class _SensorMenu:
    """Mix-in: the sensors of ``stage``."""

    bl_label = "Sensors"
    stage = ""

    def draw(self, context):
        for name, known in sensors(self.stage).items():
            self.layout.operator("limber.sensor", text=known["title"]).sensor = name


def sensor_menu(stage: str) -> str:
    """Return the name of the menu of a stage's sensors."""
    return f"LIMBER_MT_sensors_{properties.attribute_name(stage)}"


def _words(known: dict) -> str:
    """Return what a sensor's preset sets."""
    fields = stages()[known["stage"]].fields
    return ", ".join(f"{fields[name].title} {_value(fields[name], value)}".rstrip()
                     for name, value in known["settings"].items())


def _value(field: Field, value) -> str:
    numbers = value if isinstance(value, list) else [value]
    return " ".join([*(f"{each:g}" if isinstance(each, float) else str(each) for each in numbers),
                     field.unit])


CLASSES = (LIMBER_OT_material, LIMBER_OT_sensor, *(
    type(sensor_menu(stage), (_SensorMenu, bpy.types.Menu), {
        "bl_idname": sensor_menu(stage), "stage": stage, "__module__": __name__})
    for stage in SENSED))
