"""Noise that is correlated between pixels: errors of shapes, and spectra that are none.

What noise does to a shape is `g C gᵀ`, with g the derivative of eta by each pixel, which is
taken here by differences, and C the covariance of the pixels.
"""

from __future__ import annotations

import galsim
import numpy as np
import pytest
from array_api_extra.testing import assert_close

import fdnt_xp as fx
from fdnt_xp.data.noise_power import noise_stamps
from fdnt_xp.errors import FdntValueError, NamespaceError, ShapeMismatchError
from fdnt_xp.flags import flag_names
from fdnt_xp.shears.sample import NoiseOptions, make_sample
from images import galaxies, star
from tolerances import tolerance

N = 28
E = np.array([[0.25, -0.2], [0.0, 0.1], [0.5, 0.3]])
RADII = (1.2, 0.7)
"""Of the smoothing along x and y, pixels."""


def correlation(lag_y, lag_x):
    """Return the correlation function of white noise smoothed by a Gaussian."""
    return np.exp(-0.25 * ((lag_x / RADII[0]) ** 2 + (lag_y / RADII[1]) ** 2))


def covariance(n=N):
    """Return the covariance of the pixels of a stamp, row by row; shape (n², n²)."""
    y, x = (i.ravel() for i in np.indices((n, n)))
    return correlation(y[:, None] - y, x[:, None] - x)


def power(n=N):
    """Return `E|FFT|²/n²` of stamps of such noise: pair of pixels by pair of pixels."""
    waves = np.exp(-2j * np.pi * np.outer(np.arange(n), np.arange(n)) / n)
    both = np.kron(waves, waves)
    expected = np.sum((both @ covariance(n)) * both.conj(), axis=1).real.reshape(n, n) / n**2
    return 0.5 * (expected + np.roll(np.flip(expected), (1, 1), axis=(0, 1)))


@pytest.fixture(scope="module")
def sample():
    return galaxies(E, (N, N), sigma=1.6, centres=np.array([[0.2, -0.1], [0.0, 0.3], [0, 0]]))


@pytest.fixture(scope="module")
def psf():
    return fx.Psf.from_image(star((N, N)))


@pytest.mark.parametrize("options", [{}, {"padding": 2}, {"transform": "gl"}], ids=str)
def test_errors_are_those_of_the_noise_of_the_pixels(options, sample, psf):
    stamp = sample[0]
    step = 1e-4 * np.max(stamp)
    moved = step * np.eye(N * N).reshape(-1, N, N)
    up, down = (fx.measure_shapes(stamp + sign * moved, psf) for sign in (1.0, -1.0))
    by_pixel = (up.eta - down.eta).T / (2.0 * step)
    expected = by_pixel @ covariance() @ by_pixel.T
    shapes = fx.measure_shapes(stamp[None], psf, noise_power=power(), **options)
    error = np.sqrt(np.diag(expected))
    # The weight ends a little beyond the stamp. The derivatives are those of the coarse grid
    # and of the stamp, not of a fit to it.
    atol = 2e-3 if options else 1e-4
    np.testing.assert_allclose(
        shapes.eta_cov[0] / np.outer(error, error),
        expected / np.outer(error, error),
        rtol=0,
        atol=atol,
    )
    white = fx.measure_shapes(stamp[None], psf, noise_variance=1.0)
    assert np.all(np.diag(white.eta_cov[0]) < 0.5 * np.diag(expected))


def test_the_noise_of_the_frames_is_that_of_the_pixels(sample, psf):
    # Flux under a fixed weight is linear in the pixels but for the centroid, which a symmetric
    # galaxy does not feel: its variance is g C gᵀ.
    stamp = galaxies(np.array([[0.2, -0.1]]), (N, N), sigma=1.6)[0]
    step = 1e-4 * np.max(stamp)
    moved = step * np.eye(N * N).reshape(-1, N, N)
    size = 1.8
    up, down = (
        fx.measure_responses(stamp + sign * moved, psf, size=size).flux[:, 0]
        for sign in (1.0, -1.0)
    )
    by_pixel = (up - down) / (2.0 * step)
    expected = np.sqrt(by_pixel @ covariance() @ by_pixel)
    seen = fx.measure_responses(stamp[None], psf, size=size, noise_power=power(), isotropise=False)
    # With the window of the stamp in it, the noise comes out 2 % low.
    np.testing.assert_allclose(seen.flux[0, 0] / seen.snr[0, 0], expected, rtol=1e-3)


