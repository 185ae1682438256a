"""The noise of blank sky: right, robust, and with errors that are the scatter."""

from __future__ import annotations

import numpy as np
import pytest

import fdnt_xp as fx
from fdnt_xp.data.noise import measure_border_noise
from fdnt_xp.data.noise_power import group_error, measure_noise_power, noise_stamps
from fdnt_xp.data.stamps import cube_stamps
from fdnt_xp.errors import FdntValueError, FdntWarning, ShapeMismatchError

SIZE = 24
SIGMA = 3.0


def _white(rng, n, shape=(SIZE, SIZE)):
    return SIGMA * rng.standard_normal((n, *shape))


KERNEL = {(0, 0): 1.0, (0, 1): 0.5, (1, 1): 0.3}
"""Weights by shift along (y, x): no axis is a symmetry."""


def _correlated(rng, n, shape=(SIZE, SIZE)):
    white = rng.standard_normal((n, *shape))
    return sum(w * np.roll(white, shift, axis=(1, 2)) for shift, w in KERNEL.items())


def _known_power(shape=(SIZE, SIZE)):
    ky, kx = (2.0 * np.pi * np.fft.fftfreq(n) for n in shape)
    transform = sum(
        w * np.exp(-1j * (ky[:, None] * y + kx[None, :] * x)) for (y, x), w in KERNEL.items()
    )
    return np.abs(transform) ** 2


def _mirrored(power):
    return power[np.ix_(*[-np.arange(n) % n for n in power.shape])]


# --- what is measured -------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(24, 24), (17, 20), (9, 9)])
def test_white_noise(shape):
    noise = measure_noise_power(_white(np.random.default_rng(1), 300, shape))
    assert noise.is_white
    assert noise.n_stamps + noise.n_rejected == 300
    assert noise.n_rejected <= 3
    assert abs(noise.variance - SIGMA**2) < 4 * noise.variance_err
    least = np.sqrt(2.0 / (noise.n_stamps * np.prod(shape)))
    assert least * 0.99 < noise.relative_err < 1.5 * least
    assert noise.power.shape == noise.power_err.shape == shape
    assert np.mean(noise.power) == noise.variance


@pytest.mark.parametrize("shape", [(24, 24), (17, 20)])
def test_correlated_noise(shape):
    noise = measure_noise_power(_correlated(np.random.default_rng(2), 500, shape))
    known = _known_power(shape)
    assert not noise.is_white
    assert abs(noise.variance - np.mean(known)) < 4 * noise.variance_err
    pull = (noise.power - known) / noise.power_err
    pull[0, 0] = 0.0  # k = 0 is no measurement, but the mean of its neighbours
    assert np.mean(pull**2) == pytest.approx(1.0, abs=4 * np.sqrt(4 / pull.size))
    assert np.max(np.abs(pull)) < 5.5
    assert noise.power[0, 0] == pytest.approx(known[0, 0], rel=0.1)


def test_symmetric_to_the_bit():
    noise = measure_noise_power(_correlated(np.random.default_rng(3), 40, (15, 16)))
    np.testing.assert_array_equal(noise.power, _mirrored(noise.power))
    np.testing.assert_array_equal(noise.power_err, _mirrored(noise.power_err))


def test_the_window_of_a_stamp_is_in_its_power():
    """Noise cut from a larger image is not periodic; its power says so, as it must."""
    image = _correlated(np.random.default_rng(4), 1, (1200, 1200))[0]
    noise = measure_noise_power(noise_stamps(image, (12, 12)))
    lags = np.fft.ifft2(_known_power((1200, 1200))).real
    y, x = (np.arange(-11, 12) for _ in range(2))
    seen = lags[np.ix_(y, x)] * np.outer(12 - abs(y), 12 - abs(x)) / 144
    wrapped = np.zeros((12, 12))
    np.add.at(wrapped, np.ix_(y % 12, x % 12), seen)
    pull = (noise.power - np.fft.fft2(wrapped).real) / noise.power_err
    pull[0, 0] = 0.0
    assert np.mean(pull**2) == pytest.approx(1.0, abs=0.7)


def test_backgrounds_are_no_noise():
    rng = np.random.default_rng(5)
    stamps = _white(rng, 100)
    level = 1e3 + 50.0 * rng.standard_normal((100, 1, 1))
    plain, raised = measure_noise_power(stamps), measure_noise_power(stamps + level)
    np.testing.assert_allclose(raised.power, plain.power, rtol=1e-6)
    assert raised.is_white


