"""Estimators of a skeleton's radii by name; a further one is one file, and its entry here.

An estimator is called with the aligned skeleton as fitted, the aligned points [m], shape [m, 3],
and the settings; it returns the skeleton with its own radii. ``fit`` leaves those of the fit.
"""

ESTIMATORS: dict[str, str] = {
    "paper": "limber.geometry.skeleton.radii.nearest_points:nearest_point_radii",
}
"""Function of each, as ``module:name``: settings import none of them."""


def estimator_names() -> tuple[str, ...]:
    """Return the names that ``--radii`` takes."""
    return ("fit", *ESTIMATORS)
