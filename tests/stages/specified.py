"""Stages with what only Python sets, for tests and benchmarks."""

from limber.estimation.settings import FitSpec, PullSpec
from limber.stages.moduli.estimate import EstimateYoung
from limber.stages.pulls.virtual_pull import VirtualPull


class Fit(FitSpec, EstimateYoung):
    """An estimate."""


class SpecifiedPull(PullSpec, VirtualPull):
    """A simulated pull."""
