"""Frames of trial shears on the sky: the algebra, noise made round there, and bad Jacobians."""

from __future__ import annotations

import numpy as np
import pytest
from array_api_extra.testing import assert_close

import fdnt_xp as fx
from fdnt_xp.errors import FdntTypeError, FdntValueError, NamespaceError, ShapeMismatchError
from fdnt_xp.flags import flag_names
from fdnt_xp.fourier.grid import half_plane_disc
from fdnt_xp.fourier.noise import DeconvolvedNoise, PixelNoise
from fdnt_xp.fourier.sky_grid import SkyGrid
from fdnt_xp.shear import shear_matrix
from fdnt_xp.shears.sample import default_size
from images import galaxies, gaussian_covariance, gaussian_image, star
from tolerances import tolerance

N = 40
MATRICES = np.array([[[1.1, 0.2], [-0.1, 0.9]], [[0.0, 1.0], [1.0, 0.0]], [[1.3, 0.0], [0.4, 1.1]]])
SHAPES = np.array([[0.2, 0.1], [-0.3, 0.2], [0.1, -0.25], [0.0, 0.0]])


# --- the grid ---------------------------------------------------------------------------


@pytest.mark.parametrize("rows", [[0], [0, 1, 2]])
def test_moments_are_those_by_the_other_wave_numbers(rows):
    plain = half_plane_disc(np, (N, N), 2.2, dtype=np.float64, device="cpu")
    k = np.stack([plain.kx, plain.ky])
    grid = SkyGrid.of(plain, MATRICES[rows])
    field = np.random.default_rng(1).standard_normal((3, plain.n_k))
    kappa = np.broadcast_to(MATRICES[rows] @ k, (3, 2, plain.n_k))
    for degrees in ((0, 2, 4), (1, 3), (4,)):
        expected = [
            np.sum(plain.fold * field * kappa[:, 0] ** (d - j) * kappa[:, 1] ** j, axis=1)
            for d in degrees
            for j in range(d + 1)
        ]
        expected = np.stack(expected, axis=-1)
        scale = np.max(np.abs(expected))
        np.testing.assert_allclose(grid.moments(field, *degrees), expected, atol=1e-13 * scale)
    np.testing.assert_allclose(grid.radius, np.hypot(*np.moveaxis(MATRICES[rows] @ k, 1, 0)))


def test_positions_go_along(xp, dtype, device, to_xp):
    plain = half_plane_disc(xp, (N, N), 2.2, dtype=dtype, device=device)
    grid = SkyGrid.of(plain, to_xp(MATRICES, dtype))
    there = to_xp(np.array([[1.0, 2.0], [-3.0, 0.5], [0.0, 4.0]]), dtype)
    stamp = grid.on_stamp(there)
    # kappa.x' = k.x
    k = np.array([0.3, -1.2])
    kappa = MATRICES @ k
    phase = np.sum(kappa * np.array([[1.0, 2.0], [-3.0, 0.5], [0.0, 4.0]]), axis=1)
    seen = stamp[:, 0] * 0.3 - stamp[:, 1] * 1.2
    assert_close(seen, to_xp(phase, dtype), **tolerance("algebra", dtype), xp=xp)
    back = grid.from_stamp(stamp)
    assert_close(back, there, rtol=1e-5, atol=1e-5, xp=xp)
    assert int(grid.take(slice(1, 3)).matrix.shape[0]) == 2


# --- noise ------------------------------------------------------------------------------


