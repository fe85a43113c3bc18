"""What an operator of an opened result needs before it can be pressed."""

import bpy

from .. import branches


def is_open(operator: type, thing: bpy.types.Object | None) -> bool:
    """Return whether the scene has ``thing``; where not, the button says what to do."""
    if thing is None:
        operator.poll_message_set("Open a result first")
    return thing is not None


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
