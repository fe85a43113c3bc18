"""The add-on's preferences: which Python has the worker."""

import sys

import bpy

from . import compat, worker


class LimberPreferences(bpy.types.AddonPreferences):
    """Where the worker is."""

    bl_idname = __package__

    python_path: bpy.props.StringProperty(
        name="Python with Limber", subtype="FILE_PATH",
        description="The Python in which Limber's worker is installed, for example "
                    ".venv/bin/python of a checkout. Empty: LIMBER_PYTHON, then `limber` "
                    "on the PATH")
    worker_status: bpy.props.StringProperty(options={"SKIP_SAVE"})

    def draw(self, context):
        layout = self.layout
        layout.prop(self, "python_path")
        layout.operator("limber.check_worker", icon="CHECKMARK")
        for line in self.worker_status.splitlines():
            layout.label(text=line)
        column = layout.column(align=True)
        column.label(text="The worker computes everything.", icon="INFO")
        column.label(text="This version of the extension does not bring it along.", icon="BLANK1")


def get(context: bpy.types.Context | None = None) -> LimberPreferences | None:
    """Return the preferences; None where the add-on runs without being enabled (a script)."""
    addon = (context or bpy.context).preferences.addons.get(__package__)
    return addon.preferences if addon else None


def worker_command() -> list[str]:
    """Return how to start the worker; WorkerNotFound says what to do when there is none."""
    chosen = get()
    fallback = sys.executable if compat.IS_MODULE else ""
    return worker.worker_command(chosen.python_path if chosen else "", fallback)


def register() -> None:
    bpy.utils.register_class(LimberPreferences)


def unregister() -> None:
    bpy.utils.unregister_class(LimberPreferences)
