"""The algebra of shears, against docs/conventions.md, GalSim, and the matrix exponential."""

from __future__ import annotations

import math
from fractions import Fraction
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from array_api_extra.testing import assert_close
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from fdnt_xp import shear
from tolerances import tolerance

CONVENTIONS = Path(__file__).parents[1] / "docs" / "conventions.md"


class Shape(NamedTuple):
    """A row of the table of shapes."""

    ratio: float
    beta: float
    eta1: float
    eta2: float
    e1: float
    e2: float
    g1: float
    g2: float

    @property
    def direction(self) -> np.ndarray:
        angle = math.radians(2.0 * self.beta)
        return np.array([math.cos(angle), math.sin(angle)])

    @property
    def eta(self) -> np.ndarray:
        return math.log(self.ratio) * self.direction

    @property
    def e(self) -> np.ndarray:
        return (self.ratio**2 - 1.0) / (self.ratio**2 + 1.0) * self.direction

    @property
    def g(self) -> np.ndarray:
        return (self.ratio - 1.0) / (self.ratio + 1.0) * self.direction


def read_table() -> list[Shape]:
    """Return the rows of the table of shapes on the conventions page."""
    lines = iter(CONVENTIONS.read_text(encoding="utf-8").splitlines())
    header = next(line for line in lines if line.startswith("| a/b |"))
    columns = [cell.strip() for cell in header.strip("|").split("|")]
    assert columns == ["a/b", "β (deg)", *Shape._fields[2:]]
    next(lines)
    rows = []
    for line in lines:
        if not line.startswith("|"):
            break
        rows.append(Shape(*(float(cell) for cell in line.strip("|").split("|"))))
    return rows


SHAPES = read_table()
ETA = np.array([shape.eta for shape in SHAPES])
E = np.array([shape.e for shape in SHAPES])
G = np.array([shape.g for shape in SHAPES])

component = st.floats(-2.0, 2.0, allow_subnormal=False)
etas = st.tuples(component, component).map(np.array)
angles = st.floats(0.0, math.pi)


def generator(eta: np.ndarray) -> np.ndarray:
    return np.array([[eta[0], eta[1]], [eta[1], -eta[0]]])


def rotation(angle: float) -> np.ndarray:
    return np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])


# --- the conventions page ------------------------------------------------------------


def test_the_table_has_shapes():
    assert len(SHAPES) >= 8


@pytest.mark.parametrize("shape", SHAPES, ids=lambda s: f"{s.ratio:g}@{s.beta:g}")
def test_the_table_is_right(shape):
    printed = np.array(shape[2:]).reshape(3, 2)
    np.testing.assert_allclose(printed, [shape.eta, shape.e, shape.g], rtol=0, atol=5.1e-7)


@pytest.mark.parametrize("shape", SHAPES, ids=lambda s: f"{s.ratio:g}@{s.beta:g}")
def test_galsim_agrees_with_the_table(shape):
    galsim = pytest.importorskip("galsim")
    theirs = galsim.Shear(q=1.0 / shape.ratio, beta=shape.beta * galsim.degrees)
    np.testing.assert_allclose([theirs.g1, theirs.g2], shape.g, atol=1e-15)
    np.testing.assert_allclose([theirs.e1, theirs.e2], shape.e, atol=1e-15)
    np.testing.assert_allclose([theirs.eta1, theirs.eta2], shape.eta, atol=1e-15)
    np.testing.assert_allclose(theirs.getMatrix(), shear.shear_matrix(shape.eta), atol=1e-14)


@pytest.mark.parametrize(
    ("function", "given_", "expected"),
    [
        (shear.distortion_from_eta, ETA, E),
        (shear.reduced_shear_from_eta, ETA, G),
        (shear.eta_from_distortion, E, ETA),
        (shear.eta_from_reduced_shear, G, ETA),
    ],
    ids=["e", "g", "eta from e", "eta from g"],
)
def test_conversions(function, given_, expected, xp, dtype, to_xp):
    actual = function(to_xp(given_, dtype))
    assert_close(actual, to_xp(expected, dtype), **tolerance("algebra", dtype), xp=xp)


def test_which_way_is_up():
    # g1 > 0 is long along columns; g2 > 0 is long along the diagonal of growing indices.
    galsim = pytest.importorskip("galsim")
    y, x = np.mgrid[-16:17, -16:17]
    for g, sign in (((0.3, 0.0), (1, 0)), ((0.0, 0.3), (0, 1))):
        galaxy = galsim.Gaussian(sigma=3.0).shear(g1=g[0], g2=g[1])
        image = galaxy.drawImage(nx=33, ny=33, scale=1.0, method="no_pixel").array
        assert np.sign(round(np.sum(image * (x**2 - y**2)), 3)) == sign[0]
        assert np.sign(round(np.sum(image * 2 * x * y), 3)) == sign[1]


