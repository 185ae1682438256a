"""Noise made round: against draws of pixel noise, and against sums over the star itself."""

from __future__ import annotations

import math

import numpy as np
import pytest
from array_api_extra.testing import assert_close

import fdnt_xp as fx
from fdnt_xp.fourier.grid import half_plane_disc
from fdnt_xp.fourier.noise import DeconvolvedNoise, PixelNoise, RoundNoise
from fdnt_xp.fourier.transform import deconvolve
from fdnt_xp.shear import shear_matrix
from images import gaussian_covariance, gaussian_image
from tolerances import tolerance

N = 32
REACH = 1.1
GAMMAS = [(0.0, 0.0), (0.1, 0.0), (-0.06, 0.12)]
each_gamma = pytest.mark.parametrize("gamma", GAMMAS, ids=str)


def very_elliptical_star():
    return gaussian_image(gaussian_covariance((0.3, 0.2), 1.4), (N, N))


def correlated(rng, n, kernel):
    """Return noise convolved, periodically, with a kernel, and its power spectrum."""
    transform = np.fft.fft2(kernel, s=(N, N))
    white = rng.standard_normal((n, N, N))
    return np.fft.ifft2(np.fft.fft2(white) * transform).real, np.abs(transform) ** 2


KERNEL = np.array([[0.7, 0.5], [0.2, -0.3]])
"""Correlates along one diagonal more than along the other."""


class Setting:
    """One PSF, its noise and a frame, on NumPy."""

    def __init__(self, gamma, pixels):
        self.gamma = gamma
        self.psf = fx.Psf.from_image(very_elliptical_star()).ending_at(1e-3)
        self.grid = half_plane_disc(
            np, (N, N), self.psf.largest_kmax, dtype=np.float64, device="cpu"
        )
        self.inverse = self.psf.inverse_transfer(self.grid)
        self.noise = DeconvolvedNoise.behind(self.psf, pixels, self.grid, self.inverse)
        self.frame = self.grid.sheared(np.asarray(gamma))
        self.round = self.noise.made_round(self.frame, gamma, REACH)[0]
        self.kappa = np.hypot(self.frame.kx, self.frame.ky)
        self.inside = self.kappa < self.psf.largest_kmax / REACH


def white(n=1):
    return PixelNoise(variance=np.ones(n))


# --- V_iso ---------------------------------------------------------------------------


@each_gamma
def test_it_is_the_largest_power_on_each_circle(gamma):
    setting = Setting(gamma, white())
    star = very_elliptical_star()
    star = star / star.sum()
    y, x = np.mgrid[:N, :N]
    back = np.linalg.inv(shear_matrix(np.asarray(gamma)))
    angles = np.linspace(0.0, np.pi, 360, endpoint=False)
    for mode in np.flatnonzero(setting.inside)[::29]:
        circle = back @ (setting.kappa[mode] * np.stack([np.cos(angles), np.sin(angles)]))
        waves = np.exp(-1j * (circle[0][:, None, None] * x + circle[1][:, None, None] * y))
        largest = np.max(N * N / np.abs(np.sum(star * waves, axis=(1, 2))) ** 2)
        assert setting.round[mode] / largest == pytest.approx(1.004, abs=0.002)


@each_gamma
def test_it_depends_on_the_radius_alone_and_lies_above_the_noise(gamma):
    setting = Setting(gamma, white())
    order = np.argsort(setting.kappa[setting.inside])
    value = np.log(setting.round[setting.inside][order])
    # A Gaussian's noise grows as exp(r²/scale²): one smooth curve of r² for all directions.
    radius = setting.kappa[setting.inside][order] ** 2
    fit = np.polynomial.Polynomial.fit(radius, value, 6)
    assert np.max(np.abs(value - fit(radius))) < 1e-3
    missing = (setting.round - setting.noise.power[0])[setting.inside]
    assert np.all(missing > 0)


def test_the_libraries_agree(xp, dtype, device, to_xp, to_np):
    gamma = (-0.06, 0.12)
    host = Setting(gamma, white())
    psf = fx.Psf.from_image(to_xp(very_elliptical_star(), dtype)).ending_at(1e-3)
    grid = half_plane_disc(xp, (N, N), host.psf.largest_kmax, dtype=dtype, device=device)
    noise = DeconvolvedNoise.behind(
        psf,
        PixelNoise(variance=to_xp(np.ones(1), dtype)),
        grid,
        psf.inverse_transfer(grid),
    )
    frame = grid.sheared(to_xp(np.asarray(gamma), dtype))
    ours = noise.made_round(frame, gamma, REACH)
    assert ours.dtype == dtype
    ratio = to_np(ours)[0, host.inside] / host.round[host.inside]
    np.testing.assert_allclose(ratio, 1.0, **tolerance("noise made round", dtype))


