"""The kernels of the strain polynomial against the plain forms and finite differences."""

import numpy as np
import pytest

from limber.reduced.strain_polynomial import _green, _green_change, evaluate_strain, strain_only

COUNT, SIZE = 7, 9
LOW = np.tril_indices(SIZE)


def polynomial():
    """Linear parts [m, size], symmetric quadratic parts [m, size, size], and coordinates."""
    rng = np.random.default_rng(0)
    form = rng.normal(size=(COUNT, SIZE, SIZE))
    return rng.normal(size=(COUNT, SIZE)), form + form.transpose(0, 2, 1), rng.normal(
        size=(3, SIZE))


@pytest.mark.parametrize("is_moving", [False, True])
@pytest.mark.parametrize("is_mixed", [False, True])
def test_strain_force_and_tangent(is_mixed, is_moving):
    linear, form, (q, step, velocity) = polynomial()
    damping, by_rate = (0.03, 50.0)
    out = [np.empty(COUNT), np.empty((COUNT, SIZE)), np.empty(SIZE), np.empty((SIZE, SIZE))]
    flat, nothing = np.ascontiguousarray(form[:, *LOW]), np.empty(0)
    energy = evaluate_strain(linear, flat, q, step if is_mixed else nothing,
                             velocity if is_moving else nothing, *out, damping, by_rate)
    strain = linear @ q + np.einsum("aij,i,j->a", form, q, q)
    slopes = linear + 2 * form @ q
    stress, growth = strain, 1.0
    if is_moving:
        stress, growth = strain + damping * slopes @ velocity, 1 + damping * by_rate
    held = stress - np.einsum("aij,i,j->a", form, step, step) * is_mixed
    plain = (strain, slopes, slopes.T @ stress, np.tril(
        growth * slopes.T @ slopes + 2 * np.einsum("a,aij->ij", held, form)))
    assert energy == pytest.approx(strain @ strain / 2)
    for one, other in zip(out, plain, strict=True):
        np.testing.assert_allclose(np.tril(one) if one.shape == (SIZE, SIZE) else one, other,
                                   rtol=1e-10, atol=1e-10)
    alone = np.empty(COUNT)
    assert strain_only(linear, flat, q, alone) == pytest.approx(energy)
    np.testing.assert_allclose(alone, strain)


def test_force_is_the_energy_s_slope():
    linear, form, (q, *_) = polynomial()
    flat, out = np.ascontiguousarray(form[:, *LOW]), np.empty(COUNT)
    force = np.empty(SIZE)
    evaluate_strain(linear, flat, q, np.empty(0), np.empty(0), out, np.empty((COUNT, SIZE)), force,
                    np.empty((SIZE, SIZE)), 0.0, 0.0)
    for number, unit in enumerate(np.eye(SIZE)):
        above, below = (strain_only(linear, flat, q + sign * 1e-5 * unit, out) for sign in (1, -1))
        assert (above - below) / 2e-5 == pytest.approx(force[number], rel=1e-6)


def test_a_change_of_the_strain_is_a_difference_of_strains():
    rng = np.random.default_rng(1)
    states, changes = rng.normal(size=(5, 3, 3, 2)), rng.normal(size=(5, 3, 3, 4))
    owners, scales, found = np.array([0, 1, 1, 0]), rng.normal(size=4), np.empty((5, 6, 4))
    _green_change(states, changes, owners, scales, found)
    above, below = (_green(states[..., owners] + sign * 1e-6 * changes) for sign in (1, -1))
    np.testing.assert_allclose(found, scales * (above - below) / 2e-6, atol=1e-8)
