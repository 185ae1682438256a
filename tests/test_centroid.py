"""The first centroid: found far from the centre of the stamp, and the derivatives it needs."""

from __future__ import annotations

import numpy as np
import pytest
from array_api_extra.testing import assert_close

import fdnt_xp as fx
from fdnt_xp.fourier.grid import half_plane_disc
from fdnt_xp.fourier.transform import deconvolve
from fdnt_xp.nulltests.weights import make_weight
from fdnt_xp.shapes.centroid import DipoleTests, starting_centroid, wide_weight
from images import galaxies, star
from tolerances import tolerance

CENTRES = np.array([[0.0, 0.0], [0.4, -0.7], [-5.0, 6.5], [7.5, 7.0]])
LENGTH = 1.5


@pytest.fixture
def setting(xp, dtype, device, to_xp):
    """The k grid, four galaxies of different shapes, and the wide weight."""
    psf = fx.Psf.from_image(to_xp(star(), dtype))
    grid = half_plane_disc(xp, (48, 48), psf.largest_kmax, dtype=dtype, device=device)
    e = np.array([[0.0, 0.0], [0.3, 0.1], [-0.5, 0.2], [0.1, 0.6]])
    stamps = to_xp(galaxies(e, centres=CENTRES), dtype)
    weight = make_weight(psf, largest_size=8.0)
    return grid, deconvolve(stamps, psf.inverse_transfer(grid), grid), weight


def test_galaxies_are_found_far_from_the_centre(setting, xp, dtype, to_xp):
    grid, deconvolved, weight = setting
    wide = wide_weight(weight, grid, 48)
    found = starting_centroid(grid, deconvolved, wide, LENGTH, reach=24.0)
    # A start: a few hundredths of a pixel are more than enough.
    assert_close(found, to_xp(CENTRES, dtype), rtol=0, atol=0.1, xp=xp)


def test_beyond_the_reach_the_centre_of_the_stamp_is_kept(setting, xp, dtype, to_xp):
    grid, deconvolved, weight = setting
    wide = wide_weight(weight, grid, 48)
    found = starting_centroid(grid, deconvolved, wide, LENGTH, reach=3.0)
    expected = np.where(np.all(np.abs(CENTRES) <= 3.0, axis=1)[:, None], CENTRES, 0.0)
    assert_close(found, to_xp(expected, dtype), rtol=0, atol=0.1, xp=xp)


def test_derivatives_are_those_of_differences(setting, dtype, to_xp, to_np):
    grid, deconvolved, weight = setting
    wide = wide_weight(weight, grid, 48)
    tests = DipoleTests(grid=grid, galaxies=deconvolved, weight=wide, length=LENGTH)
    x = (CENTRES + np.array([0.5, -0.4])) / LENGTH
    h = 1e-4 if dtype_is_double(dtype) else 3e-2
    _, jac = tests.evaluate(to_xp(x, dtype))
    for j in (0, 1):
        step = h * np.eye(2)[j]
        above, below = (to_np(tests.evaluate(to_xp(x + s, dtype))[0]) for s in (step, -step))
        slope = (above - below) / (2.0 * h)
        atol = 1e-6 if dtype_is_double(dtype) else 2e-3
        np.testing.assert_allclose(to_np(jac)[:, :, j], slope, atol=atol)


def test_rows_can_be_taken(setting, xp, dtype, to_xp):
    grid, deconvolved, weight = setting
    wide = wide_weight(weight, grid, 48)
    tests = DipoleTests(grid=grid, galaxies=deconvolved, weight=wide, length=LENGTH)
    rows = to_xp(np.array([2, 0]))
    part, _ = tests.take(rows).evaluate(to_xp(CENTRES[[2, 0]] / LENGTH, dtype))
    whole, _ = tests.evaluate(to_xp(CENTRES / LENGTH, dtype))
    assert_close(part, xp.take(whole, rows, axis=0), **tolerance("batch", dtype), xp=xp)


def test_where_there_is_no_galaxy_there_is_no_number(setting, dtype, to_xp, to_np):
    grid, deconvolved, weight = setting
    wide = wide_weight(weight, grid, 48)
    negative = type(deconvolved)(re=-deconvolved.re, im=-deconvolved.im)
    tests = DipoleTests(grid=grid, galaxies=negative, weight=wide, length=LENGTH)
    f, jac = tests.evaluate(to_xp(CENTRES / LENGTH, dtype))
    assert np.all(np.isnan(to_np(f)))
    assert np.all(np.isnan(to_np(jac)))


def dtype_is_double(dtype):
    return "float64" in str(dtype)
