"""Gentle paths: energy field over grasp poses, goals, limits, planners.

Positions for the grasp within a branch's reach:

>>> import numpy as np
>>> from limber.planning import sample_positions
>>> from limber.planning.grasp_model import Reach
>>> reach = Reach(np.zeros(3), arc_length=0.5, chord=0.48, tip=np.array([0, 0, 0.6]))
>>> sample_positions(reach, np.array([0, 0, 0.48]), 32, deflection=0.4).shape
(32, 3)
"""

from limber.lazy import exports

_PLACES = {
    "EnergyField": "field",
    "EnergySettings": "settings",
    "GraspGoal": "goals",
    "GraspModel": "grasp_model",
    "GraspSamples": "field",
    "PlanSettings": "settings",
    "PlannedMotion": "plan",
    "TipGoal": "goals",
    "fit_field": "field",
    "grasp_model_of": "grasp_model",
    "plan_motion": "plan",
    "sample_branch": "sampling",
    "sample_positions": "sampling",
}

__getattr__, __dir__ = exports(__name__, _PLACES)
__all__ = list(_PLACES)
