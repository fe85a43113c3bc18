"""Mechanics of a branch: finite elements, statics, dynamics, sensitivities."""

from limber.mechanics.dynamics.simulate import DynamicResult, NewmarkSettings, simulate_dynamics
from limber.mechanics.grasp import Grasp
from limber.mechanics.materials import Material, RayleighDamping
from limber.mechanics.model import BranchModel, PointMass
from limber.mechanics.sensitivities import (
    ParameterSet,
    StaticSensitivities,
    static_sensitivities,
)
from limber.mechanics.statics.solve import StaticResult, StaticSettings, follow_poses, solve_static
from limber.mechanics.young_field import young_weights

__all__ = [
    "BranchModel", "DynamicResult", "Grasp", "Material", "NewmarkSettings", "ParameterSet",
    "PointMass", "RayleighDamping", "StaticResult", "StaticSensitivities", "StaticSettings",
    "follow_poses", "simulate_dynamics", "solve_static", "static_sensitivities", "young_weights",
]
