"""`measure_shapes` as its users meet it: any library, any batch, any bad galaxy, any bad call."""

from __future__ import annotations

import subprocess
import sys

import array_api_strict
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
from images import PSF_COVARIANCE, galaxies, gaussian_covariance, gaussian_image, star
from tolerances import tolerance

E = np.array([[0.0, 0.0], [0.3, 0.1], [-0.2, 0.45], [0.05, -0.6], [0.55, 0.55]])
CENTRES = np.array([[0.0, 0.0], [0.4, -0.3], [-2.2, 1.7], [0.5, 0.5], [3.0, 0.1]])
NOISE = 1e-9


@pytest.fixture
def stamps(to_xp, dtype):
    return to_xp(galaxies(E, centres=CENTRES), dtype)


@pytest.fixture
def psf(to_xp, dtype):
    return fx.Psf.from_image(to_xp(star(), dtype))


def names(result, row):
    return flag_names(int(result.flags[row]))


# --- what comes out ------------------------------------------------------------------


def test_shapes_centroids_sizes_fluxes(stamps, psf, xp, dtype, to_xp):
    shapes = fx.measure_shapes(stamps, psf, noise_variance=NOISE)
    assert bool(xp.all(shapes.measured))
    assert_close(shapes.e, to_xp(E, dtype), **tolerance("shapes", dtype), xp=xp)
    assert_close(shapes.centroid, to_xp(23.5 + CENTRES, dtype), **tolerance("centroids", dtype))
    # A Gaussian galaxy is matched by its own size, the radius of the circle it is sheared from.
    size = 2.2 * (1.0 - np.sum(E**2, axis=1)) ** 0.25
    assert_close(shapes.size, to_xp(size, dtype), **tolerance("sizes", dtype), xp=xp)
    assert_close(shapes.flux, to_xp(np.ones(5), dtype), **tolerance("sizes", dtype), xp=xp)
    assert_close(shapes.eg, to_xp(np.zeros(5), dtype), **tolerance("gradients", dtype), xp=xp)
    assert bool(xp.all(shapes.snr > 0))
    assert shapes.eta_cov.shape == (5, 2, 2)
    assert shapes.flags.dtype == shapes.n_iter.dtype == shapes.status.dtype == xp.int32


def test_results_are_where_the_stamps_are(stamps, psf, dtype, device):
    from fdnt_xp.arrays import device_of

    shapes = fx.measure_shapes(stamps, psf, noise_variance=NOISE)
    for name in ("eta", "eta_cov", "eg", "centroid", "size", "flux", "snr"):
        assert getattr(shapes, name).dtype == dtype
    for name in ("eta", "flags", "n_iter", "status"):
        assert device_of(getattr(shapes, name)) == device


def test_without_noise_variance_there_are_no_errors(stamps, psf, xp):
    shapes = fx.measure_shapes(stamps, psf)
    assert bool(xp.all(xp.isnan(shapes.eta_cov)))
    assert bool(xp.all(xp.isnan(shapes.snr)))
    assert bool(xp.all(xp.isfinite(shapes.eta)))


def test_a_fixed_size_is_kept_and_flagged(stamps, psf, xp, dtype, to_xp):
    shapes = fx.measure_shapes(stamps, psf, size=2.0)
    assert_close(shapes.size, to_xp(np.full(5, 2.0), dtype), **tolerance("algebra", dtype), xp=xp)
    assert_close(shapes.e, to_xp(E, dtype), **tolerance("shapes", dtype), xp=xp)
    assert [("SIZE_FIXED" in names(shapes, i)) for i in range(5)] == [True] * 5


@pytest.mark.parametrize("shape", [(41, 41), (40, 44), (37, 60)])
def test_any_shape_of_stamp(shape, xp, dtype, to_xp):
    images = to_xp(galaxies(E[1:4], shape, sigma=2.0), dtype)
    for psf_shape in (shape, (31, 50)):
        star_image = to_xp(star(psf_shape), dtype)
        shapes = fx.measure_shapes(images, fx.Psf.from_image(star_image))
        assert_close(shapes.e, to_xp(E[1:4], dtype), **tolerance("small stamps", dtype), xp=xp)
        middle = np.full((3, 2), [0.5 * (shape[1] - 1), 0.5 * (shape[0] - 1)])
        assert_close(shapes.centroid, to_xp(middle, dtype), **tolerance("centroids", dtype))


