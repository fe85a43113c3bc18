"""Mechanics of a branch: finite elements, statics, dynamics, sensitivities.

A 20 cm beam whose end is displaced sideways by 1 cm:

>>> from limber.geometry import straight_beam
>>> from limber.mechanics import BranchModel, Grasp, solve_static
>>> mesh = straight_beam(0.2, 0.004, 0.003, slice_count=6)
>>> model = BranchModel(mesh, young=1e8, poisson=0.35, density=900.0, gravity=None)
>>> grasp = Grasp.from_mesh(mesh, mode="point")
>>> pose = grasp.rest_pose + [0.01, 0, 0, 0, 0, 0]
>>> result = solve_static(model, grasp=grasp, pose=pose).require()
>>> result.converged, bool(result.strain_energy > 0)
(True, True)
"""

from limber.core.optional import exports

_PLACES = {
    "BranchModel": "model",
    "DynamicResult": "dynamics.integration",
    "Grasp": "grasp",
    "MaterialLaw": "materials.laws",
    "EnergyMomentumSettings": "dynamics.motion",
    "NewmarkSettings": "dynamics.motion",
    "ParameterSet": "sensitivities",
    "HungTwig": "added_masses",
    "PointMass": "added_masses",
    "RayleighDamping": "materials.materials",
    "StaticResult": "statics.solve",
    "StaticSensitivities": "sensitivities",
    "StaticSettings": "statics.solve",
    "follow_poses": "statics.solve",
    "simulate_dynamics": "dynamics.integration",
    "solve_static": "statics.solve",
    "static_sensitivities": "sensitivities",
    "unloaded_rest_shape": "statics.rest_shape",
    "register_material": "materials.laws",
    "young_weights": "materials.materials",
}

__getattr__, __dir__ = exports(__name__, _PLACES)
__all__ = list(_PLACES)
