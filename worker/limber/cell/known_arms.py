"""The known arms: those of Universal Robots, any URDF file, and registered arms."""

import functools
from importlib.metadata import entry_points

from limber.cell.arm import Arm
from limber.cell.ur_arms import ARMS
from limber.cell.urdf_arm import arm_of_file, is_file
from limber.core.errors import InputError

_ARMS: dict[str, Arm] = dict(ARMS)


def register_arm(arm: Arm) -> None:
    """Make ``arm`` available to cell files.

    Limber works in several processes. A package with an arm names its module as an entry point of
    the group ``limber.arms``. The module registers the arm, and its driver, when it is imported.

    Raises:
        InputError: another arm has that name.
    """
    if _ARMS.setdefault(_plain(arm.name), arm) is not arm:
        raise InputError(f"An arm named {arm.name!r} is already registered.",
                         "A cell file could not distinguish the two.", "Give it another name.")


def arm_named(name: str) -> Arm:
    """Return the arm called ``name``, in any case and with or without a hyphen, or a URDF file's;
    InputError if unknown, no arm, or if an installed package of arms is incomplete."""
    if is_file(name):
        return arm_of_file(name)
    if _plain(name) not in _ARMS:
        _import_packages()
    arm = _ARMS.get(_plain(name))
    if arm is None:
        known = ", ".join(arm.name for arm in _ARMS.values())
        raise InputError(f"Robot {name!r} is not a known arm; known arms are {known}.",
                         "Its joints and link lengths are needed.",
                         "Give one of them, or the URDF file of another arm.")
    return arm


def _plain(name: str) -> str:
    return name.lower().replace("-", "").replace(" ", "")


@functools.cache
def _import_packages() -> None:
    """Import the arms that installed packages register; InputError if one cannot be imported."""
    for entry in entry_points(group="limber.arms"):
        try:
            entry.load()
        except ImportError as error:
            raise InputError(f"The arm {entry.name!r} from {entry.value} cannot be imported "
                             f"({error}).", "Its package is incomplete.",
                             "Install it again or remove it.") from error