def test_elongated_galaxies_get_the_fine_grid(xp, to_xp):
    e = np.array([[0.0, 0.3], [0.93, 0.0], [0.2, 0.0]])
    images = to_xp(galaxies(e, (96, 96), sigma=5.0))
    shapes = fx.measure_shapes(images, fx.Psf.from_image(to_xp(star())), noise_variance=NOISE)
    assert [("FINE_GRID" in names(shapes, i)) for i in range(3)] == [False, True, False]
    assert_close(shapes.e, to_xp(e), rtol=0, atol=1e-5, xp=xp)


def test_padding_changes_little_and_the_errors_not(stamps, psf, xp, dtype):
    one = fx.measure_shapes(stamps, psf, noise_variance=NOISE)
    two = fx.measure_shapes(stamps, psf, noise_variance=NOISE, padding=2)
    assert_close(two.e, one.e, **tolerance("shapes", dtype), xp=xp)
    assert_close(two.eta_cov, one.eta_cov, rtol=2e-2, atol=1e-9, xp=xp)
    assert_close(two.snr, one.snr, rtol=1e-2, xp=xp)


def test_far_off_centre_galaxies_are_found(psf, xp, dtype, to_xp):
    centres = np.array([[8.0, -7.0], [-6.0, -9.0], [0.0, 9.0]])
    images = to_xp(galaxies(E[1:4], centres=centres), dtype)
    shapes = fx.measure_shapes(images, psf)
    assert bool(xp.all(shapes.measured))
    assert_close(shapes.centroid, to_xp(23.5 + centres, dtype), rtol=0, atol=2e-2)


# --- one galaxy, many galaxies, other galaxies ---------------------------------------


@pytest.fixture(scope="module")
def noisy():
    """Stamps of S/N about 200, with their noise variance."""
    rng = np.random.default_rng(8)
    e = rng.uniform(-0.5, 0.5, (12, 2))
    clean = galaxies(e, centres=rng.uniform(-1, 1, (12, 2)))
    sigma = np.sqrt(np.mean(np.sum(clean**2, axis=(1, 2)))) / 200.0
    return clean + sigma * rng.standard_normal(clean.shape), sigma**2


@pytest.fixture(scope="module")
def reference(noisy):
    """Their shapes by NumPy in float64."""
    return fx.measure_shapes(noisy[0], fx.Psf.from_image(star()), noise_variance=noisy[1])


def test_libraries_agree(noisy, reference, xp, to_xp):
    psf = fx.Psf.from_image(to_xp(star()))
    shapes = fx.measure_shapes(to_xp(noisy[0]), psf, noise_variance=noisy[1])
    for name, atol in (("eta", 1e-10), ("centroid", 1e-10), ("eta_cov", 1e-12), ("size", 1e-8)):
        expected = to_xp(getattr(reference, name))
        assert_close(getattr(shapes, name), expected, rtol=1e-8, atol=atol, xp=xp)
    assert_equal(shapes.flags, to_xp(reference.flags), xp=xp)
    assert_equal(shapes.status, to_xp(reference.status), xp=xp)


def test_single_precision_costs_a_hundredth_of_the_noise(noisy, reference, to_xp, to_np):
    psf = fx.Psf.from_image(to_xp(star(), "float32"))
    shapes = fx.measure_shapes(to_xp(noisy[0], "float32"), psf, noise_variance=noisy[1])
    error = np.sqrt(np.diagonal(reference.eta_cov, axis1=1, axis2=2))
    assert np.max(np.abs(to_np(shapes.eta) - reference.eta) / error) < 1e-2


def test_alone_or_together(noisy, dtype, xp, to_xp):
    images, psf = to_xp(noisy[0][:4], dtype), fx.Psf.from_image(to_xp(star(), dtype))
    together = fx.measure_shapes(images, psf, noise_variance=noisy[1])
    for i in range(4):
        alone = fx.measure_shapes(images[i : i + 1, :, :], psf, noise_variance=noisy[1])
        assert_close(alone.eta[0, :], together.eta[i, :], **tolerance("batch", dtype), xp=xp)


def test_bad_neighbours_change_nothing(noisy, dtype, xp, to_xp):
    clean = noisy[0][:3]
    poison = [np.full((48, 48), np.nan), np.zeros((48, 48)), np.full((48, 48), np.inf)]
    mixed = np.stack([poison[0], clean[0], poison[1], clean[1], poison[2], clean[2]])
    psf = fx.Psf.from_image(to_xp(star(), dtype))
    expected = fx.measure_shapes(to_xp(clean, dtype), psf).eta
    actual = fx.measure_shapes(to_xp(mixed, dtype), psf).eta
    rows = to_xp(np.array([1, 3, 5]))
    assert_close(xp.take(actual, rows, axis=0), expected, **tolerance("batch", dtype), xp=xp)


