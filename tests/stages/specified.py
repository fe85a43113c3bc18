"""Stages with what only Python sets, for tests and benchmarks."""

from limber.estimation.settings import FitSpec, PullSpec
from limber.mechanics.settings import SimulateSpec
from limber.planning.settings import EnergySpec, PlanSpec
from limber.recordings.settings import ImportSpec
from limber.stages.moduli.estimate import EstimateYoung
from limber.stages.motion.simulate import Simulate
from limber.stages.paths.energy import SampleEnergy
from limber.stages.paths.plan import PlanPaths
from limber.stages.pulls.import_pull import ImportPull
from limber.stages.pulls.virtual_pull import VirtualPull


class Fit(FitSpec, EstimateYoung):
    """An estimate."""


class SpecifiedPull(PullSpec, VirtualPull):
    """A simulated pull."""


class Imported(ImportSpec, ImportPull):
    """An import."""


class Simulated(SimulateSpec, Simulate):
    """A simulation."""


class Sampled(EnergySpec, SampleEnergy):
    """An energy field."""


class Planned(PlanSpec, PlanPaths):
    """A plan."""
