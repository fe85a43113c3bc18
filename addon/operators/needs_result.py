"""What an operator of a branch needs before it can run: an opened result, or a branch folder."""

from pathlib import Path

import bpy

from .. import branch_folder, branches, jobs


def is_open(operator: type, thing: bpy.types.Object | None) -> bool:
    """Return whether the scene has ``thing``; if not, the button states what to do."""
    if thing is None:
        operator.poll_message_set("Open a result first")
    return thing is not None


def needed_folder(scene: bpy.types.Scene) -> Path:
    """Return the folder of the current branch; ValueError if there is none.

    One that a job is about to make will do.
    """
    folder = branches.current_folder(scene)
    if folder is None:
        raise ValueError("This scene has no branch folder. Choose a branch folder with Open "
                         "Result in the panel Branch, or enter its path under Folder there.")
    if not (folder / branch_folder.MANIFEST).is_file() and not jobs.works_in(str(folder)):
        raise ValueError(f"{folder} has no file {branch_folder.MANIFEST}. Choose a branch folder "
                         "under Folder in the panel Branch. If the folder was moved, use Find the "
                         "Folder Again there.")
    return folder


class NeedsBranch:
    """Mix-in: needs a branch in the scene."""

    @classmethod
    def poll(cls, context):
        return is_open(cls, branches.find_surface(context.scene))


class NeedsBranchInObjectMode:
    """Mix-in: needs a branch in the scene, and nothing that is being edited."""

    @classmethod
    def poll(cls, context):
        return is_open(cls, branches.find_surface(context.scene)) and context.mode == "OBJECT"


class NeedsSkeleton:
    """Mix-in: needs a skeleton in the scene."""

    @classmethod
    def poll(cls, context):
        return is_open(cls, branches.find_skeleton(context.scene))
