"""Ask the worker for its version and what it lacks."""

import json

import bpy

from .. import preferences
from .worker_operator import WorkerOperator


class LIMBER_OT_check_worker(WorkerOperator, bpy.types.Operator):
    """Start the worker and show its version and any missing packages"""

    bl_idname = "limber.check_worker"
    bl_label = "Check the Worker"
    title = "Checking the worker"
    is_next = True

    def arguments(self, context):
        return ["doctor"]

    def finish(self, context, result):
        missing = ", ".join(result.get("missing", [])) or "nothing"
        status = f"Python {result['python']} on {result['system']}\nMissing: {missing}"
        chosen = preferences.get(context)
        if chosen is not None:
            chosen.worker_status = status
            chosen.worker_parts = json.dumps(result.get("packages", {}))
        self.report({"INFO"}, status.replace("\n", ". "))


CLASSES = (LIMBER_OT_check_worker,)
