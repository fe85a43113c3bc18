"""The results of the verbs: frozen, with units; they print, draw and become tables.

Arrays are read-only. ``table()`` gives columns by name, as ``pandas.DataFrame(...)`` takes them;
``plot()`` gives a figure of matplotlib, which a notebook shows and ``savefig`` writes.
"""

from collections.abc import Mapping
from typing import Any

from limber.api.motion_results import Load, Simulation
from limber.api.path_results import EnergyField, Execution, Plan
from limber.api.pull_results import Estimate, Pull
from limber.api.result import Result
from limber.store import Branch as Folder

_KINDS: dict[str, type[Result]] = {
    "energy": EnergyField, "estimate": Estimate, "execute": Execution, "load": Load,
    "plan": Plan, "pull": Pull, "record": Pull, "replay": Simulation, "simulate": Simulation}


def read_result(branch: Folder, key: str, values: Mapping[str, Any]) -> Result:
    """Return the typed result of an entry of a branch's manifest.

    Args:
        key: The entry's name, such as ``plan:to-light``.
        values: The stage's result.
    """
    return _KINDS.get(key.partition(":")[0], Result).read(branch, key, values)


