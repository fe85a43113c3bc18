"""Mechanics of a branch: finite elements, statics, dynamics, sensitivities."""

from limber.mechanics.grasp import Grasp
from limber.mechanics.materials import Material, RayleighDamping
from limber.mechanics.model import BranchModel, PointMass
from limber.mechanics.statics import StaticResult, StaticSettings, follow_poses, solve_static
from limber.mechanics.young_field import young_weights

__all__ = [
    "BranchModel", "Grasp", "Material", "PointMass", "RayleighDamping", "StaticResult",
    "StaticSettings", "follow_poses", "solve_static", "young_weights",
]
