"""Young's modulus from pulls: loss, fit, uncertainty; forward simulations, online.

The settings are checked when they are made:

>>> from limber.estimation import EstimateSettings
>>> EstimateSettings(young=1e8).method
'gauss-newton'
>>> EstimateSettings(young=-1.0)
Traceback (most recent call last):
...
pydantic_core._pydantic_core.ValidationError: ...
"""

from limber.lazy import exports

_PLACES = {
    "Estimate": "fit",
    "EstimateSettings": "settings",
    "EvaluationLog": "evaluations",
    "OnlineEstimator": "online.filter",
    "PredictSettings": "settings",
    "Subject": "subject",
    "VirtualPullSettings": "settings",
    "fit_branch": "fit",
    "predict_rest": "predict",
    "simulate_pull": "virtual_pull",
    "subject_of": "subject",
    "true_branch": "virtual_pull",
}

__getattr__, __dir__ = exports(__name__, _PLACES)
__all__ = list(_PLACES)