@pytest.mark.parametrize("chunk_size", [1, 5, 12, 1000])
def test_chunks_change_nothing(chunk_size, noisy, reference, to_xp, xp):
    psf = fx.Psf.from_image(to_xp(star()))
    shapes = fx.measure_shapes(to_xp(noisy[0]), psf, chunk_size=chunk_size)
    assert_close(shapes.eta, to_xp(reference.eta), rtol=0, atol=1e-10, xp=xp)


def test_a_psf_for_each_galaxy(dtype, xp, to_xp):
    covariances = [PSF_COVARIANCE, gaussian_covariance((-0.1, 0.1), 1.6), 1.3 * PSF_COVARIANCE]
    galaxy = gaussian_covariance((0.25, 0.15), 2.4)
    images = to_xp(np.stack([gaussian_image(galaxy + c) for c in covariances]), dtype)
    stars = to_xp(np.stack([gaussian_image(c) for c in covariances]), dtype)
    shapes = fx.measure_shapes(images, fx.Psf.from_image(stars), chunk_size=2)
    expected = to_xp(np.tile([0.25, 0.15], (3, 1)), dtype)
    assert_close(shapes.e, expected, **tolerance("shapes", dtype), xp=xp)
    for i in range(3):
        alone = fx.measure_shapes(images[i : i + 1, :, :], fx.Psf.from_image(stars[i, :, :]))
        # Not bit for bit: the batch shares the disc of its sharpest PSF.
        assert_close(alone.eta[0, :], shapes.eta[i, :], **tolerance("shapes", dtype), xp=xp)


def test_an_empty_batch_gives_an_empty_result(psf, dtype, to_xp):
    shapes = fx.measure_shapes(to_xp(np.empty((0, 48, 48)), dtype), psf, noise_variance=1.0)
    assert shapes.n_gal == 0
    assert shapes.eta.shape == (0, 2)
    assert shapes.eta_cov.shape == (0, 2, 2)
    assert len(shapes.to_table()) == 0


def test_inputs_are_left_alone(to_np, to_xp):
    images, image = to_xp(galaxies(E)), to_xp(star())
    before = to_np(images), to_np(image)
    fx.measure_shapes(images, fx.Psf.from_image(image), noise_variance=NOISE)
    np.testing.assert_array_equal(to_np(images), before[0])
    np.testing.assert_array_equal(to_np(image), before[1])