# --- matrices ------------------------------------------------------------------------


def test_matrix_is_the_exponential_of_its_generator(xp, dtype, to_xp):
    expected = np.array([expm(0.5 * generator(eta)) for eta in ETA])
    actual = shear.shear_matrix(to_xp(ETA, dtype))
    assert_close(actual, to_xp(expected, dtype), **tolerance("algebra", dtype), xp=xp)


def test_shear_of_a_matrix_forgets_its_rotation(xp, dtype, to_xp):
    turned = np.array([expm(0.5 * generator(eta)) @ rotation(0.1 + i) for i, eta in enumerate(ETA)])
    actual = shear.eta_from_matrix(to_xp(turned, dtype))
    assert_close(actual, to_xp(ETA, dtype), **tolerance("algebra", dtype), xp=xp)


@given(etas)
def test_matrix_is_symmetric_with_unit_determinant(eta):
    (a, b), (c, d) = shear.shear_matrix(eta)
    assert b == c
    assert a * d - b * c == pytest.approx(1.0, rel=1e-12)


@given(etas, angles)
def test_rotating_the_axes_rotates_the_matrix(eta, angle):
    turned = rotation(2.0 * angle) @ eta
    expected = rotation(angle) @ shear.shear_matrix(eta) @ rotation(angle).T
    np.testing.assert_allclose(shear.shear_matrix(turned), expected, atol=1e-13)


# --- addition ------------------------------------------------------------------------


def test_addition(xp, dtype, to_xp):
    # By complex reduced shears, which owes nothing to matrices.
    a, b = ETA, ETA[::-1]
    g_a, g_b = G @ [1, 1j], G[::-1] @ [1, 1j]
    g = (g_a + g_b) / (1.0 + np.conj(g_a) * g_b)
    expected = np.where(g == 0, 0, 2.0 * np.arctanh(np.abs(g)) * np.exp(1j * np.angle(g)))
    expected = np.stack([expected.real, expected.imag], axis=-1)
    actual = shear.add_shears(to_xp(a, dtype), to_xp(b, dtype))
    # eta = 2 atanh g of a sum near |g| = 1: large shears lose a digit.
    tol = {key: 10.0 * value for key, value in tolerance("algebra", dtype).items()}
    assert_close(actual, to_xp(expected, dtype), **tol, xp=xp)


@pytest.mark.parametrize("i", range(len(SHAPES)))
def test_galsim_adds_the_same(i):
    galsim = pytest.importorskip("galsim")
    lens = galsim.Shear(g1=0.05, g2=-0.11)
    galaxy = galsim.Shear(eta1=ETA[i, 0], eta2=ETA[i, 1])
    both = lens + galaxy  # "the second acts first", as here
    ours = shear.add_shears(np.array([lens.eta1, lens.eta2]), ETA[i])
    np.testing.assert_allclose(ours, [both.eta1, both.eta2], atol=1e-13)


