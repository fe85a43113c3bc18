"""Radial interpolation: against scipy, by finite differences, and what forces are worth."""

import numpy as np
import pytest
from scipy.interpolate import RBFInterpolator

from limber.core.errors import WorkError
from limber.planning.field.radial import KERNELS, RadialInterpolant

GENERATOR = np.random.default_rng(3)
POINTS = GENERATOR.uniform(-0.2, 0.2, (100, 3))
ELSEWHERE = GENERATOR.uniform(-0.15, 0.15, (60, 3))


@pytest.mark.parametrize(("kernel", "degree"), [("cubic", 1), ("quintic", 2)])
def test_without_gradients_it_is_scipys(kernel, degree, ridge):
    """Fitted to values alone, it is what scipy's RBFInterpolator gives."""
    values = ridge.energy(POINTS)
    wanted = RBFInterpolator(POINTS, values, kernel=kernel, degree=degree)(ELSEWHERE)
    found = RadialInterpolant.fit(POINTS, values, kernel=kernel).value(ELSEWHERE)[:, 0]
    assert np.allclose(found, wanted, rtol=0, atol=1e-9)


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("with_gradients", [False, True])
def test_gradient_is_that_of_the_value(kernel, with_gradients, ridge):
    """The compiled gradient agrees with central differences of the compiled value."""
    fitted = RadialInterpolant.fit(POINTS, ridge.energy(POINTS),
                                   ridge.force(POINTS) if with_gradients else None, kernel=kernel,
                                   shape=2.5, smoothing=1e-9)
    step = 1e-4
    differences = np.stack(
        [(fitted.value(ELSEWHERE + step * axis) - fitted.value(ELSEWHERE - step * axis))[:, 0]
         / (2 * step) for axis in np.eye(3)], axis=1)
    assert np.allclose(fitted.gradient(ELSEWHERE)[:, :, 0], differences, atol=2e-4)


@pytest.mark.parametrize("kernel", KERNELS)
def test_values_and_gradients_are_matched(kernel, ridge):
    """Without smoothing the field passes through the values and gradients it was given."""
    fitted = RadialInterpolant.fit(POINTS, ridge.energy(POINTS), ridge.force(POINTS),
                                   kernel=kernel, shape=2.5)
    assert np.allclose(fitted.value(POINTS)[:, 0], ridge.energy(POINTS), atol=1e-6)
    assert np.allclose(fitted.gradient(POINTS)[:, :, 0], ridge.force(POINTS), atol=1e-4)


def test_forces_make_the_same_samples_tell_more(ridge):
    """With forces the error at unseen points falls to under half, the gradient's too."""
    values, forces = ridge.energy(POINTS), ridge.force(POINTS)

    def errors(fitted):
        energy = fitted.value(ELSEWHERE)[:, 0] - ridge.energy(ELSEWHERE)
        force = fitted.gradient(ELSEWHERE)[:, :, 0] - ridge.force(ELSEWHERE)
        return np.sqrt(np.mean(energy**2)), np.sqrt(np.mean(force**2))

    plain = errors(RadialInterpolant.fit(POINTS, values, kernel="multiquadric", shape=2.0))
    hermite = errors(RadialInterpolant.fit(POINTS, values, forces, kernel="multiquadric",
                                           shape=2.0))
    assert hermite[0] < plain[0] / 2
    assert hermite[1] < plain[1] / 2


def test_channels_are_independent(ridge):
    """Several channels fitted at once are each as fitted alone."""
    values = np.stack([ridge.energy(POINTS), POINTS[:, 0]], axis=1)
    both = RadialInterpolant.fit(POINTS, values).value(ELSEWHERE)
    alone = RadialInterpolant.fit(POINTS, values[:, 1]).value(ELSEWHERE)
    assert np.allclose(both[:, 1], alone[:, 0], atol=1e-12)
    assert np.allclose(both[:, 1], ELSEWHERE[:, 0], atol=1e-9)


def test_too_few_samples_are_refused():
    """Fewer samples than polynomial terms, or all in a plane, are an error and not nonsense."""
    with pytest.raises(WorkError, match="no unique solution"):
        RadialInterpolant.fit(np.zeros((5, 3)), np.zeros(5))
