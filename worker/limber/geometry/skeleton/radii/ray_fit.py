"""The fit of axes and radii for one sensor's rays, where the points support that model."""

from dataclasses import replace

import numpy as np

from limber.geometry.cloud.single_view import View
from limber.geometry.skeleton.radii.axis_fit import AxisFit
from limber.geometry.skeleton.radii.cylinders import nearest_cylinders
from limber.geometry.skeleton.radii.projected_widths import by_projected_widths
from limber.geometry.skeleton.radii.robust_noise import robust_sigma
from limber.geometry.skeleton.radii.sampling_evidence import rays_over_skin
from limber.geometry.skeleton.radii.visible_sides import PLACES, SeenSides

_LIKELIER = 3.0  # logarithm: twenty times


def fit_of_rays(fit: AxisFit, points: np.ndarray, certain: bool, view: View | None = None,
                ) -> AxisFit | None:
    """Return the fit by the branches' widths across one sensor's sight.

    Args:
        fit: The fit by the points' distances.
        points: The scan [m], shape [m, 3].
        certain: Whether one sensor's rays are known to have made the points; otherwise None is
            returned where the points do not support it.
        view: The sensor's view, if it is known.
    """
    skeleton, field = by_projected_widths(fit.skeleton, points, view)
    if not certain and rays_over_skin(fit, skeleton, field, points) < _LIKELIER:
        return None
    segment, residual = nearest_cylinders(skeleton, points)
    return replace(fit, skeleton=skeleton, segment=segment, residual=residual,
                   noise=robust_sigma(residual, skeleton.radius[segment]),
                   seen=SeenSides(field.towards, np.ones(PLACES), along_sight=True))
