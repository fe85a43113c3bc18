"""Limber: from the scan of a plant branch to a simulation that behaves like it.

From a scan to a gentle path::

    import limber

    branch = limber.reconstruct("scan.ply", "apple.branch")
    branch.add_pull("pull.csv", "pull-1")
    print(branch.estimate())
    branch.energy_field()
    branch.plan(max_force=3.0).plot()

:mod:`limber.api.verbs` says what all verbs share. ``limber.settings("plan")`` lists what a verb
takes. The command ``limber`` does the same in a terminal, and the Blender add-on (folder
``addon``) on screen. Nothing in this package imports ``bpy``.
"""

from typing import TYPE_CHECKING

from limber.core.lazy import exports as _exports
from limber.core.threads import same_digits as _same_digits
from limber.version import VERSION as __version__

if TYPE_CHECKING:
    from limber.api.branch import Branch as Branch
    from limber.api.motion_results import Load as Load
    from limber.api.motion_results import Simulation as Simulation
    from limber.api.path_results import EnergyField as EnergyField
    from limber.api.path_results import Execution as Execution
    from limber.api.path_results import Plan as Plan
    from limber.api.path_results import Written as Written
    from limber.api.pull_results import Estimate as Estimate
    from limber.api.pull_results import Generated as Generated
    from limber.api.pull_results import Pull as Pull
    from limber.api.result import Result as Result
    from limber.api.settings_table import settings as settings
    from limber.api.verbs import generate as generate
    from limber.api.verbs import mesh as mesh
    from limber.api.verbs import open as open
    from limber.api.verbs import reconstruct as reconstruct

# Before any module of Limber loads a library, in each process: no result may depend on threads.
_same_digits()

_PLACES = {
    "Branch": "api.branch",
    "EnergyField": "api.path_results",
    "Estimate": "api.pull_results",
    "Execution": "api.path_results",
    "Generated": "api.pull_results",
    "Load": "api.motion_results",
    "Plan": "api.path_results",
    "Pull": "api.pull_results",
    "Result": "api.result",
    "Simulation": "api.motion_results",
    "Written": "api.path_results",
    "generate": "api.verbs",
    "mesh": "api.verbs",
    "open": "api.verbs",
    "reconstruct": "api.verbs",
    "settings": "api.settings_table",
}

__getattr__, __dir__ = _exports(__name__, _PLACES)
__all__ = ["__version__"]
__all__ += list(_PLACES)
