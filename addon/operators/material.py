"""Take over the numbers of a species preset."""

from typing import ClassVar

import bpy

from ..stages import species

_SOURCE = species()["source"]
_KNOWN = {name: known for name, known in species()["presets"].items() if known["density"]}


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
        settings.reconstruct.young, settings.reconstruct.density = known["young"], known["density"]
        settings.scene.strength, settings.scene.use_strength = known["strength"], True
        self.report({"INFO"}, f"{known['title']} is set. Reconstruct again to use it. {_SOURCE}")
        return {"FINISHED"}


def register() -> None:
    bpy.utils.register_class(LIMBER_OT_material)


def unregister() -> None:
    bpy.utils.unregister_class(LIMBER_OT_material)
