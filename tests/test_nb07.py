"""NB07: what it recovers, its errors, any library, any batch, any bad galaxy."""

from __future__ import annotations

import numpy as np
import pytest
from array_api_extra.testing import assert_close, assert_equal

import fdnt_xp as fx
from fdnt_xp.errors import RangeError
from fdnt_xp.flags import flag_names
from fdnt_xp.peers.drawing import Drawing
from fdnt_xp.peers.nb07 import NB07_METHODS, ConvolvedTests
from fdnt_xp.shapes.laguerre import LaguerreBasis, n_coefficients
from fdnt_xp.shapes.methods import shape_method
from fdnt_xp.shear import add_shears, shear_matrix
from images import galaxies, gaussian_covariance, gaussian_image, star
from tolerances import tolerance

E = np.array([[0.0, 0.0], [0.3, 0.1], [-0.2, 0.45]])
CENTRES = np.array([[0.0, 0.0], [0.4, -0.3], [-1.2, 0.7]])
NOISE = 1e-9
SHAPE = (40, 40)
METHODS = list(NB07_METHODS)


@pytest.fixture
def psf(to_xp, dtype):
    return fx.Psf.from_image(to_xp(star(SHAPE), dtype))


def stamps():
    return galaxies(E, SHAPE, sigma=2.0, centres=CENTRES)


def names(result, row):
    return flag_names(int(result.flags[row]))


def small_star():
    """Return a PSF of which any sum of functions that wide is resolved."""
    return gaussian_image(gaussian_covariance((0.1, -0.06), 1.0), SHAPE)


def seen_sum(b, eta, centre, size):
    """Return one Gauss-Laguerre sum behind `small_star`."""
    drawing = Drawing.through(np, fx.Psf.from_image(small_star()), SHAPE, 4, np.float64)
    order = next(n for n in range(20) if n_coefficients(n) == b.shape[1])
    basis = LaguerreBasis(order=order, eta=eta, centroid=centre, size=size)
    re, im = basis.transform(b, drawing.kx, drawing.ky)
    seen = (re + 1j * im) * drawing.transfer * drawing.phase(centre)
    return drawing.images(seen[:, None, :])[:, 0, :].reshape(-1, *SHAPE)


# --- what comes out --------------------------------------------------------------------


@pytest.mark.parametrize("method", METHODS)
def test_gaussian_galaxies(method, psf, dtype, xp, to_xp):
    shapes = shape_method(method)(to_xp(stamps(), dtype), psf, noise_variance=NOISE)
    assert bool(xp.all(shapes.measured))
    # The basis is as large as the image, so a Gaussian galaxy is a sum that is cut off.
    limits = tolerance("nb07 order 8" if method == "nb07-8" else "nb07 order 12", dtype)
    assert_close(shapes.e, to_xp(E, dtype), **limits, xp=xp)
    assert_close(shapes.centroid, to_xp(19.5 + CENTRES, dtype), **tolerance("centroids", dtype))
    assert shapes.eta.dtype == shapes.eta_cov.dtype == shapes.snr.dtype == dtype
    assert bool(xp.all(shapes.snr > 0))
    assert_equal(shapes.eg, xp.zeros_like(shapes.eg), xp=xp)


def test_what_is_in_the_basis_is_exact(dtype, xp, to_xp):
    # Fourth order, without quadrupole in its own frame: round by the tests, whatever b40 is.
    b = np.zeros((2, n_coefficients(4)))
    b[:, 0], b[:, 3], b[:, 12:] = 1.0, 0.2, [[0.05, -0.08, 0.1], [0.0, 0.1, 0.0]]
    eta, size = np.array([[0.4, -0.1], [0.0, 0.3]]), np.array([2.6, 2.6])
    images = seen_sum(b, eta, CENTRES[1:], size)
    found = shape_method("nb07-8")(
        to_xp(images, dtype), fx.Psf.from_image(to_xp(small_star(), dtype)), size=2.6
    )
    assert_close(found.eta, to_xp(eta, dtype), **tolerance("nb07 exact", dtype), xp=xp)
    assert_close(found.centroid, to_xp(19.5 + CENTRES[1:], dtype), rtol=0, atol=1e-4)
    assert [("SIZE_FIXED" in names(found, i)) for i in range(2)] == [True] * 2


def test_slopes_of_the_tests(xp, to_xp, to_np):
    b = np.zeros((1, n_coefficients(4)))
    b[:, 0], b[:, 3], b[:, 6:9] = 1.0, 0.1, 0.03
    image = seen_sum(b, np.array([[0.3, 0.1]]), CENTRES[:1], np.array([2.5]))
    drawing = Drawing.through(
        xp, fx.Psf.from_image(to_xp(small_star())), SHAPE, 2, to_xp(image).dtype
    )
    tests = ConvolvedTests(
        drawing=drawing,
        order=10,
        pixels=to_xp((image / np.sqrt(np.sum(image**2))).reshape(1, -1)),
        weights=to_xp(np.ones((1, SHAPE[0] * SHAPE[1]))),
        length=to_xp(np.array([2.0])),
        size=to_xp(np.array([2.5])),
    )
    x = np.array([[0.03, -0.02, 0.28, 0.12]])
    _, jac = tests.evaluate(to_xp(x))
    step = 1e-5
    for j in range(4):
        above, below = (tests.evaluate(to_xp(x + s * step * np.eye(4)[j]))[0] for s in (1, -1))
        slope = (to_np(above) - to_np(below)) / (2.0 * step)
        # The galaxy is nearly a sum of the functions, so the residual is next to nothing.
        np.testing.assert_allclose(to_np(jac)[:, :, j], slope, rtol=0, atol=2e-5)


