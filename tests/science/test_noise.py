"""The covariance of eta is the scatter of eta."""

from __future__ import annotations

import galsim
import numpy as np
import pytest

import fdnt_xp as fx
from fdnt_xp.data.noise_power import noise_stamps
from fdnt_xp.data.profiles import gaussian_psf, torture
from science.galsim_images import psf_image

N_DRAWS = 2000


@pytest.mark.parametrize("snr", [100.0, 200.0])
@pytest.mark.parametrize("size", [None, 2.0])
def test_scatter_is_what_the_covariance_says(snr, size):
    psf = galsim.Moffat(beta=3, fwhm=3.0).shear(e=0.1, beta=40 * galsim.degrees)
    galaxy = galsim.Sersic(1.0, half_light_radius=3.0).shear(e1=0.25, e2=-0.2).shift(0.3, 0.1)
    clean = galsim.Convolve([galaxy, psf]).drawImage(nx=48, ny=48, scale=1.0, dtype=float).array
    sigma = np.sqrt(np.sum(clean**2)) / snr
    rng = np.random.default_rng(20260 + int(snr))
    stamps = clean + sigma * rng.standard_normal((N_DRAWS, 48, 48))
    star = fx.Psf.from_image(psf_image(psf, "auto", n=48))
    shapes = fx.measure_shapes(stamps, star, noise_variance=sigma**2, size=size)
    assert np.all(shapes.measured)
    scatter = np.cov(shapes.eta.T)
    predicted = np.mean(shapes.eta_cov, axis=0)
    # 2000 draws fix a standard deviation to 1.6 %.
    np.testing.assert_allclose(np.sqrt(np.diag(scatter)), np.sqrt(np.diag(predicted)), rtol=0.05)
    correlation = predicted[0, 1] / np.sqrt(predicted[0, 0] * predicted[1, 1])
    assert scatter[0, 1] / np.sqrt(scatter[0, 0] * scatter[1, 1]) == pytest.approx(
        correlation, abs=0.08
    )
    if size is not None:
        # snr is the significance under a given weight: a free size scatters the flux more.
        error = np.mean(shapes.flux / shapes.snr)
        assert np.std(shapes.flux) / error == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("angle", [0.0, 50.0])
def test_a_lopsided_galaxy_scatters_as_the_covariance_says(angle):
    # Its free width adds noise to the dipoles that the covariance leaves out.
    psf = gaussian_psf(2.0)
    galaxy = torture().rotate(angle * galsim.degrees)
    seen = galsim.Convolve([galaxy, psf])
    clean = seen.drawImage(nx=96, ny=96, scale=1.0, method="no_pixel", dtype=float).array
    sigma = np.sqrt(np.sum(clean**2)) / 100.0
    rng = np.random.default_rng(50)
    star = fx.Psf.from_image(psf_image(psf, "no_pixel", n=96))
    parts = [
        fx.measure_shapes(
            clean + sigma * rng.standard_normal((500, 96, 96)), star, noise_variance=sigma**2
        )
        for _ in range(N_DRAWS // 500)
    ]
    eta = np.concatenate([part.eta for part in parts])
    predicted = np.mean(np.concatenate([part.eta_cov for part in parts]), axis=0)
    assert np.all(np.isfinite(eta))
    np.testing.assert_allclose(np.std(eta, axis=0), np.sqrt(np.diag(predicted)), rtol=0.05)


def smoothed_noise(rng, n, size):
    """Return stamps cut from GalSim's noise of variance 1, correlated as resampling does it."""
    noise = galsim.UncorrelatedNoise(1.0, rng=rng, scale=1.0)
    noise = noise.convolvedWith(galsim.Gaussian(sigma=0.8).shear(e1=0.3)).withVariance(1.0)
    side = int(np.ceil(np.sqrt(n)))
    image = galsim.ImageD(side * size, side * size, scale=1.0)
    image.addNoise(noise)
    return noise_stamps(image.array, (size, size))


def test_correlated_noise_scatters_as_the_covariance_says():
    size = 32
    rng = galsim.BaseDeviate(2031)
    spectrum = fx.measure_noise_power(smoothed_noise(rng, 1600, size))
    assert not spectrum.is_white
    psf = galsim.Moffat(beta=3, fwhm=2.5).shear(e=0.1, beta=40 * galsim.degrees)
    galaxy = galsim.Sersic(1.0, half_light_radius=1.8).shear(e1=0.25, e2=-0.2).shift(0.3, 0.1)
    clean = galsim.Convolve([galaxy, psf]).drawImage(nx=size, ny=size, scale=1.0, dtype=float)
    sigma = np.sqrt(np.sum(clean.array**2)) / 200.0  # that of white noise: 70 here
    stamps = clean.array + sigma * smoothed_noise(rng, N_DRAWS, size)
    star = fx.Psf.from_image(psf_image(psf, "auto", n=48))
    shapes = fx.measure_shapes(stamps, star, noise_power=sigma**2 * spectrum.power)
    assert np.all(shapes.measured)
    scatter = np.std(shapes.eta, axis=0)
    predicted = np.mean(shapes.eta_cov, axis=0)
    np.testing.assert_allclose(scatter, np.sqrt(np.diag(predicted)), rtol=0.05)
    # Taken for white it would be far from that.
    white = fx.measure_shapes(stamps[:100], star, noise_variance=sigma**2)
    assert np.all(scatter > 1.5 * np.sqrt(np.mean(white.eta_cov[:, [0, 1], [0, 1]], axis=0)))
