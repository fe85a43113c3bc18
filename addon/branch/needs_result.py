"""Requirements of an operator of a branch: an opened result, or a branch folder."""

from pathlib import Path
from typing import Any

import bpy

from ..jobs import jobs
from . import branch_folder, branches


def is_open(operator: type, thing: bpy.types.Object | None) -> bool:
    """Return whether the scene has ``thing``; if not, the button states what to do."""
    if thing is None:
        operator.poll_message_set("Open a result first")
    return thing is not None


def branch_property() -> Any:
    """Return the property of an operator that states the branch of its button."""
    return bpy.props.StringProperty(
        name="Branch", options={"HIDDEN", "SKIP_SAVE"},
        description="UUID of the branch that is meant. Empty: the current one")


def needed_folder(scene: bpy.types.Scene, uuid: str = "") -> Path:
    """Return the folder of the branch with a UUID, by default of the current one, for work in it.

    A folder that a job is about to make will do.

    Raises:
        ValueError: there is none, or the folder has another branch than the one that is shown.
    """
    if uuid and branches.current_uuid(scene) not in ("", uuid):
        # Another branch has become the current one since the button was drawn.
        meant = branches.shown_with(scene, uuid)
        if len(meant) != 1:
            raise ValueError("The branch that was meant is no longer in the scene. Choose a branch "
                             "in the panel Branch, then press the button again.")
        folder = _there(Path(bpy.path.abspath(meant[0][branches.FOLDER_KEY])))
    else:
        folder = folder_to_open(scene)
    check_identity(scene, folder, uuid)
    return folder


def folder_to_open(scene: bpy.types.Scene) -> Path:
    """Return the folder of the current branch, whichever branch it has by now.

    Raises:
        ValueError: there is none.
    """
    folder = branches.current_folder(scene)
    if folder is None:
        raise ValueError("This scene has no branch folder. Choose a branch folder with Open "
                         "Result in the panel Branch, or enter its path under Folder there.")
    return _there(folder)


def _there(folder: Path) -> Path:
    if not (folder / branch_folder.MANIFEST).is_file() and not jobs.works_in(str(folder)):
        raise ValueError(f"{folder} has no file {branch_folder.MANIFEST}. Choose a branch folder "
                         "under Folder in the panel Branch. If the folder was moved, use Find the "
                         "Folder Again there.")
    return folder


def check_identity(scene: bpy.types.Scene, folder: Path, uuid: str = "") -> None:
    """Refuse a folder with another branch than the intended one, or than the one shown from it.

    Raises:
        ValueError: it is another branch; the folder must not be written to.
    """
    shown = branches.shown_from(scene, folder)
    meant = uuid or ("" if shown is None else shown.get(branches.UUID_KEY, ""))
    record = branch_folder.read_record(folder)
    if meant and record is not None and record.uuid not in ("", meant):
        raise ValueError(f"{folder} has another branch now than the one that is shown. Press Open "
                         "Result to show that one, or use Find the Folder Again in the panel "
                         "Branch.")


class NeedsBranch:
    """Mix-in: needs a branch in the scene."""

    @classmethod
    def poll(cls, context):
        return is_open(cls, branches.find_surface(context.scene))


class NeedsBranchInObjectMode:
    """Mix-in: needs a branch in the scene, and no object in Edit Mode."""

    @classmethod
    def poll(cls, context):
        return is_open(cls, branches.find_surface(context.scene)) and context.mode == "OBJECT"


class NeedsSkeleton:
    """Mix-in: needs a skeleton in the scene."""

    @classmethod
    def poll(cls, context):
        return is_open(cls, branches.find_skeleton(context.scene))
