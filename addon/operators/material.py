"""Take over the numbers of a known material."""

from typing import ClassVar

import bpy

from ..materials_known import MATERIALS, SOURCE


class LIMBER_OT_material(bpy.types.Operator):
    bl_idname = "limber.material"
    bl_label = "Material"
    bl_description = (f"Set Young's modulus to start from, density and strength. {SOURCE}")
    bl_options: ClassVar = {"REGISTER", "UNDO"}

    material: bpy.props.EnumProperty(name="Material", items=[
        (name, known.title, f"E {known.young / 1e9:g} GPa, strength {known.strength / 1e6:g} MPa, "
                            f"{known.density:g} kg/m³") for name, known in MATERIALS.items()])

    def execute(self, context):
        known, settings = MATERIALS[self.material], context.scene.limber
        settings.reconstruct.young, settings.reconstruct.density = known.young, known.density
        settings.scene.strength, settings.scene.use_strength = known.strength, True
        self.report({"INFO"}, f"{known.title}: reconstruct again to use it. {SOURCE}")
        return {"FINISHED"}


def register() -> None:
    bpy.utils.register_class(LIMBER_OT_material)


def unregister() -> None:
    bpy.utils.unregister_class(LIMBER_OT_material)
