"""`measure_shapes` from Gauss-Laguerre fits and with missing pixels, on every backend."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from array_api_extra.testing import assert_close, assert_equal

import fdnt_xp as fx
from fdnt_xp.errors import (
    FdntTypeError,
    FdntValueError,
    NamespaceError,
    RangeError,
    ShapeMismatchError,
)
from fdnt_xp.flags import Flag, flag_names
from fdnt_xp.shapes.gl_fit import fit_laguerre
from fdnt_xp.shapes.methods import shape_method
from images import PSF_COVARIANCE, galaxies, gaussian_covariance, gaussian_image, star
from tolerances import tolerance

SIDE = 48
E = np.array([[0.0, 0.0], [0.3, 0.1], [-0.2, 0.45], [0.05, -0.6]])
CENTRES = np.array([[0.0, 0.0], [0.4, -0.3], [-1.2, 0.7], [0.5, 0.5]])
FITTED = ["gl", "hybrid"]
SIGMA = 2e-5


def mask(name, n=4, seed=0):
    """Return which pixels of n stamps are there."""
    present = np.ones((n, SIDE, SIDE), dtype=bool)
    if name.endswith("%"):
        drawn = np.random.default_rng(seed).random(present.shape)
        present &= drawn > 0.01 * float(name[:-1])
    elif name == "column":
        present[:, :, SIDE // 2 + 1] = False
    elif name == "quadrant":
        present[:, SIDE // 2 :, SIDE // 2 :] = False
    return present


@pytest.fixture
def psf(to_xp, dtype):
    return fx.Psf.from_image(to_xp(star(), dtype))


@pytest.fixture
def measure(to_xp):
    """Return `measure(stamps, present, dtype, **options)`, missing pixels being NaN."""

    def call(stamps, present, dtype="float64", **options):
        options = {"order": 8, **options}
        return fx.measure_shapes(
            to_xp(np.where(present, stamps, np.nan), dtype),
            fx.Psf.from_image(to_xp(star(), dtype)),
            ivar=to_xp(present / SIGMA**2, dtype),
            **options,
        )

    return call


def names(result, row):
    return flag_names(int(result.flags[row]))


# --- shapes --------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["none", "5 %", "column"])
@pytest.mark.parametrize("transform", FITTED)
def test_gaussians_whatever_is_missing(transform, name, measure, xp, dtype, to_xp, to_np):
    # The sum of the basis function 00 and nothing else: no fit is better than this one.
    present = mask(name)
    shapes = measure(galaxies(E, centres=CENTRES), present, dtype, transform=transform)
    assert bool(xp.all(shapes.measured))
    assert_close(shapes.e, to_xp(E, dtype), **tolerance("gl shapes", dtype), xp=xp)
    assert_close(
        shapes.centroid, to_xp(23.5 + CENTRES, dtype), **tolerance("centroids", dtype), xp=xp
    )
    np.testing.assert_allclose(
        to_np(shapes.masked_fraction), 1.0 - present.mean(axis=(1, 2)), rtol=1e-5, atol=1e-7
    )
    filled = transform == "hybrid" and name != "none"
    assert [("FILLED" in names(shapes, i)) for i in range(len(E))] == [filled] * len(E)
    assert bool(xp.all(shapes.snr > 0))
    for column in shapes.columns().values():
        if xp.isdtype(column.dtype, "real floating"):
            assert column.dtype == dtype


def test_the_stamp_and_the_fit_agree(psf, xp, dtype, to_xp):
    stamps = to_xp(galaxies(E, centres=CENTRES), dtype)
    ft = fx.measure_shapes(stamps, psf, noise_variance=SIGMA**2)
    gl = fx.measure_shapes(stamps, psf, noise_variance=SIGMA**2, transform="gl")
    tol = {"rtol": 1e-3 if "float64" in str(dtype) else 2e-2, "xp": xp}
    assert_close(gl.flux, ft.flux, **tol)
    assert_close(gl.size, ft.size, **tol)
    assert_close(gl.snr, ft.snr, **tol)
    # White noise reaches both alike, but for what the coefficients leave out.
    assert_close(gl.eta_cov, ft.eta_cov, rtol=5e-2, atol=1e-2 * SIGMA**2, xp=xp)
    assert_equal(gl.masked_fraction, 0.0 * ft.size, xp=xp)


def test_even_ivar_is_white_noise(psf, xp, dtype, to_xp):
    stamps = to_xp(galaxies(E, centres=CENTRES), dtype)
    ivar = to_xp(np.full((len(E), SIDE, SIDE), SIGMA**-2), dtype)
    rtol = 1e-4 if "float64" in str(dtype) else 5e-3
    for transform in ("ft", *FITTED):
        white = fx.measure_shapes(
            stamps, psf, noise_variance=SIGMA**2, transform=transform, order=8
        )
        even = fx.measure_shapes(stamps, psf, ivar=ivar, transform=transform, order=8)
        assert_close(even.eta, white.eta, **tolerance("batch", dtype), xp=xp)
        assert_close(even.snr, white.snr, rtol=rtol, xp=xp)
        scale = float(xp.max(xp.abs(white.eta_cov)))
        assert_close(even.eta_cov, white.eta_cov, rtol=0.0, atol=rtol * scale, xp=xp)


@pytest.mark.parametrize("transform", ["ft", *FITTED])
def test_errors_are_derivatives(transform, to_np, to_xp):
    # Cov(eta) = sum_x (d eta/dI)² /ivar: pixel by pixel, on a stamp with uneven noise and gaps.
    side, e, order = 24, np.array([[0.25, -0.2]]), 6
    stamp = galaxies(e, (side, side), sigma=1.6)[0]
    star_image = gaussian_image(0.5 * PSF_COVARIANCE, (side, side))
    rng = np.random.default_rng(3)
    ivar = rng.uniform(0.5, 3.0, (side, side)) / SIGMA**2
    if transform != "ft":
        ivar *= rng.random((side, side)) > 0.05
    there = np.argwhere(ivar > 0)
    step = 1e-4 * stamp.max()
    moved = np.repeat(stamp[None], 2 * len(there) + 1, axis=0)
    for i, (row, column) in enumerate(there):
        moved[2 * i, row, column] += step
        moved[2 * i + 1, row, column] -= step
    shapes = fx.measure_shapes(
        moved,
        fx.Psf.from_image(star_image),
        ivar=np.broadcast_to(ivar, moved.shape).copy(),
        transform=transform,
        order=order,
    )
    assert np.all(shapes.measured)
    slope = (shapes.eta[:-1:2] - shapes.eta[1::2]) / (2.0 * step)
    variance = 1.0 / ivar[there[:, 0], there[:, 1]]
    expected = np.einsum("xi,xj,x->ij", slope, slope, variance)
    ours = fx.measure_shapes(
        to_xp(stamp[None]),
        fx.Psf.from_image(to_xp(star_image)),
        ivar=to_xp(ivar[None]),
        transform=transform,
        order=order,
    )
    error = np.abs(to_np(ours.eta_cov)[0] - expected) / np.max(np.abs(expected))
    assert np.max(error) < (1e-5 if transform == "ft" else 2e-2)


def test_libraries_agree(to_xp, xp):
    rng = np.random.default_rng(8)
    clean = galaxies(E, centres=CENTRES)
    noisy = clean + SIGMA * rng.standard_normal(clean.shape)
    ivar = mask("5 %") / SIGMA**2
    for transform in FITTED:
        options = {"transform": transform, "order": 6}
        expected = fx.measure_shapes(noisy, fx.Psf.from_image(star()), ivar=ivar, **options)
        psf = fx.Psf.from_image(to_xp(star()))
        shapes = fx.measure_shapes(to_xp(noisy), psf, ivar=to_xp(ivar), **options)
        assert_close(shapes.eta, to_xp(expected.eta), rtol=0.0, atol=1e-8, xp=xp)
        assert_close(shapes.eta_cov, to_xp(expected.eta_cov), rtol=1e-6, atol=1e-14, xp=xp)
        assert_equal(shapes.flags, to_xp(expected.flags), xp=xp)


@pytest.mark.parametrize("padding", [1, 2])
@pytest.mark.parametrize("transform", FITTED)
def test_elongated_galaxies(transform, padding, xp, to_xp):
    e = np.array([[0.0, 0.3], [0.93, 0.0]])
    images = galaxies(e, (80, 80), sigma=4.0)
    present = np.random.default_rng(0).random(images.shape) > 0.02
    psf = fx.Psf.from_image(to_xp(star()))
    shapes = fx.measure_shapes(
        to_xp(images), psf, ivar=to_xp(1.0 * present), transform=transform, padding=padding
    )
    assert_close(shapes.e, to_xp(e), rtol=0, atol=1e-4, xp=xp)
    assert "FINE_GRID" not in names(shapes, 0)


def test_whole_stamps_of_large_galaxies(dtype, xp, to_xp, to_np):
    # Functions 1.14 times as large as the galaxy reach out of the stamp, its own do not.
    e = np.array([[0.1, 0.0], [0.5, 0.0], [0.0, 0.1]])
    sigmas = (2.2, 4.0, 4.2)
    stamps = np.concatenate([galaxies(e[i : i + 1], sigma=s) for i, s in enumerate(sigmas)])
    psf = fx.Psf.from_image(to_xp(star(), dtype))
    fit = fit_laguerre(
        to_xp(stamps, dtype), to_xp(np.ones(stamps.shape), dtype), order=16, scale=1.14
    )
    assert to_np(fit.flags == 0).tolist() == [True, False, True]
    shapes = fx.measure_shapes(to_xp(stamps, dtype), psf, transform="gl", order=16)
    assert to_np(shapes.measured).tolist() == [True] * 3
    # The stamp cuts the largest where they are at 1e-5.
    assert_close(shapes.e, to_xp(e, dtype), rtol=0, atol=1e-4 if "64" in str(dtype) else 5e-3)
    gap = np.ones(stamps.shape)
    gap[:, 4, 4] = 0.0
    shapes = fx.measure_shapes(
        to_xp(stamps, dtype), psf, ivar=to_xp(gap, dtype), transform="gl", order=16
    )
    assert names(shapes, 1) == ["GL_FAILURE"]


def test_a_fixed_size_is_kept(measure, xp, to_xp):
    for transform in FITTED:
        shapes = measure(galaxies(E), mask("5 %"), transform=transform, size=3.0)
        assert_close(shapes.size, to_xp(np.full(len(E), 3.0)), rtol=1e-12, xp=xp)
        assert all("SIZE_FIXED" in names(shapes, i) for i in range(len(E)))


# --- one galaxy, many galaxies -------------------------------------------------------


@pytest.fixture(scope="module")
def poisoned():
    """Return eleven galaxies, what is there of them, their ivar, and which are to be flagged."""
    stamps = np.concatenate([galaxies(E, centres=CENTRES)] * 3)[:11]
    present = mask("5 %", n=11)
    present[0] = present[4] = True
    ivar = present / SIGMA**2
    stamps[1][present[1]] = np.nan
    ivar[2] = 0.0
    ivar[3, 20, 20] = -1.0
    ivar[5, 20, 20] = np.nan
    ivar[6] *= mask("quadrant")[0]
    ivar[7, :, 12:] = ivar[7, 12:, :] = 0.0
    stamps[8] = -stamps[8]
    ivar[9, 3, 3] = np.inf
    return stamps, ivar


REASONS = {
    1: ["NON_FINITE_PIXEL"],
    2: ["MASKED"],
    3: ["NON_FINITE_PIXEL"],
    5: ["NON_FINITE_PIXEL"],
    6: ["GL_FAILURE"],
    7: ["GL_FAILURE"],
    8: ["NO_SIGNAL"],
    9: ["NON_FINITE_PIXEL"],
}


@pytest.mark.parametrize("transform", FITTED)
def test_bad_galaxies_are_flagged_and_change_nobody(transform, poisoned, dtype, xp, to_xp, to_np):
    stamps, ivar = (to_xp(a, dtype) for a in poisoned)
    psf = fx.Psf.from_image(to_xp(star(), dtype))
    shapes = fx.measure_shapes(stamps, psf, ivar=ivar, transform=transform)
    for i in range(11):
        assert [n for n in names(shapes, i) if n != "FILLED"] == REASONS.get(i, [])
        assert bool(xp.isfinite(shapes.masked_fraction[i]))
        for name in ("eta", "eta_cov", "eg", "centroid", "size", "flux", "snr"):
            finite = xp.isfinite(getattr(shapes, name)[i, ...])
            assert bool(xp.all(finite)) == (i not in REASONS)
            assert bool(xp.any(finite)) == (i not in REASONS)
    good = [i for i in range(11) if i not in REASONS]
    rows = to_xp(np.array(good))
    alone = fx.measure_shapes(
        xp.take(stamps, rows, axis=0), psf, ivar=xp.take(ivar, rows, axis=0), transform=transform
    )
    together = shapes.take(rows)
    assert_close(alone.eta, together.eta, **tolerance("batch", dtype), xp=xp)
    assert_equal(alone.flags, together.flags, xp=xp)


def test_masked_stamps_without_a_fit_are_flagged(poisoned, dtype, xp, to_xp):
    stamps, ivar = (to_xp(a, dtype) for a in poisoned)
    psf = fx.Psf.from_image(to_xp(star(), dtype))
    shapes = fx.measure_shapes(stamps, psf, ivar=ivar)
    expected = {i: ["MASKED"] for i in range(11)} | {
        i: reason for i, reason in REASONS.items() if reason == ["NON_FINITE_PIXEL"]
    }
    expected[0] = expected[4] = []
    assert {i: names(shapes, i) for i in range(11)} == expected
    whole = fx.measure_shapes(stamps[:1, :, :], psf, noise_variance=SIGMA**2)
    assert_close(shapes.eta[0, :], whole.eta[0, :], **tolerance("batch", dtype), xp=xp)


@pytest.mark.parametrize("chunk_size", [1, 3])
@pytest.mark.parametrize("transform", FITTED)
def test_chunks_change_nothing(transform, chunk_size, poisoned, xp, to_xp):
    stamps, ivar = map(to_xp, poisoned)
    psf = fx.Psf.from_image(to_xp(star()))
    options = {"ivar": ivar, "transform": transform, "order": 6}
    whole = fx.measure_shapes(stamps, psf, **options)
    parts = fx.measure_shapes(stamps, psf, chunk_size=chunk_size, **options)
    for name, theirs in whole.columns().items():
        ours = getattr(parts, name)
        if not xp.isdtype(ours.dtype, "real floating"):
            assert_equal(ours, theirs, xp=xp)
        else:
            assert_close(ours, theirs, rtol=1e-8, atol=1e-10, xp=xp)


@pytest.mark.parametrize("transform", FITTED)
def test_a_psf_for_each_galaxy(transform, dtype, xp, to_xp):
    covariances = [PSF_COVARIANCE, gaussian_covariance((-0.1, 0.1), 1.6), 1.3 * PSF_COVARIANCE]
    galaxy = gaussian_covariance((0.25, 0.15), 2.4)
    images = np.stack([gaussian_image(galaxy + c) for c in covariances])
    stars = to_xp(np.stack([gaussian_image(c) for c in covariances]), dtype)
    present = mask("5 %", n=3)
    present[1] = True
    shapes = fx.measure_shapes(
        to_xp(images, dtype),
        fx.Psf.from_image(stars),
        ivar=to_xp(1.0 * present, dtype),
        transform=transform,
        chunk_size=2,
    )
    expected = to_xp(np.tile([0.25, 0.15], (3, 1)), dtype)
    assert_close(shapes.e, expected, **tolerance("gl shapes", dtype), xp=xp)


@pytest.mark.parametrize("transform", ["ft", *FITTED])
def test_an_empty_batch_gives_an_empty_result(transform, psf, dtype, to_xp):
    none = to_xp(np.empty((0, SIDE, SIDE)), dtype)
    shapes = fx.measure_shapes(none, psf, ivar=none, transform=transform)
    assert shapes.n_gal == 0
    assert shapes.masked_fraction.shape == (0,)


def test_inputs_are_left_alone(poisoned, to_xp, to_np):
    stamps, ivar = map(to_xp, poisoned)
    before = to_np(stamps).copy(), to_np(ivar).copy()
    psf = fx.Psf.from_image(to_xp(star()))
    for transform in FITTED:
        fx.measure_shapes(stamps, psf, ivar=ivar, transform=transform, order=4)
    np.testing.assert_array_equal(to_np(stamps), before[0])
    np.testing.assert_array_equal(to_np(ivar), before[1])


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="reads the peak from /proc")
@pytest.mark.parametrize("transform", FITTED)
def test_a_thousand_stamps_stay_under_half_a_gigabyte(transform):
    # Functions at every pixel would be 1.7 GB. VmHWM is of the new process alone, where
    # ru_maxrss begins with that of pytest.
    code = f"""