def test_the_spectrum_that_the_frames_see_is_that_of_the_noise():
    # GalSim's correlated noise and its correlation function, through all of `population_null`.
    size, largest = 32, 12
    model = galsim.UncorrelatedNoise(1.0, rng=galsim.BaseDeviate(5), scale=1.0)
    model = model.convolvedWith(galsim.Gaussian(sigma=0.8).shear(e1=0.3)).withVariance(1.0)
    image = galsim.ImageD(40 * size, 40 * size, scale=1.0)
    image.addNoise(model)
    spectrum = fx.measure_noise_power(noise_stamps(image.array, (size, size))).power
    n_lag = 2 * largest + 1
    lags = model.drawImage(galsim.ImageD(n_lag, n_lag), scale=1.0).array.ravel()
    sample = make_sample(
        np.zeros((1, size, size)),
        fx.Psf.from_image(star((size, size))),
        statistic="frozen",
        weight=None,
        size=1.5,
        softening=1.0,
        max_shear=0.1,
        padding=1,
        chunk_size=None,
        noise=NoiseOptions(noise_power=spectrum),
    )
    grid = sample.job.coarse
    y, x = (i.ravel() - largest for i in np.indices((n_lag, n_lag)))
    expected = np.cos(np.outer(grid.kx, x) + np.outer(grid.ky, y)) @ lags
    seen = sample.noise.pixels.relative_power(grid)[0] * sample.noise.pixels.variance[0]
    radius = np.hypot(grid.kx, grid.ky)
    for low, high in ((0.0, 0.6), (0.6, 1.2), (1.2, 1.8)):
        ring = (radius >= low) & (radius < high)
        # Each mode is known to 2.5 %; the window made 5 % of those in the middle.
        error = 0.025 / np.sqrt(ring.sum())
        ratio = np.sum(seen[ring]) / np.sum(expected[ring])
        assert ratio == pytest.approx(1.0, abs=4.0 * error), (low, high)


def test_the_flux_under_a_fixed_weight(sample, psf):
    stamp = sample[0]
    options = {"size": 1.7, "noise_power": power()}
    shape = fx.measure_shapes(stamp[None], psf, **options)
    # With eta and centroid where they are, flux is linear: white noise gives the norm of g.
    rng = np.random.default_rng(5)
    root = np.linalg.cholesky(covariance() + 1e-9 * np.eye(N * N))
    noise = 1e-4 * np.max(stamp) * (rng.standard_normal((1500, N * N)) @ root.T).reshape(-1, N, N)
    noisy = fx.measure_shapes(stamp + np.concatenate([noise, -noise]), psf, size=1.7)
    scatter = np.std(noisy.flux) / (1e-4 * np.max(stamp))
    assert scatter == pytest.approx(float(shape.flux[0] / shape.snr[0]), rel=0.05)


def test_a_white_spectrum_is_a_variance(sample, xp, dtype, to_xp):
    stamps = to_xp(sample, dtype)
    psf = fx.Psf.from_image(to_xp(star((N, N)), dtype))
    variances = np.array([1e-6, 4e-6, 2e-6])
    flat = to_xp(np.broadcast_to(variances[:, None, None], (3, N, N)).copy(), dtype)
    for transform in ("ft", "gl", "hybrid"):
        white = fx.measure_shapes(
            stamps, psf, noise_variance=to_xp(variances, dtype), transform=transform
        )
        by_power = fx.measure_shapes(stamps, psf, noise_power=flat, transform=transform)
        rtol = 1e-3 if "32" in str(dtype) else 1e-9
        if transform == "gl":
            rtol = 3e-3  # functions that reach out of the stamp a little
        assert_close(by_power.eta_cov, white.eta_cov, rtol=rtol, atol=1e-9, xp=xp)
        assert_close(by_power.snr, white.snr, rtol=rtol, xp=xp)
        assert_close(by_power.eta, white.eta, **tolerance("batch", dtype), xp=xp)


