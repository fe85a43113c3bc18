"""Gentle paths: energy field over grasp poses, goals, limits, planners.

Positions for the grasp within a branch's reach:

>>> import numpy as np
>>> from limber.planning import sample_positions
>>> from limber.planning.field.grasp_model import Reach
>>> from limber.planning.field.sampling import LowEnergySurface
>>> reach = Reach(np.zeros(3), arc_length=0.5, chord=0.48, tip=np.array([0, 0, 0.6]))
>>> shell = LowEnergySurface(np.array([0, 0, 0.1]), radius=0.38)
>>> sample_positions(reach, np.array([0, 0, 0.48]), 32, shell, deflection=0.4).shape
(32, 3)
"""

from limber.core.optional import exports

_PLACES = {
    "EnergyField": "field.energy_field",
    "EnergySettings": "settings",
    "EnergySpec": "settings",
    "Goal": "goals.goal",
    "GraspModel": "field.grasp_model",
    "PlanSettings": "settings",
    "PlanSpec": "settings",
    "PlannedMotion": "make_plan",
    "States": "field.stored_states",
    "fit_field": "field.energy_field",
    "grasp_model_of": "field.grasp_model",
    "plan_motion": "make_plan",
    "sample_field": "field.sampling",
    "sample_positions": "field.sampling",
}

__getattr__, __dir__ = exports(__name__, _PLACES)
__all__ = list(_PLACES)