import numpy as np, fdnt_xp as fx
rng = np.random.default_rng(0)
y, x = np.mgrid[-24:24, -24:24] + 0.5
galaxy = np.exp(-(x**2 / 9.0 + y**2 / 7.0) / 2.0)
stamps = np.tile(galaxy, (1000, 1, 1)) + 1e-3 * rng.standard_normal((1, 48, 48))
ivar = 1e6 * (rng.random(stamps.shape) > 0.02)
psf = fx.Psf.from_image(np.exp(-(x**2 + y**2) / 6.0))
shapes = fx.measure_shapes(stamps, psf, ivar=ivar, transform="{transform}", order=12)
assert shapes.measured.all()
print(open("/proc/self/status").read().split("VmHWM:")[1].split()[0])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert 1024 * int(done.stdout) < 5e8


# --- by name, and what is refused ----------------------------------------------------


def test_methods_have_names(psf, xp, dtype, to_xp):
    stamps = to_xp(galaxies(E), dtype)
    for name, transform in (("fdnt-gl", "gl"), ("fdnt-hybrid", "hybrid"), ("fdnt-ft", "ft")):
        ours = shape_method(name)(stamps, psf, noise_variance=SIGMA**2)
        expected = fx.measure_shapes(stamps, psf, noise_variance=SIGMA**2, transform=transform)
        assert_equal(ours.eta, expected.eta, xp=xp)
    with pytest.raises(FdntValueError, match="known are fdnt-ft, fdnt-gl, fdnt-hybrid"):
        shape_method("fdnt")