@pytest.mark.parametrize("correlated", [False, True])
def test_noise_is_made_round_on_the_sky(correlated):
    # On each circle of the counter-sheared sky the largest of N P/|T|², by direct sums.
    jacobian = np.array([[[1.15, 0.2], [0.05, 0.9]]])
    image = gaussian_image(gaussian_covariance((0.2, 0.1), 1.5), (N, N))
    psf = fx.Psf.from_image(image).through(jacobian, unit_length=1.0).ending_at(1e-3)
    plain = half_plane_disc(np, (N, N), psf.largest_kmax, dtype=np.float64, device="cpu")
    lags = np.arange(N) - N // 2
    correlation = np.zeros((N, N))
    correlation[N // 2, N // 2] = 1.0
    pixels = PixelNoise(variance=np.ones(1))
    if correlated:
        correlation = np.exp(-0.5 * (lags[:, None] ** 2 + 2.0 * lags[None, :] ** 2) / 0.6)
        pixels = PixelNoise(variance=np.ones(1), correlation=correlation[None])
    noise = DeconvolvedNoise.behind(psf, pixels, plain, psf.inverse_transfer(plain))
    gamma, reach = (0.06, -0.05), 1.1
    matrix = shear_matrix(np.array(gamma)) @ np.linalg.inv(jacobian[0]).T
    frame = SkyGrid.of(plain, matrix[None])
    level = noise.made_round(frame, gamma, reach)[0]
    inside = np.flatnonzero((frame.radius[0] < psf.kmax[0] / reach) & (frame.radius[0] > 0.2))[::9]
    angle = np.pi * np.arange(180) / 180.0
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    k = frame.radius[0][inside][:, None, None] * (circle @ np.linalg.inv(matrix).T)

    def power(pixels):
        along = [np.exp(-1j * k[..., i, None] * lags) for i in (0, 1)]
        return np.abs(np.einsum("rai,ij,raj->ra", along[1], pixels, along[0]))

    direct = np.max(N**2 * power(correlation) / power(image) ** 2, axis=1)
    # 0.4 % above, for what lies between the directions.
    np.testing.assert_allclose(level[inside], 1.004 * direct, rtol=2e-3)
    # It is not what would be round on the pixels.
    on_pixels = noise.made_round(plain.sheared(np.array(gamma)), gamma, reach)[0]
    assert np.max(np.abs(np.log(on_pixels[inside] / level[inside]))) > 0.1


# --- samples ----------------------------------------------------------------------------


def sample(xp_of, dtype=None):
    stamps = galaxies(SHAPES, (N, N), sigma=1.7)
    given = (stamps,) if dtype is None else (stamps, dtype)
    stars = (star((N, N)),) if dtype is None else (star((N, N)), dtype)
    return xp_of(*given), fx.Psf.from_image(xp_of(*stars))


def test_the_unit_jacobian_changes_nothing(xp, dtype, to_xp):
    stamps, psf = sample(to_xp, dtype)
    unit = to_xp(np.eye(2), dtype)
    options = {"noise_variance": 1e-7, "seed": 3}
    close = tolerance("responses", dtype)
    plain = fx.measure_responses(stamps, psf, **options)
    sky = fx.measure_responses(stamps, psf, jacobian=unit, **options)
    for name in ("v", "response", "snr", "size", "flux"):
        assert_close(getattr(sky, name), getattr(plain, name), **close, xp=xp)
    # The dipole of 32 bits is good to 1e-3 pixels.
    assert_close(sky.centroid, plain.centroid, rtol=1e-4, atol=1e-4, xp=xp)
    null = fx.population_null(stamps, psf, **options)
    on_sky = fx.population_null(stamps, psf, jacobian=unit, **options)
    assert_close(on_sky.g, null.g, rtol=1e-3, atol=1e-3 if "32" in str(dtype) else 1e-7, xp=xp)
    assert on_sky.n_used == null.n_used


def test_pixels_turned_mirrored_and_of_another_size():
    # A quarter turn and a mirror: u along y, v along x, in units of a fifth of a pixel.
    stamps, psf = sample(np.asarray)
    j = 0.2 * np.array([[0.0, 1.0], [1.0, 0.0]])
    options = {"noise_variance": 1e-7, "isotropise": False}
    plain = fx.measure_responses(stamps, psf, size=2.0, **options)
    sky = fx.measure_responses(stamps, psf, jacobian=j, size=0.4, **options)
    sign = np.array([-1.0, 1.0])
    np.testing.assert_allclose(sky.v, sign * plain.v, atol=1e-9)
    np.testing.assert_allclose(
        sky.response, sign[:, None] * plain.response[:, :, :] * sign, atol=1e-8
    )
    np.testing.assert_allclose(sky.size[:, 0], 0.2 * plain.size[:, 0], rtol=1e-8)
    np.testing.assert_allclose(sky.snr[:, 0], plain.snr[:, 0], rtol=1e-9)
    np.testing.assert_allclose(sky.centroid, plain.centroid, atol=1e-9)
    table = sky.to_table()
    assert table["size"].unit is None
    assert str(plain.to_table()["size"].unit) == "pix"
    assert sky.take(np.array([1, 0])).to_numpy().on_sky
    found = default_size(stamps, psf, noise_variance=1e-7)
    on_sky = default_size(stamps, psf, noise_variance=1e-7, jacobian=j)
    assert on_sky == pytest.approx(0.2 * found, rel=1e-4)


@pytest.mark.parametrize("chunk_size", [None, 3])
def test_jacobians_of_each_and_chunks(chunk_size):
    # Pixels of several kinds in any order, one PSF on the pixels: each as it is alone.
    stamps, psf = sample(np.asarray)
    j = np.concatenate([MATRICES, 0.5 * MATRICES[:1]])
    options = {"noise_variance": 1e-7, "size": 2.0}
    each = fx.measure_responses(stamps, psf, jacobian=j, chunk_size=chunk_size, **options)
    for row in range(4):
        names = np.array([row])
        alone = fx.measure_responses(
            stamps[[row]], psf, jacobian=j[row], identifiers=names, **options
        )
        # Weights are tabulated for Jacobians rounded in another unit.
        np.testing.assert_allclose(each.v[row], alone.v[0], atol=2e-4)
        np.testing.assert_allclose(each.centroid[row], alone.centroid[0], atol=1e-3)


def test_a_bad_jacobian_is_flagged_and_disturbs_nobody(xp, dtype, to_xp):
    stamps, psf = sample(to_xp, dtype)
    j = np.tile(0.2 * np.array([[1.1, 0.1], [0.0, 0.9]]), (4, 1, 1))
    good = fx.measure_responses(stamps, psf, jacobian=to_xp(j, dtype))
    j[2] = np.nan
    seen = fx.measure_responses(stamps, psf, jacobian=to_xp(j, dtype))
    assert flag_names(int(seen.flags[2])) == ["BAD_JACOBIAN"]
    assert bool(xp.all(xp.isnan(seen.v[2, :])))
    rows = to_xp(np.array([0, 1, 3]))
    assert_close(seen.take(rows).v, good.take(rows).v, **tolerance("responses", dtype), xp=xp)
    null = fx.population_null(stamps, psf, jacobian=to_xp(j, dtype))
    assert null.n_used == 3
    j[:] = 0.0
    with pytest.raises(FdntValueError, match="0 of 4 galaxies can be used"):
        fx.population_null(stamps, psf, jacobian=to_xp(j, dtype))


def test_calls_that_mean_nothing(to_xp):
    stamps, psf = sample(to_xp)
    for measure in (fx.population_null, fx.measure_responses, fx.shear_from_stack):
        with pytest.raises(ShapeMismatchError, match="jacobian must have the shape"):
            measure(stamps, psf, jacobian=to_xp(np.ones((3, 2, 2))))
        with pytest.raises(FdntValueError, match="not singular"):
            measure(stamps, psf, jacobian=to_xp(np.ones((2, 2))))
        with pytest.raises(NamespaceError, match="jacobian"):
            measure(stamps, psf, jacobian=to_xp(np.eye(2), "float32"))
        with pytest.raises(FdntTypeError, match="jacobian must be an array"):
            measure(stamps, psf, jacobian=[[1.0, 0.0], [0.0, 1.0]])
    none = fx.measure_responses(stamps[:0, ...], psf, jacobian=to_xp(np.ones((0, 2, 2))))
    assert none.n_gal == 0