def test_the_shape_follows_a_shear():
    # Without a PSF to speak of, the criterion is the same for a galaxy and its sheared image.
    b = np.zeros((1, n_coefficients(4)))
    b[:, 0], b[:, 3], b[:, 4:6], b[:, 9:12] = 1.0, 0.15, [[0.1, -0.05]], [[0.05, 0.04, 0.03]]
    psf, size, none = fx.Psf.from_image(small_star()), np.array([2.4]), np.zeros((1, 2))
    images = [seen_sum(b, eta, none, size) for eta in (none, np.array([[0.2, 0.1]]))]
    first, second = (shape_method("nb07-12")(i, psf, size=2.4).eta for i in images)
    # A sheared basis turns nothing here: S_eta of the second acts on the first.
    expected = add_shears(np.array([[0.2, 0.1]]), first)
    assert np.abs(first).max() > 0.05
    assert shear_matrix(second) == pytest.approx(shear_matrix(expected), abs=1e-4)


def test_errors_are_those_of_the_scatter():
    rng = np.random.default_rng(3)
    clean = galaxies(np.tile([[0.3, -0.2]], (160, 1)), (32, 32), sigma=2.0)
    sigma = np.sqrt(np.sum(clean[0] ** 2)) / 200.0
    noisy = clean + sigma * rng.standard_normal(clean.shape)
    shapes = shape_method("nb07-8")(noisy, fx.Psf.from_image(star()), noise_variance=sigma**2)
    assert np.all(shapes.measured)
    scatter = np.sqrt(np.cov(shapes.eta.T).diagonal())
    reported = np.sqrt(np.mean(shapes.eta_cov, axis=0).diagonal())
    np.testing.assert_allclose(reported, scatter, rtol=0.16)


# --- one galaxy, many galaxies, other galaxies -----------------------------------------


def test_libraries_agree(xp, to_xp):
    rng = np.random.default_rng(8)
    images = stamps() + 2e-5 * rng.standard_normal((3, *SHAPE))
    expected = shape_method("nb07")(images, fx.Psf.from_image(star(SHAPE)), noise_variance=1e-9)
    psf = fx.Psf.from_image(to_xp(star(SHAPE)))
    found = shape_method("nb07")(to_xp(images), psf, noise_variance=1e-9)
    assert_close(found.eta, to_xp(expected.eta), rtol=0, atol=1e-7, xp=xp)
    assert_close(found.eta_cov, to_xp(expected.eta_cov), rtol=1e-6, atol=1e-12, xp=xp)
    assert_equal(found.flags, to_xp(expected.flags), xp=xp)


def test_alone_or_together_and_beside_the_bad(dtype, xp, to_xp, to_np):
    clean = stamps()
    bad = [np.full(SHAPE, np.nan), np.zeros(SHAPE), -clean[0]]
    mixed = np.stack([bad[0], clean[0], bad[1], clean[1], bad[2], clean[2]])
    psf = fx.Psf.from_image(to_xp(star(SHAPE), dtype))
    together = shape_method("nb07")(to_xp(mixed, dtype), psf, chunk_size=4)
    assert to_np(together.measured).tolist() == [False, True] * 3
    for i in range(3):
        alone = shape_method("nb07")(to_xp(clean[i : i + 1], dtype), psf)
        limits = tolerance("nb07 batch", dtype)
        assert_close(together.eta[2 * i + 1, :], alone.eta[0, :], **limits, xp=xp)
    assert names(together, 0) == ["NON_FINITE_PIXEL"]
    assert "NO_SIGNAL" in names(together, 2)


def test_pure_noise_raises_nothing(psf, dtype, to_xp, to_np):
    images = to_xp(np.random.default_rng(4).standard_normal((4, *SHAPE)), dtype)
    shapes = shape_method("nb07")(images, psf, noise_variance=1.0)
    measured = to_np(shapes.measured)
    assert np.array_equal(np.isfinite(to_np(shapes.eta[:, 0])), measured)


def test_an_empty_batch(psf, dtype, to_xp):
    assert shape_method("nb07")(to_xp(np.empty((0, *SHAPE)), dtype), psf).n_gal == 0


def test_bad_calls(psf, dtype, to_xp):
    with pytest.raises(RangeError):
        shape_method("nb07")(to_xp(stamps(), dtype), psf, padding=0)


def test_a_ring_takes_any_method():
    pytest.importorskip("galsim")
    from fdnt_xp.data.profiles import gaussian_psf, sersic

    for method in ("nb07", "exponential"):
        ring = fx.ring_test(
            sersic(1.0, 3.0, (0.3, 0.0)),
            gaussian_psf(2.0),
            0.04,
            method=method,
            estimators=("eg+cubic",),
            n_angles=8,
            stamp_size=48,
            errors=False,
        )
        assert ring.n_failed == 0
        assert ring.eg == 0.0
        # The exponential is right, NB07 nearly so.
        assert abs(ring.biases["eg+cubic"].m) < (1e-2 if method == "nb07" else 1e-4)