def test_a_psf_for_each_galaxy():
    stars = np.stack(
        [gaussian_image(gaussian_covariance(e, 1.4), (N, N)) for e in ((0.3, 0.2), (0.0, -0.1))]
    )
    gamma = (0.1, 0.0)
    psfs = fx.Psf.from_image(stars).ending_at(1e-3)
    grid = half_plane_disc(np, (N, N), psfs.largest_kmax, dtype=np.float64, device="cpu")
    frame = grid.sheared(np.asarray(gamma))
    noise = DeconvolvedNoise.behind(psfs, white(2), grid, psfs.inverse_transfer(grid))
    together = noise.made_round(frame, gamma, REACH)
    for i in (0, 1):
        psf = psfs.take(np.array([i]))
        alone = DeconvolvedNoise.behind(psf, white(), grid, psf.inverse_transfer(grid))
        np.testing.assert_allclose(
            alone.made_round(frame, gamma, REACH)[0], together[i], rtol=1e-10
        )


# --- what is added -------------------------------------------------------------------


def noise_in_frame(setting, stamps, seed):
    """Return the noise of stamps in a frame, with what makes it round added; complex."""
    n = len(stamps)
    galaxies = deconvolve(stamps, setting.inverse, setting.grid)
    synthetic = RoundNoise.draw(np.arange(n), seed, np.ones(n), setting.grid)
    made = synthetic.added_to(galaxies, setting.round[None, :] - setting.noise.power)
    return made.re + 1j * made.im


@pytest.mark.parametrize("kernel", [None, KERNEL], ids=["white", "correlated"])
@each_gamma
def test_the_sum_has_the_round_power(gamma, kernel):
    rng = np.random.default_rng(5)
    n = 1500
    if kernel is None:
        setting, stamps = Setting(gamma, white()), rng.standard_normal((n, N, N))
    else:
        stamps, power = correlated(rng, n, kernel)
        pixels = PixelNoise.of_power(power[None], 1)
        setting = Setting(gamma, pixels)
        assert pixels.variance[0] == pytest.approx(np.sum(kernel**2))
        sigma = math.sqrt(pixels.variance[0])
        stamps = stamps / sigma  # the power of DeconvolvedNoise is for unit variance
    modes = noise_in_frame(setting, stamps, seed=2)
    inside = setting.inside & (setting.grid.kx != 0)
    ratio = np.mean(np.abs(modes) ** 2, axis=0)[inside] / setting.round[inside]
    # |n|² is exponential: each mode is known to n^-1/2, the mean of all to (n n_k)^-1/2.
    assert np.mean(ratio) == pytest.approx(1.0, abs=4.0 / math.sqrt(n * inside.sum()))
    assert np.max(np.abs(ratio - 1.0)) < 5.0 / math.sqrt(n)
    # Round: no harmonic of the angle that a spin-2 quantity would see.
    angle = 2.0 * np.arctan2(setting.frame.ky, setting.frame.kx)[inside]
    for harmonic in (np.cos(angle), np.sin(angle)):
        assert abs(np.mean((ratio - 1.0) * harmonic)) < 4.0 / math.sqrt(2.0 * n * inside.sum())
    # As it came it was not: the test can fail.
    before = setting.noise.power[0, inside] / setting.round[inside]
    before = before - np.mean(before)
    assert np.hypot(np.mean(before * np.cos(angle)), np.mean(before * np.sin(angle))) > 0.02


@pytest.mark.parametrize("padding", [1, 2])
def test_power_on_the_modes_is_that_of_the_spectrum(padding, xp, dtype, device, to_xp, to_np):
    _, power = correlated(np.random.default_rng(0), 1, KERNEL)
    pixels = PixelNoise.of_power(to_xp(power[None], dtype), 3)
    assert pixels.variance.shape == (3,)
    grid = half_plane_disc(xp, (padding * N, padding * N), 2.0, dtype=dtype, device=device)
    transform = np.fft.rfft2(KERNEL, s=grid.shape).ravel()[to_np(grid.index)]
    expected = np.abs(transform) ** 2 / np.sum(KERNEL**2)
    assert_close(
        pixels.relative_power(grid)[0, :],
        to_xp(expected, dtype),
        rtol=0,
        atol=1e-12 if "64" in str(dtype) else 1e-5,
        xp=xp,
    )


def test_quarter_turns_and_signs(to_np):
    grid = half_plane_disc(np, (N, N), 2.0, dtype=np.float64, device="cpu")
    symmetry = np.arange(8)
    drawn = RoundNoise.draw(np.full(8, 3), 1, np.ones(8), grid, symmetry)
    # Any image will do to turn the modes by turning its pixels; y is up, so counter-clockwise
    # is clockwise to NumPy.
    image = np.random.default_rng(0).standard_normal((1, N, N))
    one = np.ones((1, grid.n_k), dtype=complex)
    straight = deconvolve(image, one, grid)
    source, sign = grid.quarter_turn
    turned = deconvolve(np.ascontiguousarray(np.rot90(image, -1, axes=(1, 2))), one, grid)
    np.testing.assert_allclose(straight.re[0][source], turned.re[0], atol=1e-11)
    np.testing.assert_allclose(sign * straight.im[0][source], turned.im[0], atol=1e-11)
    for i in range(1, 4):
        np.testing.assert_array_equal(drawn.re[i], drawn.re[i - 1][source])
        np.testing.assert_array_equal(drawn.im[i], sign * drawn.im[i - 1][source])
    np.testing.assert_array_equal(drawn.re[4:], -drawn.re[:4])
    np.testing.assert_array_equal(drawn.im[4:], -drawn.im[:4])
