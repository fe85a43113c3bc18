"""What the user chooses in the sidebar, kept in the scene."""

import bpy


class LimberSettings(bpy.types.PropertyGroup):
    """Choices of one scene."""

    cloud_path: bpy.props.StringProperty(
        name="Scan", subtype="FILE_PATH", description="Point cloud of one branch")
    cloud_unit: bpy.props.EnumProperty(
        name="Unit", description="Unit of the scan's coordinates", default="m",
        items=[("m", "Metres", ""), ("cm", "Centimetres", ""), ("mm", "Millimetres", "")])
    branch_folder: bpy.props.StringProperty(
        name="Branch folder", subtype="DIR_PATH",
        description="NAME.branch: where the worker keeps everything about one branch")
    plan: bpy.props.StringProperty(
        name="Plan", description="Name of the path to show; empty: the newest")


def register() -> None:
    bpy.utils.register_class(LimberSettings)
    bpy.types.Scene.limber = bpy.props.PointerProperty(type=LimberSettings)


def unregister() -> None:
    del bpy.types.Scene.limber
    bpy.utils.unregister_class(LimberSettings)