@pytest.mark.parametrize("dtype", ["f4", ">f4", ">f8", "i2", "u2"])
def test_numbers_of_any_type(dtype):
    stamps = 1000.0 + 20.0 * _white(np.random.default_rng(6), 60)
    noise = measure_noise_power(stamps.astype(dtype))
    assert noise.variance == pytest.approx(measure_noise_power(stamps).variance, rel=1e-3)


def test_a_weak_correlation_of_neighbours_is_seen():
    """One of 2 % is lost in the scatter of the modes, but not in that of the neighbours."""
    white = np.random.default_rng(7).standard_normal((500, 32, 32))
    assert measure_noise_power(white).is_white
    assert not measure_noise_power(white + 0.02 * np.roll(white, 1, axis=2)).is_white


def test_a_line_is_seen():
    """Interference between two read-outs: one mode in 300, and no neighbours in common."""
    rng = np.random.default_rng(8)
    phase = rng.uniform(0, 2 * np.pi, (300, 1, 1))
    wave = 0.35 * np.cos(2 * np.pi * 7 * np.arange(SIZE) / SIZE + phase) * np.ones((SIZE, 1))
    assert not measure_noise_power(_white(rng, 300) + SIGMA * wave).is_white


# --- errors -----------------------------------------------------------------------------


@pytest.mark.parametrize("draw", [_white, _correlated])
def test_errors_are_the_scatter(draw):
    rng = np.random.default_rng(9)
    n_times = 200
    noises = [measure_noise_power(draw(rng, 50, (16, 16))) for _ in range(n_times)]
    values = np.array([noise.variance for noise in noises])
    errors = np.array([noise.variance_err for noise in noises])
    truth = np.mean(_known_power()) if draw is _correlated else SIGMA**2
    assert abs(np.mean(values) - truth) < 4 * np.std(values) / np.sqrt(n_times)
    # The larger of two errors is a little too large on average.
    assert 0.85 < np.std(values) / np.mean(errors) < 1.1
    assert np.mean([noise.is_white for noise in noises]) == (draw is _white)
    powers = np.stack([noise.power for noise in noises])
    ratio = np.std(powers, axis=0) / np.mean([noise.power_err for noise in noises], axis=0)
    assert np.mean(ratio) == pytest.approx(1.0, abs=0.05)
    for corner in ((0, 8), (8, 0), (8, 8)):
        assert ratio[corner] == pytest.approx(1.0, abs=0.2)


def test_depth_that_varies_is_in_the_error():
    rng = np.random.default_rng(10)
    depth = np.repeat(np.linspace(0.8, 1.2, 400), 1)[:, None, None]
    even = measure_noise_power(_white(rng, 400))
    uneven = measure_noise_power(depth * _white(rng, 400))
    assert uneven.variance_err > 3 * even.variance_err


def test_group_error():
    values = np.random.default_rng(11).standard_normal(10_000)
    assert group_error(values) == pytest.approx(0.01, rel=0.3)
    assert group_error(np.repeat(values[:100], 100)) == pytest.approx(0.1, rel=0.3)
    assert np.isnan(group_error(values[:1]))


# --- stamps that are not blank ----------------------------------------------------------


def _with_galaxies(rng, stamps, share, snr):
    y, x = np.mgrid[:SIZE, :SIZE]
    for i in np.flatnonzero(rng.random(len(stamps)) < share):
        x0, y0 = rng.uniform(4, SIZE - 4, 2)
        galaxy = np.exp(-((x - x0) ** 2 + (y - y0) ** 2) / 2 / 2.0**2)
        stamps[i] += snr * SIGMA * galaxy / np.sqrt(np.sum(galaxy**2))


@pytest.mark.parametrize("snr", [5.0, 10.0, 30.0, 1e4])
def test_a_few_galaxies_change_little(snr):
    rng = np.random.default_rng(12)
    stamps = _white(rng, 400)
    clean = measure_noise_power(stamps)
    _with_galaxies(rng, stamps, 0.05, snr)
    noise = measure_noise_power(stamps)
    # 5 % of S/N 5 make 0.05 * 25 / 24² = 0.2 %, which is their own.
    assert noise.variance == pytest.approx(clean.variance, rel=0.003)
    assert noise.is_white
    if snr >= 10:
        assert noise.n_rejected > 10


