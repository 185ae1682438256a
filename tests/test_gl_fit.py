"""Gauss-Laguerre fits: known sums, known Gaussians, masks, noise, and stamps beyond use."""

from __future__ import annotations

import numpy as np
import pytest
from array_api_extra.testing import assert_close, assert_equal

from fdnt_xp.errors import FdntTypeError, FdntValueError, RangeError, ShapeMismatchError
from fdnt_xp.flags import Flag
from fdnt_xp.fourier.grid import half_plane_disc
from fdnt_xp.fourier.transform import deconvolve
from fdnt_xp.nulltests.dogleg import Status
from fdnt_xp.shapes.fdnt_gl import deconvolve_fit
from fdnt_xp.shapes.gl_fit import filled, fit_laguerre
from fdnt_xp.shapes.laguerre import LaguerreBasis, n_coefficients, pixel_positions, position
from fdnt_xp.shear import shear_matrix
from images import gaussian_image
from tolerances import tolerance

SIDE = 40
ETA = np.array([[0.4, -0.3], [-0.2, 0.5], [0.1, 0.0]])
CENTRE = np.array([[0.3, -0.8], [1.1, 0.2], [0.0, 0.0]])
SIZE = np.array([3.0, 2.6, 2.8])
MIDDLE = 0.5 * (SIDE - 1)
MASKS = ["none", "2 %", "5 %", "10 %", "column"]


