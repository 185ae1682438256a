"""The basis of an object: where its tests vanish, how they respond, where they have no value."""

from __future__ import annotations

import numpy as np
import pytest
from array_api_extra.testing import assert_close

from fdnt_xp.nulltests.dogleg import Status
from fdnt_xp.shapes.gl_matching import (
    BasisTests,
    basis_at,
    match_basis,
    screened_basis,
    starting_moments,
)
from fdnt_xp.shapes.laguerre import LaguerreBasis
from fdnt_xp.shear import shear_matrix
from images import gaussian_image
from tolerances import tolerance

SIDE = 40
ETA = np.array([[0.4, -0.3], [-0.2, 0.5], [0.1, 0.0]])
CENTRE = np.array([[0.3, -0.8], [1.1, 0.2], [0.0, 0.0]])
SIZE = np.array([3.0, 2.6, 2.8])
LENGTH = 2.5
TRUTH = np.concatenate([CENTRE / LENGTH, ETA, np.log(SIZE)[:, None]], axis=1)


def gaussians():
    return np.stack(
        [
            gaussian_image(s**2 * m @ m, (SIDE, SIDE), centre=tuple(c))
            for s, m, c in zip(SIZE, shear_matrix(ETA), CENTRE, strict=True)
        ]
    )


@pytest.fixture
def start(to_xp):
    """Return `start(dtype)`, round bases of one size in the middle."""

    def basis(dtype="float64", order=6):
        return LaguerreBasis(
            order=order,
            eta=to_xp(np.zeros((3, 2)), dtype),
            centroid=to_xp(np.zeros((3, 2)), dtype),
            size=to_xp(np.full(3, LENGTH), dtype),
        )

    return basis


@pytest.fixture
def tests(to_xp, start):
    stamps = to_xp(gaussians())
    return BasisTests(stamps=stamps, ivar=to_xp(np.ones((3, SIDE, SIDE))), start=start())


def test_the_tests_of_a_gaussian_vanish_in_its_own_basis(tests, to_xp, to_np):
    f, _ = tests.evaluate(to_xp(TRUTH))
    assert f.shape == (3, 5)
    assert np.max(np.abs(to_np(f))) < 1e-9


@pytest.mark.parametrize("j", range(5))
def test_derivatives_against_differences(j, tests, to_xp, to_np):
    step = np.zeros(5)
    step[j] = 1e-4
    plus, minus = (to_np(tests.evaluate(to_xp(TRUTH + s))[0]) for s in (step, -step))
    _, jac = tests.evaluate(to_xp(TRUTH))
    np.testing.assert_allclose(to_np(jac)[:, :, j], (plus - minus) / 2e-4, atol=1e-5)


def test_the_root_is_the_gaussian(xp, dtype, to_xp, to_np, start):
    ivar = np.random.default_rng(0).random((3, SIDE, SIDE)) > 0.1
    root = match_basis(start(dtype), to_xp(gaussians(), dtype), to_xp(1.0 * ivar, dtype), 40)
    assert_close(root.x, to_xp(TRUTH, dtype), **tolerance("matched basis", dtype), xp=xp)
    assert to_np(root.status).tolist() == [int(Status.CONVERGED)] * 3


def test_the_order_of_the_match_is_its_own(xp, to_xp, start):
    stamps, ivar = to_xp(gaussians()), to_xp(np.ones((3, SIDE, SIDE)))
    low, high = (match_basis(start(order=n), stamps, ivar, 40).x for n in (0, 16))
    assert_close(low, high, rtol=0.0, atol=1e-6, xp=xp)


def test_no_value_where_there_is_no_galaxy(to_xp, to_np, start):
    stamps, ivar = gaussians(), np.ones((3, SIDE, SIDE))
    stamps[0] *= -1.0
    ivar[1, :, :16] = ivar[1, :16, :] = 0.0
    ivar[1, :, 20:] = ivar[1, 20:, :] = 0.0
    x = TRUTH.copy()
    tests = BasisTests(stamps=to_xp(stamps), ivar=to_xp(ivar), start=start())
    f, _ = tests.evaluate(to_xp(x))
    np.testing.assert_array_equal(np.isnan(to_np(f)).all(axis=1), [True, True, False])
    # Nor where the basis is absurd.
    x[:, 4] = [50.0, -50.0, np.nan]
    f, _ = tests.evaluate(to_xp(x))
    assert np.all(np.isnan(to_np(f)))


def test_absurd_bases_become_unit_circles(to_xp, to_np, start):
    x = TRUTH.copy()
    x[0, 2] = 9.0
    basis, sane = screened_basis(basis_at(to_xp(x), start()), SIDE)
    assert to_np(sane).tolist() == [False, True, True]
    assert to_np(basis.size)[0] == 1.0
    np.testing.assert_allclose(to_np(basis.eta)[1:], ETA[1:])


def test_moments_of_round_gaussians(dtype, to_xp, to_np):
    sizes, centres = [1.5, 2.5, 4.0], [(0.0, 0.0), (2.0, -1.0), (-1.5, 3.0)]
    stamps = np.stack(
        [
            gaussian_image(s**2 * np.eye(2), (64, 64), centre=c)
            for s, c in zip(sizes, centres, strict=True)
        ]
    )
    centroid, size = starting_moments(to_xp(stamps, dtype), to_xp(np.ones((3, 64, 64)), dtype))
    np.testing.assert_allclose(to_np(centroid), centres, atol=0.1)
    np.testing.assert_allclose(to_np(size), sizes, rtol=0.05)