@pytest.mark.parametrize("transform", ["ft", "gl"])
def test_one_spectrum_for_each_and_chunks(transform, sample, psf):
    one = power()
    factors = np.array([1.0, 3.0, 0.5])
    together = fx.measure_shapes(sample, psf, noise_power=one, transform=transform)
    each = fx.measure_shapes(
        sample,
        psf,
        noise_power=one * factors[:, None, None],
        transform=transform,
        chunk_size=2,
    )
    np.testing.assert_allclose(
        each.eta_cov, together.eta_cov * factors[:, None, None], rtol=1e-7, atol=1e-12
    )
    shared = fx.Psf.from_image(star((N, N))[None], psf_index=np.zeros(3, dtype=np.int64))
    again = fx.measure_shapes(sample, shared, noise_power=one, transform=transform)
    np.testing.assert_allclose(again.eta_cov, together.eta_cov, rtol=1e-9)


def test_noise_does_not_know_of_the_sky(sample, psf):
    # Mirrored pixels: the errors are those of the pixels, with the sign of eta2 changed.
    plain = fx.measure_shapes(sample, psf, noise_power=power())
    sky = fx.measure_shapes(sample, psf, noise_power=power(), jacobian=np.diag([-1.0, 1.0]))
    moved = np.diag([1.0, -1.0])
    np.testing.assert_allclose(sky.eta_cov, moved @ plain.eta_cov @ moved, rtol=1e-7, atol=1e-9)


def test_an_elongated_galaxy_on_the_fine_grid(psf):
    stamp = galaxies(np.array([[0.0, -0.92]]), (N, N), sigma=1.9)
    shapes = fx.measure_shapes(stamp, psf, noise_power=power())
    assert "FINE_GRID" in flag_names(int(shapes.flags[0]))
    fine = fx.measure_shapes(stamp, psf, noise_power=power(), padding=2)
    np.testing.assert_allclose(
        np.diagonal(shapes.eta_cov[0]), np.diagonal(fine.eta_cov[0]), rtol=0.01
    )


def test_calls_that_mean_nothing(sample, to_xp):
    stamps, psf = to_xp(sample), fx.Psf.from_image(to_xp(star((N, N))))

    def measure(spectrum, **options):
        return fx.measure_shapes(stamps, psf, noise_power=to_xp(spectrum), **options)

    good = np.ones((N, N))
    for shape in ((N, N - 1), (2, N, N), (1, N, N), (N,)):
        with pytest.raises(ShapeMismatchError, match="noise_power must have the shape"):
            measure(np.ones(shape))
    bad = [-good, 0.0 * good, np.where(np.eye(N) > 0, np.nan, good)]
    bad.append(np.stack([good, 0.0 * good, good]))
    for spectrum in bad:
        with pytest.raises(FdntValueError, match="finite, not negative, and not all 0"):
            measure(spectrum)
    with pytest.raises(FdntValueError, match="k and -k"):
        measure(np.arange(float(N * N)).reshape(N, N))
    for other in ({"noise_variance": 1.0}, {"ivar": to_xp(np.ones((3, N, N)))}):
        with pytest.raises(FdntValueError, match="noise_power cannot be given with"):
            measure(good, **other)
    with pytest.raises(NamespaceError, match="noise_power"):
        fx.measure_shapes(stamps, psf, noise_power=to_xp(good, "float32"))
    assert fx.measure_shapes(stamps[:0, ...], psf, noise_power=to_xp(good)).n_gal == 0