def mask(name, seed=0):
    """Return which pixels are there, one pattern for each of the three galaxies."""
    present = np.ones((3, SIDE, SIDE), dtype=bool)
    if name.endswith("%"):
        drawn = np.random.default_rng(seed).random(present.shape)
        present &= drawn > 0.01 * float(name[:-1])
    elif name == "column":
        present[:, :, SIDE // 2] = False
    elif name == "quadrant":
        present[:, SIDE // 2 :, SIDE // 2 :] = False
    return present


def gaussians(size=SIZE):
    """Return three Gaussian galaxies of the shapes, centres and sizes above."""
    return np.stack(
        [
            gaussian_image(s**2 * m @ m, (SIDE, SIDE), centre=tuple(c), flux=f)
            for s, m, c, f in zip(size, shear_matrix(ETA), CENTRE, (1.0, 20.0, 3.0), strict=True)
        ]
    )


def lumpy(order=4, seed=1):
    """Return three sums of Gauss-Laguerre functions and their coefficients."""
    b = 0.15 * np.random.default_rng(seed).normal(size=(3, n_coefficients(order)))
    b[:, 0] = 1.0
    basis = LaguerreBasis(order=order, eta=ETA, centroid=CENTRE, size=SIZE)
    x, y = pixel_positions(np, np.zeros((1, SIDE, SIDE)))
    return basis.image(b, x, y).reshape(3, SIDE, SIDE), b


@pytest.fixture
def given(to_xp):
    """Return `given(dtype)`, the keywords with which the basis is that of `lumpy`."""

    def keywords(dtype="float64"):
        return {
            "eta": to_xp(ETA, dtype),
            "centroid": to_xp(CENTRE + MIDDLE, dtype),
            "size": to_xp(SIZE, dtype),
            "matched": False,
        }

    return keywords


# --- the linear fit ------------------------------------------------------------------


@pytest.mark.parametrize("name", MASKS)
def test_coefficients_of_a_known_sum_come_back(name, xp, dtype, to_xp, to_np, given):
    stamps, b = lumpy()
    present = mask(name)
    # What a missing pixel holds is not looked at.
    stamps = np.where(present, stamps, np.nan)
    ivar = to_xp(np.where(present, 25.0, 0.0), dtype)
    fit = fit_laguerre(to_xp(stamps, dtype), ivar, order=6, **given(dtype))
    expected = np.zeros((3, n_coefficients(6)))
    expected[:, : b.shape[1]] = b
    tol = tolerance("laguerre fit", dtype)
    assert_close(fit.coefficients, to_xp(expected, dtype), **tol, xp=xp)
    assert bool(xp.all(fit.usable))
    np.testing.assert_array_equal(to_np(fit.n_pixels), present.sum(axis=(1, 2)))
    assert np.all(to_np(fit.inflation) < 1.5)
    assert to_np(fit.status).tolist() == [int(Status.CONVERGED)] * 3
    assert to_np(fit.n_iter).tolist() == [0, 0, 0]


def test_the_covariance_is_that_of_least_squares(xp, to_xp, to_np, given):
    rng = np.random.default_rng(2)
    ivar = rng.uniform(0.5, 40.0, (3, SIDE, SIDE)) * mask("10 %")
    stamps, _ = lumpy()
    stamps = stamps + rng.normal(size=stamps.shape)
    fit = fit_laguerre(to_xp(stamps), to_xp(ivar), order=6, **given())
    x, y = pixel_positions(np, stamps)
    basis = LaguerreBasis(order=6, eta=ETA, centroid=CENTRE, size=SIZE)
    for i, functions in enumerate(basis.in_x(x, y)):
        weight = np.sqrt(ivar[i].ravel())
        design = (functions * weight).T
        b = np.linalg.lstsq(design, weight * stamps[i].ravel())[0]
        np.testing.assert_allclose(to_np(fit.coefficients)[i], b, atol=1e-10)
        cov = np.linalg.pinv(design.T @ design)
        np.testing.assert_allclose(to_np(fit.coefficients_cov)[i], cov, atol=1e-10)


def test_the_covariance_is_the_scatter(to_xp, to_np):
    n, order, sigma = 2000, 4, 0.02
    image, b = lumpy()
    noise = np.random.default_rng(3).normal(size=(n, SIDE, SIDE))
    present = mask("5 %")[:1]
    stamps = to_xp(image[:1] + sigma * noise)
    ivar = to_xp(np.broadcast_to(present / sigma**2, noise.shape))
    same = {"eta": ETA[:1], "centroid": CENTRE[:1] + MIDDLE, "size": SIZE[:1]}
    same = {name: to_xp(np.repeat(value, n, axis=0)) for name, value in same.items()}
    fit = fit_laguerre(stamps, ivar, order=order, matched=False, **same)
    d = to_np(fit.coefficients) - b[0]
    chi_square = np.einsum("gi,gij,gj->g", d, np.linalg.inv(to_np(fit.coefficients_cov)), d)
    n_coef = n_coefficients(order)
    assert np.mean(chi_square) == pytest.approx(n_coef, abs=4.0 * np.sqrt(2.0 * n_coef / n))
    pulls = d / np.sqrt(np.diagonal(to_np(fit.coefficients_cov), axis1=1, axis2=2))
    np.testing.assert_allclose(np.std(pulls, axis=0), 1.0, atol=4.5 / np.sqrt(2.0 * n))


# --- the matched basis ---------------------------------------------------------------


@pytest.mark.parametrize("name", MASKS)
def test_a_gaussian_has_the_basis_it_is_made_of(name, xp, dtype, to_xp, to_np):
    ivar = to_xp(mask(name).astype(float), dtype)
    fit = fit_laguerre(to_xp(gaussians(), dtype), ivar, order=8)
    tol = {**tolerance("matched basis", dtype), "xp": xp}
    assert_close(fit.basis.eta, to_xp(ETA, dtype), **tol)
    assert_close(fit.basis.centroid, to_xp(CENTRE, dtype), **tol)
    assert_close(xp.log(fit.basis.size), to_xp(np.log(SIZE), dtype), **tol)
    assert np.max(to_np(fit.n_iter)) < 10
    # All the flux is in b00 = flux/(2 sqrt(pi) sigma).
    b = to_np(fit.coefficients)
    b = b / b[:, :1]
    np.testing.assert_allclose(b[:, 1:], 0.0, atol=3.0 * tol["atol"])


def test_the_tests_of_the_basis_vanish_at_any_order(to_xp, to_np):
    stamps, _ = lumpy()
    tests = [position(1, 0), position(1, 0, sine=True)]
    tests += [position(2, 0), position(2, 0, sine=True), position(1, 1)]
    for order in (4, 5, 10):
        fit = fit_laguerre(to_xp(stamps), to_xp(np.ones(stamps.shape)), order=order)
        b = to_np(fit.coefficients)
        assert np.all(to_np(fit.usable))
        # Functions are all but orthogonal over the pixels: the order of the fit adds little.
        assert np.max(np.abs(b[:, tests] / b[:, :1])) < 1e-6


def test_flux_does_not_matter_and_scale_makes_the_basis_larger(xp, to_xp, to_np):
    one = to_xp(np.ones((3, SIDE, SIDE)))
    fit = fit_laguerre(to_xp(gaussians()), one, order=6)
    bright = fit_laguerre(to_xp(1e6 * gaussians()), 1e-12 * one, order=6, scale=1.2)
    assert_close(bright.basis.eta, fit.basis.eta, rtol=0.0, atol=1e-12, xp=xp)
    assert_close(bright.basis.size, 1.2 * fit.basis.size, rtol=1e-12, xp=xp)
    assert np.all(np.abs(to_np(bright.coefficients)[:, position(1, 1)]) > 1e3)


def test_each_galaxy_may_have_a_scale_of_its_own(dtype, xp, to_xp):
    stamps, one = to_xp(gaussians(), dtype), to_xp(np.ones((3, SIDE, SIDE)), dtype)
    scale = np.array([1.0, 1.2, 1.1])
    fit = fit_laguerre(stamps, one, order=6, scale=to_xp(scale, dtype), chunk_size=2)
    for i, s in enumerate(scale):
        alone = fit_laguerre(stamps[i : i + 1, :, :], one[i : i + 1, :, :], order=6, scale=s)
        tol = {**tolerance("batch", dtype), "xp": xp}
        assert_close(fit.basis.size[i : i + 1], alone.basis.size, rtol=1e-6, xp=xp)
        assert_close(fit.coefficients[i, :], alone.coefficients[0, :], **tol)


def test_a_scale_that_means_nothing_is_flagged_or_refused(to_xp, to_np):
    stamps, one = to_xp(gaussians()), to_xp(np.ones((3, SIDE, SIDE)))
    fit = fit_laguerre(stamps, one, order=4, scale=to_xp(np.array([-1.0, np.nan, 1.0])))
    assert to_np(fit.flags).tolist() == [int(Flag.GL_FAILURE)] * 2 + [0]
    with pytest.raises(ShapeMismatchError, match=r"scale must be a number or have the shape \(3,"):
        fit_laguerre(stamps, one, order=4, scale=to_xp(np.ones(2)))


def test_a_start_may_be_given(xp, to_xp, to_np):
    # Two equal galaxies on a stamp: which one is fitted is the caller's choice.
    one, two = (
        gaussian_image(4.0 * np.eye(2), (SIDE, 2 * SIDE), centre=(x, 0.0)) for x in (-18.0, 18.0)
    )
    stamps = to_xp(np.stack([one + two] * 2))
    centres = np.array([[-18.5, 0.5], [18.5, -0.5]])
    start = to_xp(centres + np.array([SIDE - 0.5, MIDDLE]))
    size = to_xp(np.array([1.7, 2.4]))
    ivar = to_xp(np.ones(stamps.shape))
    fit = fit_laguerre(stamps, ivar, order=4, centroid=start, size=size)
    np.testing.assert_allclose(to_np(fit.basis.centroid), [[-18.0, 0.0], [18.0, 0.0]], atol=1e-3)
    np.testing.assert_allclose(to_np(fit.basis.size), 2.0, atol=1e-3)


@pytest.mark.parametrize("shift", [(0.0, 0.0), (4.0, -3.0)], ids=str)
@pytest.mark.parametrize("size", [1.2, 3.0, 6.0])
def test_moments_are_start_enough(size, shift, to_xp, to_np):
    image = gaussian_image(size**2 * np.diag([1.5, 0.7]), (64, 64), centre=shift)
    noise = np.random.default_rng(4).normal(size=(20, 64, 64))
    sigma = np.sqrt(np.sum(image**2)) / 30.0
    stamps = to_xp(image + sigma * noise)
    fit = fit_laguerre(stamps, to_xp(np.full(noise.shape, sigma**-2)), order=4)
    assert np.all(to_np(fit.usable))
    np.testing.assert_allclose(to_np(fit.basis.centroid) - shift, 0.0, atol=0.3 * size)


# --- galaxies beyond use -------------------------------------------------------------


def test_a_quadrant_cut_at_the_centre_is_flagged(xp, dtype, to_xp, to_np):
    ivar = to_xp(mask("quadrant").astype(float), dtype)
    stamps = to_xp(gaussians(), dtype)
    for matched in (True, False):
        start = {"centroid": to_xp(CENTRE + MIDDLE, dtype), "size": to_xp(SIZE, dtype)}
        fit = fit_laguerre(stamps, ivar, order=12, matched=matched, **start)
        assert to_np(fit.flags).tolist() == [int(Flag.GL_FAILURE)] * 3
        assert np.all(to_np(fit.inflation) > 100.0)
        assert np.all(np.isnan(to_np(fit.coefficients)))
        assert np.all(np.isnan(to_np(fit.coefficients_cov)))
        assert np.all(np.isnan(to_np(fit.basis.eta)))


def poisoned():
    """Return ten galaxies, of which those with a flag are beyond use."""
    stamps = np.concatenate([gaussians(), gaussians(), gaussians(), gaussians()[:1]])
    ivar = np.ones_like(stamps)
    stamps[1, 7, 9] = np.nan
    ivar[2] = 0.0
    ivar[4, 3, 3] = -1.0
    ivar[5, 3, 3] = np.nan
    ivar[6] *= mask("quadrant")[0]
    ivar[7, :, 10:] = 0.0
    ivar[7, 9:, :] = 0.0
    stamps[8] = -stamps[8]
    stamps[9, 5, 5] = np.inf
    ivar[9, 5, 5] = 0.0
    flags = [0, Flag.NON_FINITE_PIXEL, Flag.NO_SIGNAL, 0, Flag.NON_FINITE_PIXEL]
    flags += [Flag.NON_FINITE_PIXEL, Flag.GL_FAILURE, Flag.GL_FAILURE, Flag.NO_SIGNAL, 0]
    return stamps, ivar, [int(flag) for flag in flags]


def test_one_bad_galaxy_changes_nobody(xp, dtype, to_xp, to_np):
    stamps, ivar, flags = poisoned()
    fit = fit_laguerre(to_xp(stamps, dtype), to_xp(ivar, dtype), order=12)
    assert to_np(fit.flags).tolist() == flags
    usable = np.array(flags) == 0
    np.testing.assert_array_equal(np.isfinite(to_np(fit.coefficients)[:, 0]), usable)
    np.testing.assert_array_equal(to_np(fit.usable), usable)
    for i in range(10):
        one = slice(i, i + 1)
        alone = fit_laguerre(to_xp(stamps[one], dtype), to_xp(ivar[one], dtype), order=12)
        together = fit.take(to_xp(np.array([i])))
        tol = {**tolerance("batch", dtype), "xp": xp}
        assert_close(alone.basis.eta, together.basis.eta, **tol)
        assert_close(alone.coefficients, together.coefficients, **tol)
        assert_equal(alone.flags, together.flags, xp=xp)


@pytest.mark.parametrize("matched", [True, False])
def test_a_start_that_means_nothing_is_flagged(matched, to_xp, to_np):
    size = to_xp(np.array([-1.0, np.nan, SIZE[2]]))
    ivar = to_xp(np.ones((3, SIDE, SIDE)))
    for start in (size, 0.0 * size):
        fit = fit_laguerre(to_xp(gaussians()), ivar, order=4, size=start, matched=matched)
        expected = [True, True, start is not size]
        np.testing.assert_array_equal(to_np(fit.flags) == int(Flag.GL_FAILURE), expected)


@pytest.mark.parametrize("chunk_size", [1, 3])
def test_chunks_change_nothing(chunk_size, xp, to_xp, to_np):
    stamps, ivar, _ = poisoned()
    whole = fit_laguerre(to_xp(stamps), to_xp(ivar), order=6)
    parts = fit_laguerre(to_xp(stamps), to_xp(ivar), order=6, chunk_size=chunk_size)
    tol = {**tolerance("batch", xp.float64), "xp": xp}
    assert_close(parts.coefficients, whole.coefficients, **tol)
    assert_close(parts.coefficients_cov, whole.coefficients_cov, **tol)
    assert_equal(parts.flags, whole.flags, xp=xp)


def test_an_empty_batch_gives_an_empty_fit(dtype, to_xp):
    none = to_xp(np.zeros((0, 12, 12)), dtype)
    fit = fit_laguerre(none, none, order=4)
    assert fit.coefficients.shape == (0, 15)
    assert fit.coefficients_cov.shape == (0, 15, 15)
    assert fit.flags.shape == fit.basis.size.shape == (0,)
    assert fit.coefficients.dtype == fit.basis.eta.dtype == dtype
    assert filled(none, none, fit).shape == (0, 12, 12)


def test_no_steps_no_match(to_xp, to_np):
    fit = fit_laguerre(to_xp(gaussians()), to_xp(np.ones((3, SIDE, SIDE))), order=4, max_iter=0)
    assert to_np(fit.flags).tolist() == [int(Flag.GL_FAILURE | Flag.DID_NOT_CONVERGE)] * 3


# --- missing pixels, and the way to k ------------------------------------------------


def test_missing_pixels_are_filled_and_others_untouched(xp, dtype, to_xp, to_np):
    truth, present = gaussians(), mask("5 %")
    noisy = truth + 1e-3 * np.random.default_rng(5).normal(size=truth.shape)
    stamps, ivar = to_xp(np.where(present, noisy, np.nan), dtype), to_xp(1e6 * present, dtype)
    whole = to_np(filled(stamps, ivar, fit_laguerre(stamps, ivar, order=8)))
    np.testing.assert_array_equal(whole[present], to_np(stamps)[present])
    assert np.max(np.abs(whole - truth)[~present]) < 2e-3


def test_what_is_not_usable_can_be_made_harmless(to_xp, to_np):
    present = mask("none")
    present[1] = mask("quadrant")[1]
    fit = fit_laguerre(to_xp(gaussians()), to_xp(present.astype(float)), order=12)
    harmless = fit.harmless()
    assert to_np(harmless.flags).tolist() == [0, int(Flag.GL_FAILURE), 0]
    assert to_np(harmless.basis.size)[1] == 1.0
    for name in ("coefficients", "coefficients_cov"):
        ours, theirs = to_np(getattr(harmless, name)), to_np(getattr(fit, name))
        assert np.all(ours[1] == 0.0)
        np.testing.assert_array_equal(ours[[0, 2]], theirs[[0, 2]])


def test_what_cannot_be_fitted_cannot_be_filled(to_xp, to_np):
    stamps, present = gaussians(), mask("5 %")
    present[1] = mask("quadrant")[1]
    ivar = to_xp(present.astype(float))
    whole = to_np(filled(to_xp(stamps), ivar, fit_laguerre(to_xp(stamps), ivar, order=12)))
    np.testing.assert_array_equal(np.isnan(whole).any(axis=(1, 2)), [False, True, False])
    np.testing.assert_array_equal(whole[present], stamps[present])


def test_a_fit_has_the_transform_of_the_whole_stamp(xp, dtype, device, to_xp, to_np, given):
    stamps, _ = lumpy()
    grid = half_plane_disc(xp, (SIDE, SIDE), 1.5, dtype=dtype, device=device)
    complex_dtype = xp.complex64 if dtype == xp.float32 else xp.complex128
    rng = np.random.default_rng(6)
    inverse = to_xp(rng.normal(size=(1, grid.n_k)) + 1j * rng.normal(size=(1, grid.n_k)))
    inverse = xp.astype(inverse, complex_dtype)
    ivar = to_xp(mask("10 %").astype(float), dtype)
    fit = fit_laguerre(to_xp(stamps, dtype), ivar, order=5, **given(dtype))
    ours = deconvolve_fit(fit, inverse, grid)
    expected = deconvolve(to_xp(stamps, dtype), inverse, grid)
    scale = np.max(np.abs(to_np(expected.re)))
    limit = 1e-4 if "float64" in str(dtype) else 1e-3
    assert np.max(np.abs(to_np(ours.re) - to_np(expected.re))) < limit * scale
    assert np.max(np.abs(to_np(ours.im) - to_np(expected.im))) < limit * scale


# --- what is refused -----------------------------------------------------------------


@pytest.mark.parametrize(
    ("keywords", "error", "match"),
    [
        ({"order": -1}, RangeError, "order"),
        ({"order": 21}, RangeError, "order"),
        ({"order": 20}, FdntValueError, "231 coefficients, and a stamp 144 pixels"),
        ({"scale": 0.0}, RangeError, "scale"),
        ({"scale": float("nan")}, RangeError, "scale"),
        ({"chunk_size": 0}, RangeError, "chunk_size"),
        ({"size": np.ones((2, 2))}, ShapeMismatchError, "size"),
        ({"centroid": np.ones(2)}, ShapeMismatchError, "centroid"),
        ({"eta": [0.0, 0.0]}, FdntTypeError, "eta"),
    ],
)
def test_calls_that_mean_nothing_are_refused(keywords, error, match):
    stamps = np.ones((2, 12, 12))
    with pytest.raises(error, match=match):
        fit_laguerre(stamps, stamps, **{"order": 4, **keywords})


def test_stamps_and_ivar_must_fit_each_other():
    stamps = np.ones((2, 12, 12))
    with pytest.raises(ShapeMismatchError, match="ivar"):
        fit_laguerre(stamps, stamps[:1], order=4)
    with pytest.raises(FdntTypeError, match="ivar"):
        fit_laguerre(stamps, stamps.astype(np.float32), order=4)
    fit = fit_laguerre(stamps, stamps, order=4)
    with pytest.raises(ShapeMismatchError, match="2 galaxies for 1 stamps"):
        filled(stamps[:1], stamps[:1], fit)
