"""Limber: from the scan of a plant branch to a simulation that behaves like it.

From a scan to a gentle path::

    import limber

    branch = limber.reconstruct("scan.ply", "apple.branch")
    branch.add_pull("pull.csv", "pull-1")
    print(branch.estimate())
    branch.energy_field()
    branch.plan(max_force=3.0).plot()

:mod:`limber.api.branch` says what all verbs share. ``limber.settings("plan")`` lists what a verb
takes. The command ``limber`` does the same in a terminal, and the Blender add-on (folder
``addon``) on screen. Nothing in this package imports ``bpy``.
"""

from typing import TYPE_CHECKING

from limber.core.optional import exports as _exports
from limber.core.threads import same_digits as _same_digits
from limber.version import VERSION as __version__

if TYPE_CHECKING:
    from limber.api.branch import Branch as Branch
    from limber.api.branch import generate as generate
    from limber.api.branch import mesh as mesh
    from limber.api.branch import open as open
    from limber.api.branch import reconstruct as reconstruct
    from limber.api.branch import run as run
    from limber.api.branch import settings as settings
    from limber.stages.moduli.estimate import Estimate as Estimate
    from limber.stages.motion.load import Load as Load
    from limber.stages.motion.simulate import Simulation as Simulation
    from limber.stages.paths.energy import EnergyField as EnergyField
    from limber.stages.paths.execute import Execution as Execution
    from limber.stages.paths.plan import Plan as Plan
    from limber.stages.pulls.import_pull import Pull as Pull
    from limber.stages.result import Result as Result
    from limber.stages.result import Written as Written
    from limber.stages.shape.generate import Generated as Generated

# Before any module of Limber loads a library, in each process: no result may depend on threads.
_same_digits()

_PLACES = {
    "Branch": "api.branch",
    "EnergyField": "stages.paths.energy",
    "Estimate": "stages.moduli.estimate",
    "Execution": "stages.paths.execute",
    "Generated": "stages.shape.generate",
    "Load": "stages.motion.load",
    "Plan": "stages.paths.plan",
    "Pull": "stages.pulls.import_pull",
    "Result": "stages.result",
    "Simulation": "stages.motion.simulate",
    "Written": "stages.result",
    "generate": "api.branch",
    "mesh": "api.branch",
    "open": "api.branch",
    "reconstruct": "api.branch",
    "run": "api.branch",
    "settings": "api.branch",
}

__getattr__, __dir__ = _exports(__name__, _PLACES)
__all__ = ["__version__"]
__all__ += list(_PLACES)
