"""How a solve in statics or dynamics ended."""

from enum import StrEnum


class Status(StrEnum):
    """Each is its own text, for files and messages; only a converged result is valid.

    converged: a stable equilibrium, or all frames of a motion, with no element inverted.
    stalled: step control gave up.
    torn: stretched over the limit.
    inverted: an element would turn inside out.
    unstable: in balance, but it would not stay there.
    false_equilibrium: stable, but not the one that small steps from rest lead to.
    """

    converged = "converged"
    stalled = "stalled"
    torn = "torn"
    inverted = "inverted"
    unstable = "unstable"
    false_equilibrium = "false_equilibrium"