@given(etas)
def test_zero_is_neutral(eta):
    zero = np.zeros(2)
    np.testing.assert_allclose(shear.add_shears(eta, zero), eta, rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose(shear.add_shears(zero, eta), eta, rtol=1e-12, atol=1e-13)


@given(etas)
def test_the_opposite_undoes(eta):
    np.testing.assert_allclose(shear.add_shears(-eta, eta), 0.0, atol=1e-12)


@given(etas, etas)
def test_undoing_a_shear_gives_the_shape_back(eta_a, eta_b):
    there = shear.add_shears(eta_a, eta_b)
    np.testing.assert_allclose(shear.add_shears(-eta_a, there), eta_b, atol=1e-10)


@given(etas, etas)
def test_order_matters_only_for_the_direction(eta_a, eta_b):
    length = [np.hypot(*shear.add_shears(*pair)) for pair in ((eta_a, eta_b), (eta_b, eta_a))]
    assert length[0] == pytest.approx(length[1], rel=1e-10, abs=1e-13)


@given(st.floats(-2.0, 2.0), st.floats(-2.0, 2.0), angles)
def test_parallel_shears_add_their_lengths(a, b, angle):
    direction = rotation(angle)[:, 0]
    actual = shear.add_shears(a * direction, b * direction)
    np.testing.assert_allclose(actual, (a + b) * direction, atol=1e-11)


@given(etas, etas, angles)
def test_rotating_the_sky_rotates_the_sum(eta_a, eta_b, angle):
    turn = rotation(2.0 * angle)
    expected = turn @ shear.add_shears(eta_a, eta_b)
    actual = shear.add_shears(turn @ eta_a, turn @ eta_b)
    np.testing.assert_allclose(actual, expected, atol=1e-10)


# --- round galaxies, batches, libraries ----------------------------------------------


@pytest.mark.parametrize(
    "function",
    [
        shear.distortion_from_eta,
        shear.reduced_shear_from_eta,
        shear.eta_from_distortion,
        shear.eta_from_reduced_shear,
    ],
)
def test_zero_is_zero(function, xp, dtype, to_xp):
    zero = to_xp([[0.0, 0.0]], dtype)
    assert_close(function(zero), zero, xp=xp)


@pytest.mark.parametrize("size", [1e-30, 1e-12, 1e-5, 0.99e-2, 1.01e-2, 0.1, 2.0])
def test_smooth_at_zero(size, xp, dtype, to_xp):
    # Both sides of the switch between series and closed formula, against exact fractions:
    # cosh x, sinh x / x, (cosh x - 1)/x² are the sums of x^2n / (2n + 0, 1, 2)!.
    square = Fraction(size) ** 2
    rtol = 8.0 * float(xp.finfo(dtype).eps)
    computed = shear.hyperbolic_series(xp, to_xp([size], dtype) ** 2)
    for offset, actual in enumerate(computed):
        exact = sum(square**n / math.factorial(2 * n + offset) for n in range(16))
        assert_close(actual, to_xp([float(exact)], dtype), rtol=rtol, xp=xp)


@pytest.mark.parametrize("size", [1e-30, 1e-5, 0.3, 0.99, 1.01, 2.0, 4.0])
def test_slopes_keep_their_digits(size, xp, dtype, to_xp):
    # d/dx over x of the sums above: sum 2n x^(2n-2) / (2n + 1)! and / (2n + 2)!, n >= 1.
    square = Fraction(size) ** 2
    rtol = 40.0 * float(xp.finfo(dtype).eps)
    computed = shear.hyperbolic_slopes(xp, to_xp([size], dtype) ** 2)
    for offset, actual in zip((1, 2), computed, strict=True):
        exact = sum(
            2 * n * square ** (n - 1) / math.factorial(2 * n + offset) for n in range(1, 30)
        )
        assert_close(actual, to_xp([float(exact)], dtype), rtol=rtol, xp=xp)


@pytest.mark.parametrize("size", [1e-9, 1e-30, 1e-200])
def test_small_shears_keep_their_digits(size, xp, dtype, to_xp):
    # Down to where their squares underflow.
    small = to_xp([[3.0 * size, -4.0 * size]], dtype)
    tol = {"rtol": 4.0 * float(xp.finfo(dtype).eps), "xp": xp}
    assert_close(shear.distortion_from_eta(small), small, **tol)
    assert_close(2.0 * shear.reduced_shear_from_eta(small), small, **tol)
    assert_close(shear.eta_from_distortion(small), small, **tol)


def test_a_batch_is_its_rows(xp, dtype, to_xp):
    a, b = to_xp(G, dtype), to_xp(ETA, dtype)
    alone = [shear.add_shears(a[i, :], b[i, :]) for i in range(a.shape[0])]
    together = shear.add_shears(a, b)
    assert_close(together, xp.stack(alone), **tolerance("algebra", dtype), xp=xp)


def test_leading_axes_are_free(xp, to_xp):
    deep = to_xp(ETA[:6].reshape(3, 1, 2, 2))
    assert shear.shear_matrix(deep).shape == (3, 1, 2, 2, 2)
    assert shear.add_shears(deep, deep).shape == deep.shape
    empty = to_xp(np.empty((0, 2)))
    assert shear.add_shears(empty, empty).shape == (0, 2)
    assert shear.distortion_from_eta(empty).shape == (0, 2)


def test_nan_stays_in_its_row(xp, dtype, to_xp, to_np):
    poisoned = np.array([[0.1, 0.2], [np.nan, 0.2], [0.3, -0.1]])
    clean = to_np(shear.add_shears(to_xp(poisoned[::2], dtype), to_xp(poisoned[::2], dtype)))
    mixed = to_np(shear.add_shears(to_xp(poisoned, dtype), to_xp(poisoned, dtype)))
    np.testing.assert_array_equal(mixed[::2], clean)
    assert np.all(np.isnan(mixed[1]))
