"""Sheared quadratic forms, against the matrix exponential and its exact derivative."""

from __future__ import annotations

import numpy as np
import pytest
from array_api_extra.testing import assert_close
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm, expm_frechet

from fdnt_xp.nulltests.forms import contract, sheared_forms
from tolerances import tolerance

PLUS, CROSS = np.array([[1.0, 0.0], [0.0, -1.0]]), np.array([[0.0, 1.0], [1.0, 0.0]])
ETA = np.array(
    [
        [0.0, 0.0],
        [1e-9, -2e-9],
        [0.006, -0.005],
        [0.3, 0.0],
        [0.0, -0.4],
        [-0.5, 0.7],
        [0.9, 0.5],
        [1.6, -1.1],
    ]
)
"""Round, and on both sides of the switches of the series, |eta|² = 1e-4 and 1."""

component = st.floats(-1.5, 1.5, allow_subnormal=False)
pairs = st.tuples(component, component).map(np.array)


def coefficients(matrix):
    """Return `k.M.k` as coefficients of kx², kx ky, ky²."""
    return np.array([matrix[0, 0], matrix[0, 1] + matrix[1, 0], matrix[1, 1]])


def exact(eta):
    """Return F0, F1, F2 and their slopes [j][i], all from S and dS/deta_j."""
    half = 0.5 * (eta[0] * PLUS + eta[1] * CROSS)
    S = expm(half)
    middles = (np.eye(2), PLUS, CROSS)
    forms = [coefficients(S @ middle @ S) for middle in middles]
    slopes = []
    for direction in (PLUS, CROSS):
        dS = expm_frechet(half, 0.5 * direction, compute_expm=False)
        slopes.append([coefficients(dS @ middle @ S + S @ middle @ dS) for middle in middles])
    return forms, slopes


def values(forms, k):
    """Return the forms at one k."""
    monomials = np.array([k[0] ** 2, k[0] * k[1], k[1] ** 2])
    return [float(np.sum(form[0] * monomials)) for form in forms]


# --- the forms -----------------------------------------------------------------------


@pytest.mark.parametrize("i", range(3), ids=["F0", "F1", "F2"])
def test_forms(i, xp, dtype, to_xp):
    expected = np.array([exact(eta)[0][i] for eta in ETA])
    actual = sheared_forms(to_xp(ETA, dtype)).forms[i]
    assert_close(actual, to_xp(expected, dtype), **tolerance("algebra", dtype), xp=xp)


@pytest.mark.parametrize("j", range(2), ids=["by eta1", "by eta2"])
@pytest.mark.parametrize("i", range(3), ids=["F0", "F1", "F2"])
def test_slopes(i, j, xp, dtype, to_xp):
    expected = np.array([exact(eta)[1][j][i] for eta in ETA])
    actual = sheared_forms(to_xp(ETA, dtype)).slopes[j][i]
    assert_close(actual, to_xp(expected, dtype), **tolerance("algebra", dtype), xp=xp)


@given(pairs, pairs)
def test_the_quadrupoles_have_the_length_of_the_square(eta, k):
    # (k'x² - k'y²)² + (2 k'x k'y)² = |k'|⁴.
    square, plus, cross = values(sheared_forms(eta[None, :]).forms, k)
    assert np.hypot(plus, cross) == pytest.approx(square, rel=1e-11, abs=1e-13)


@given(pairs, pairs)
def test_the_shrink_bounds_the_square(eta, k):
    # s|k'| >= |k|: the weight never asks for a mode beyond kmax.
    square = values(sheared_forms(eta[None, :]).forms, k)[0]
    shrunk = np.exp(np.hypot(*eta)) * square
    assert shrunk >= np.sum(k**2) * (1.0 - 1e-12) - 1e-13


@given(pairs, pairs, st.floats(0.0, np.pi))
def test_turning_the_axes_turns_the_quadrupoles(eta, k, angle):
    c, s = np.cos(angle), np.sin(angle)
    turn, turn2 = np.array([[c, -s], [s, c]]), np.array([[c * c - s * s, -2 * c * s]])
    turn2 = np.concatenate([turn2, [[2 * c * s, c * c - s * s]]])
    here = values(sheared_forms(eta[None, :]).forms, k)
    there = values(sheared_forms((turn2 @ eta)[None, :]).forms, turn @ k)
    assert there[0] == pytest.approx(here[0], rel=1e-11, abs=1e-12)
    np.testing.assert_allclose(there[1:], turn2 @ here[1:], atol=1e-10)


# --- moments of a field times a form -------------------------------------------------


@pytest.mark.parametrize("degree", [2, 3, 4])
def test_contraction_multiplies_by_the_form(degree, xp, dtype, to_xp):
    rng = np.random.default_rng(1)
    kx, ky, field = rng.normal(size=(3, 2, 20))
    form = rng.normal(size=(2, 3))

    def moments(f, d):
        return np.stack([np.sum(f * kx ** (d - j) * ky**j, axis=1) for j in range(d + 1)], -1)

    multiplied = form[:, :1] * kx**2 + form[:, 1:2] * kx * ky + form[:, 2:] * ky**2
    actual = contract(to_xp(moments(field, degree), dtype), to_xp(form, dtype))
    expected = to_xp(moments(field * multiplied, degree - 2), dtype)
    tol = {key: 30.0 * value for key, value in tolerance("algebra", dtype).items()}
    assert_close(actual, expected, **tol, xp=xp)


# --- batches -------------------------------------------------------------------------


def test_a_batch_is_its_rows_and_may_be_empty(xp, dtype, to_xp):
    together = sheared_forms(to_xp(ETA, dtype))
    alone = sheared_forms(to_xp(ETA[5:6], dtype))
    empty = sheared_forms(to_xp(ETA[:0], dtype))
    for a, b, c in zip(
        (*together.forms, *together.slopes[0], *together.slopes[1]),
        (*alone.forms, *alone.slopes[0], *alone.slopes[1]),
        (*empty.forms, *empty.slopes[0], *empty.slopes[1]),
        strict=True,
    ):
        assert_close(a[5:6, :], b, **tolerance("algebra", dtype), xp=xp)
        assert c.shape == (0, 3)


def test_nan_stays_in_its_row(dtype, to_xp, to_np):
    poisoned = ETA.copy()
    poisoned[2, 0] = np.nan
    forms = sheared_forms(to_xp(poisoned, dtype))
    for part in (*forms.forms, *forms.slopes[0], *forms.slopes[1]):
        assert np.all(np.isnan(to_np(part)).any(axis=1) == (np.arange(len(ETA)) == 2))
