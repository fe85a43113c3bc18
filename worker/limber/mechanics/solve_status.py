"""Status at the end of a static or dynamic solve."""

from enum import StrEnum


class Status(StrEnum):
    """Each value is its own text, for files and messages; only a converged result is valid.

    converged: a stable equilibrium, or all frames of a motion, with no element inverted.
    stalled: step control gave up.
    torn: stretched over the limit.
    inverted: an element would be turned inside out.
    unstable: in equilibrium, but not stable.
    false_equilibrium: stable, but not the equilibrium that small steps from rest lead to.
    """

    converged = "converged"
    stalled = "stalled"
    torn = "torn"
    inverted = "inverted"
    unstable = "unstable"
    false_equilibrium = "false_equilibrium"