def test_cosmic_rays_change_nothing():
    rng = np.random.default_rng(13)
    stamps = _white(rng, 300)
    hit = np.flatnonzero(rng.random(300) < 0.15)
    clean = measure_noise_power(np.delete(stamps, hit, axis=0))
    stamps[hit, 5, 7] += SIGMA * 10 ** rng.uniform(1.1, 4, len(hit))
    noise = measure_noise_power(stamps)
    assert noise.n_rejected >= len(hit) - 1
    assert noise.variance == pytest.approx(clean.variance, rel=1e-3)


def test_bad_pixels_and_dead_stamps_are_left_out():
    stamps = _white(np.random.default_rng(14), 100)
    stamps[3, 2, 2], stamps[50, 0, 0] = np.nan, np.inf
    stamps[7] = 0.0
    clean = measure_noise_power(np.delete(stamps, (3, 7, 50), axis=0))
    noise = measure_noise_power(stamps)
    assert noise.n_rejected == clean.n_rejected + 3
    np.testing.assert_allclose(noise.power, clean.power, rtol=1e-12)


def test_many_stamps_left_out_are_warned_of():
    stamps = _white(np.random.default_rng(15), 100)
    stamps[:40, 0, 0] = np.nan
    with pytest.warns(FdntWarning, match="40 of 100 blank stamps were left out"):
        measure_noise_power(stamps)


# --- what cannot be used ----------------------------------------------------------------


@pytest.mark.parametrize(
    ("stamps", "message"),
    [
        (np.zeros((0, 16, 16)), "0 of 0 blank stamps"),
        (np.random.default_rng(0).standard_normal((9, 16, 16)), "of 9 blank stamps"),
        (np.ones((50, 16, 16)), "0 of 50 blank stamps"),
        (np.full((50, 16, 16), np.nan), "0 of 50 blank stamps"),
    ],
)
def test_no_noise_to_measure(stamps, message):
    with pytest.raises(FdntValueError, match=message):
        measure_noise_power(stamps)


@pytest.mark.parametrize("shape", [(16, 16), (50, 7, 16), (2, 2, 16, 16)])
def test_no_stamps(shape):
    with pytest.raises(ShapeMismatchError, match="blank_stamps"):
        measure_noise_power(np.ones(shape))


def test_stamps_of_an_image():
    image = np.arange(50.0)[:, None] * 100 + np.arange(41)
    stamps = noise_stamps(image, (12, 20))
    assert stamps.shape == (8, 12, 20)
    np.testing.assert_array_equal(stamps[3], image[12:24, 20:40])
    with pytest.raises(ShapeMismatchError, match="no stamp of 60 x 12 pixels fits"):
        noise_stamps(image, (12, 60))
    with pytest.raises(ShapeMismatchError, match="two axes"):
        noise_stamps(stamps, (4, 4))


def test_the_measurement_takes_it():
    rng = np.random.default_rng(16)
    noise = fx.measure_noise_power(_correlated(rng, 100, (32, 32)))
    y, x = np.mgrid[:32, :32] - 15.5
    psf = fx.Psf.from_image(np.exp(-(x**2 + y**2) / 2 / 1.8**2))
    galaxy = 6.0 * np.exp(-(x**2 + y**2) / 2 / 3.0**2)
    stamps = galaxy + _correlated(rng, 20, (32, 32))
    null = fx.population_null(stamps, psf, noise_power=noise.power, noise_error=noise.relative_err)
    assert null.n_used == 20
    assert np.all(np.isfinite(null.g_err_noise_power))


# --- the borders of stamps --------------------------------------------------------------


@pytest.mark.parametrize(("n", "n_times"), [(1, 300), (60, 200)])
def test_border_errors_are_the_scatter(n, n_times):
    rng = np.random.default_rng(17)
    noises = [measure_border_noise(cube_stamps(_white(rng, n, (32, 32)))) for _ in range(n_times)]
    scatter = np.std([noise.variance for noise in noises])
    assert 0.8 < scatter / np.mean([noise.variance_err for noise in noises]) < 1.15
    if n == 1:
        least = SIGMA**2 * np.sqrt(2 / (0.3675 * noises[0].n_pixels))
        assert scatter == pytest.approx(least, rel=0.12)


def test_border_errors_see_bright_neighbours():
    stamps = _white(np.random.default_rng(18), 200)
    even = measure_border_noise(cube_stamps(stamps))
    stamps[::20] += 1e4
    uneven = measure_border_noise(cube_stamps(stamps))
    assert uneven.variance_err > 2 * even.variance_err
