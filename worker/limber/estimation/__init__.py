"""Young's modulus from pulls: loss, fit, uncertainty; forward simulations, online.

The settings are checked when they are made:

>>> from limber.estimation import EstimateSettings
>>> EstimateSettings().method
'gauss-newton'
>>> EstimateSettings(delta_m2=-1.0)
Traceback (most recent call last):
...
pydantic_core._pydantic_core.ValidationError: ...
"""

from limber.core.optional import exports

_PLACES = {
    "Estimate": "fit_assessment",
    "EstimateSettings": "settings",
    "FitSpec": "settings",
    "EvaluationLog": "fitting.objective",
    "OnlineEstimator": "online.filter",
    "PredictSettings": "settings",
    "Subject": "estimated_branch",
    "PullSpec": "settings",
    "VirtualPullSettings": "settings",
    "fit_branch": "fit",
    "predict_rest": "prediction",
    "simulate_pull": "simulated_pull",
    "subject_of": "estimated_branch",
    "true_branch": "simulated_pull",
}

__getattr__, __dir__ = exports(__name__, _PLACES)
__all__ = list(_PLACES)