def test_ten_thousand_stamps_stay_under_a_gigabyte():
    # In a process of its own: its peak is that of nothing else.
    code = """
import pathlib, re, resource, numpy as np, fdnt_xp as fx
rng = np.random.default_rng(0)
y, x = np.mgrid[-24:24, -24:24] + 0.5
galaxy = np.exp(-(x**2 / 9.0 + y**2 / 7.0) / 2.0)
stamps = np.tile(galaxy, (10_000, 1, 1)) + 1e-3 * rng.standard_normal((1, 48, 48))
psf = fx.Psf.from_image(np.exp(-(x**2 + y**2) / 6.0))
shapes = fx.measure_shapes(stamps, psf, noise_variance=1e-6)
assert shapes.measured.all()
status = pathlib.Path("/proc/self/status")
# On Linux ru_maxrss begins with the size of the process that started this one.
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
print(re.search(r"VmHWM:\\s+(\\d+)", status.read_text())[1] if status.exists() else peak)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    kilobyte = 1024 if sys.platform != "darwin" else 1
    assert int(done.stdout) * kilobyte < 1e9


# --- bad galaxies: a flag on them alone ----------------------------------------------


def with_bad_row(bad):
    """Return three stamps of which the middle one is `bad`."""
    good = galaxies(E[1:3])
    return np.stack([good[0], bad, good[1]])


def flat(value):
    return np.full((48, 48), value)


def one_pixel(value):
    image = galaxies(E[1:2])[0]
    image[20, 30] = value
    return image


@pytest.mark.parametrize(
    ("bad", "reason"),
    [
        (one_pixel(np.nan), Flag.NON_FINITE_PIXEL),
        (one_pixel(np.inf), Flag.NON_FINITE_PIXEL),
        (one_pixel(-np.inf), Flag.NON_FINITE_PIXEL),
        (flat(0.0), Flag.NO_SIGNAL),
        (flat(7.5), Flag.NO_SIGNAL),
    ],
    ids=["nan", "inf", "-inf", "zero", "constant"],
)
def test_unusable_stamps(bad, reason, psf, dtype, xp, to_xp):
    shapes = fx.measure_shapes(to_xp(with_bad_row(bad), dtype), psf, noise_variance=NOISE)
    assert reason.name in names(shapes, 1)
    for name in ("eta", "eta_cov", "eg", "centroid", "size", "flux", "snr"):
        column = getattr(shapes, name)
        assert bool(xp.all(xp.isnan(column[1, ...])))
        assert bool(xp.all(xp.isfinite(column[0, ...])))
        assert bool(xp.all(xp.isfinite(column[2, ...])))


def test_negative_flux(psf, dtype, to_xp, to_np):
    images = to_xp(with_bad_row(-galaxies(E[1:2])[0]), dtype)
    shapes = fx.measure_shapes(images, psf)
    assert to_np(shapes.measured).tolist() == [True, False, True]
    assert names(shapes, 1)


def test_pure_noise_raises_nothing(psf, dtype, to_xp, to_np):
    images = to_xp(np.random.default_rng(4).standard_normal((12, 48, 48)), dtype)
    shapes = fx.measure_shapes(images, psf, noise_variance=1.0)
    measured = to_np(shapes.measured)
    assert not np.all(measured)
    assert np.array_equal(np.isfinite(to_np(shapes.eta[:, 0])), measured)


def test_no_iterations_is_no_shape(stamps, psf, to_np):
    shapes = fx.measure_shapes(stamps, psf, max_iter=0)
    # The first is round and centred: there is nothing to find.
    assert to_np(shapes.measured).tolist() == [True, False, False, False, False]
    assert "DID_NOT_CONVERGE" in names(shapes, 1)


def test_a_tiny_galaxy_holds_its_size_at_the_bound(psf, dtype, to_xp):
    # A star: narrower than the PSF can show.
    shapes = fx.measure_shapes(to_xp(star()[None], dtype), psf)
    assert "SIZE_AT_BOUND" in names(shapes, 0)


@pytest.mark.parametrize("bad", [flat(0.0), flat(np.nan), -star()], ids=["zero", "nan", "negative"])
def test_one_bad_psf_of_many(bad, dtype, to_xp, to_np):
    images = to_xp(galaxies(E[1:4]), dtype)
    stars = to_xp(np.stack([star(), bad, star()]), dtype)
    shapes = fx.measure_shapes(images, fx.Psf.from_image(stars))
    assert to_np(shapes.measured).tolist() == [True, False, True]
    assert names(shapes, 1)[0] == "BAD_PSF"


def test_a_psf_of_one_pixel(dtype, xp, to_xp):
    # The sharpest there is: the weight is cut by the grid while the PSF is still large.
    point = np.zeros((15, 15))
    point[7, 7] = 1.0
    covariances = [gaussian_covariance(tuple(e), 2.2) for e in E[:3]]
    images = to_xp(np.stack([gaussian_image(c) for c in covariances]), dtype)
    shapes = fx.measure_shapes(images, fx.Psf.from_image(to_xp(point, dtype)))
    assert_close(shapes.e, to_xp(E[:3], dtype), **tolerance("shapes", dtype), xp=xp)


def test_one_psf_of_many_too_wide_for_the_stamp(dtype, to_xp, to_np):
    images = to_xp(galaxies(E[1:4]), dtype)
    wide = gaussian_image(gaussian_covariance((0, 0), 20.0))
    stars = to_xp(np.stack([star(), wide, star()]), dtype)
    shapes = fx.measure_shapes(images, fx.Psf.from_image(stars))
    assert to_np(shapes.measured).tolist() == [True, False, True]
    assert "BAD_PSF" in names(shapes, 1)


# --- bad calls: one clear error ------------------------------------------------------


def test_two_libraries_are_refused():
    there = array_api_strict.asarray(galaxies(E))
    with pytest.raises(NamespaceError, match=r"psf is a .*numpy.* stamps is a .*strict"):
        fx.measure_shapes(there, fx.Psf.from_image(star()))


def test_two_precisions_are_refused(to_xp):
    psf = fx.Psf.from_image(to_xp(star(), "float32"))
    with pytest.raises(NamespaceError, match=r"psf has dtype .*float32.* expected .*float64"):
        fx.measure_shapes(to_xp(galaxies(E)), psf)


def test_noise_of_another_precision_is_refused(to_xp):
    psf = fx.Psf.from_image(to_xp(star()))
    noise = to_xp(np.ones(5), "float32")
    with pytest.raises(NamespaceError, match="noise_variance has dtype"):
        fx.measure_shapes(to_xp(galaxies(E)), psf, noise_variance=noise)


@pytest.mark.parametrize("shape", [(48,), (48, 48), (1, 1, 48, 48), (2, 0, 48)])
def test_wrong_rank_is_refused(shape, psf, dtype, to_xp):
    with pytest.raises(ShapeMismatchError, match=r"stamps must have the shape \(n_gal, ny, nx\)"):
        fx.measure_shapes(to_xp(np.ones(shape), dtype), psf)


def test_another_number_of_psfs_is_refused(stamps, dtype, to_xp):
    psf = fx.Psf.from_image(to_xp(np.stack([star()] * 3), dtype))
    with pytest.raises(ShapeMismatchError, match="psf is for 3 galaxies, but there are 5 stamps"):
        fx.measure_shapes(stamps, psf)


def test_an_image_is_no_psf(stamps):
    with pytest.raises(FdntTypeError, match=r"psf must be a Psf.*Psf\.from_image"):
        fx.measure_shapes(stamps, stamps[0, :, :])


def test_lists_are_no_arrays(psf):
    with pytest.raises(FdntTypeError, match="stamps must be an array"):
        fx.measure_shapes([[[1.0]]], psf)


def test_a_psf_that_leaves_nothing_is_refused(stamps, dtype, to_xp):
    wide = gaussian_image(gaussian_covariance((0, 0), 20.0), (160, 160))
    psf = fx.Psf.from_image(to_xp(wide, dtype))
    with pytest.raises(FdntValueError, match=r"psf is too wide for stamps of 48 x 48 pixels"):
        fx.measure_shapes(stamps, psf)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"noise_variance": -1.0}, "noise_variance = -1"),
        ({"noise_variance": float("nan")}, "noise_variance = nan"),
        ({"size": 0.0}, "size = 0"),
        ({"size": -2.0}, "size = -2"),
        ({"size": float("inf")}, "size = inf"),
        ({"padding": 0}, "padding = 0"),
        ({"padding": 1.5}, "padding = 1.5"),
        ({"padding": float("nan")}, "padding = nan"),
        ({"chunk_size": float("inf")}, "chunk_size = inf"),
        ({"max_iter": float("nan")}, "max_iter = nan"),
        ({"max_iter": -1}, "max_iter = -1"),
        ({"chunk_size": 0}, "chunk_size = 0"),
    ],
)
def test_numbers_out_of_range_are_refused(options, message, stamps, psf):
    with pytest.raises(RangeError, match=message):
        fx.measure_shapes(stamps, psf, **options)


def test_noise_of_another_shape_is_refused(stamps, psf, dtype, to_xp):
    with pytest.raises(ShapeMismatchError, match=r"noise_variance must be a number or .* \(5,\)"):
        fx.measure_shapes(stamps, psf, noise_variance=to_xp(np.ones(4), dtype))


# --- arrays as people hold them ------------------------------------------------------


def test_a_variance_is_any_number():
    images, star_of = galaxies(E), fx.Psf.from_image(star())
    expected = fx.measure_shapes(images, star_of, noise_variance=0.25)
    for number in (np.float32(0.25), np.float64(0.25)):
        actual = fx.measure_shapes(images, star_of, noise_variance=number)
        np.testing.assert_array_equal(actual.eta_cov, expected.eta_cov)


@pytest.mark.parametrize(
    "held",
    [
        lambda a: a.astype(">f8"),
        lambda a: np.ascontiguousarray(a[:, ::-1, ::-1])[:, ::-1, ::-1],
        lambda a: np.asfortranarray(a),
        lambda a: np.repeat(a, 2, axis=2)[:, :, ::2],
    ],
    ids=["big-endian", "negative strides", "Fortran", "strided"],
)
def test_numpy_arrays_of_any_layout(held):
    images = galaxies(E)
    expected = fx.measure_shapes(images, fx.Psf.from_image(star()))
    actual = fx.measure_shapes(held(images), fx.Psf.from_image(held(star()[None])[0]))
    np.testing.assert_allclose(actual.eta, expected.eta, atol=1e-12)


@pytest.mark.parametrize("kind", ["int32", "int16", "int64", "uint16"])
def test_integer_images_are_converted(kind, to_xp, xp):
    if kind == "uint16" and "torch" in xp.__name__:
        pytest.skip("torch has next to no uint16 arithmetic")
    counts = np.round(3e5 * galaxies(E[1:4])).astype(kind)
    expected = fx.measure_shapes(counts.astype(float), fx.Psf.from_image(star()))
    shapes = fx.measure_shapes(to_xp(counts), fx.Psf.from_image(to_xp(star())))
    assert_close(shapes.eta, to_xp(expected.eta), rtol=0, atol=1e-10, xp=xp)