@pytest.mark.parametrize(
    ("options", "error", "match"),
    [
        ({"transform": "laguerre"}, FdntValueError, "known are 'ft', 'gl', 'hybrid'"),
        ({"transform": "gl", "order": -1}, RangeError, "order = -1"),
        ({"transform": "gl", "order": 21}, RangeError, "order = 21"),
        ({"transform": "hybrid", "order": 1.5}, RangeError, "order = 1.5"),
        ({"order": -1}, RangeError, "order = -1"),
        ({"noise_variance": 1.0, "ivar": np.ones((4, SIDE, SIDE))}, FdntValueError, "both"),
        ({"ivar": np.ones((SIDE, SIDE))}, ShapeMismatchError, "ivar must have the shape"),
        ({"ivar": np.ones((3, SIDE, SIDE))}, ShapeMismatchError, "ivar must have the shape"),
        ({"ivar": np.ones((4, SIDE, SIDE), np.float32)}, NamespaceError, "ivar has dtype"),
        ({"ivar": 1.0}, FdntTypeError, "ivar must be an array"),
    ],
)
def test_calls_that_mean_nothing_are_refused(options, error, match):
    with pytest.raises(error, match=match):
        fx.measure_shapes(galaxies(E), fx.Psf.from_image(star()), **options)


def test_more_coefficients_than_pixels_are_refused():
    small = galaxies(E, (14, 14))
    psf = fx.Psf.from_image(gaussian_image(0.5 * PSF_COVARIANCE))
    with pytest.raises(FdntValueError, match="231 coefficients, and a stamp 196 pixels"):
        fx.measure_shapes(small, psf, transform="gl", order=20)


def test_the_reason_of_a_failed_fit_is_a_flag():
    assert Flag.GL_FAILURE == 1 << 13
