"""Circular models: the right one recovers its galaxy, any library, any batch, any bad galaxy."""

from __future__ import annotations

import numpy as np
import pytest
from array_api_extra.testing import assert_close, assert_equal

import fdnt_xp as fx
import fdnt_xp.peers
from fdnt_xp.errors import FdntValueError, RangeError, ShapeMismatchError
from fdnt_xp.flags import flag_names
from fdnt_xp.peers.circular import CIRCULAR_METHODS
from fdnt_xp.peers.drawing import Drawing
from fdnt_xp.peers.image_fit import ImageFit
from fdnt_xp.peers.levenberg import find_minimum
from fdnt_xp.peers.models import Form, Model
from fdnt_xp.peers.profiles import GAUSSIAN_RATIO, de_vaucouleurs, exponential, gaussians
from fdnt_xp.shapes.methods import shape_method
from images import PSF_COVARIANCE, galaxies, gaussian_covariance, gaussian_image, star
from tolerances import tolerance

E = np.array([[0.0, 0.0], [0.3, 0.1], [-0.2, 0.45], [0.05, -0.6], [0.55, 0.55]])
CENTRES = np.array([[0.0, 0.0], [0.4, -0.3], [-2.2, 1.7], [0.5, 0.5], [3.0, 0.1]])
NOISE = 1e-9
METHODS = list(CIRCULAR_METHODS)


@pytest.fixture
def psf(to_xp, dtype):
    return fx.Psf.from_image(to_xp(star(), dtype))


def names(result, row):
    return flag_names(int(result.flags[row]))


def profile_images(profile, size, eta, centres):
    """Return galaxies of a profile behind the PSF of `star`, drawn on a much finer k grid."""
    wide = fx.Psf.from_image(star())
    drawing = Drawing.through(np, wide, (48, 48), 8, np.float64)
    form = Form.of(eta, np.full(len(eta), size))
    return Model.at(drawing, profile, centres, form.values).draw_components()[:, 0, :]


# --- the profiles ----------------------------------------------------------------------

PROFILES = {
    "gaussian": gaussians(1),
    "wide gaussian": gaussians(2),
    "exponential": exponential(),
    "devaucouleurs": de_vaucouleurs(),
}


@pytest.mark.parametrize("name", PROFILES)
def test_slopes_of_the_transforms(name, to_xp, to_np):
    transform = PROFILES[name].components[-1]
    q = np.geomspace(1e-4, 10.0, 23)
    step = 1e-4 * q
    h, slope, curvature = (to_np(part) for part in transform(to_xp(q)))
    above, below = (transform(to_xp(q + sign * step)) for sign in (1.0, -1.0))
    by_h, by_slope = ((to_np(above[i]) - to_np(below[i])) / (2.0 * step) for i in (0, 1))
    assert h == pytest.approx(np.clip(h, 0.0, 1.0))
    np.testing.assert_allclose(slope, by_h, rtol=1e-5, atol=1e-9)
    np.testing.assert_allclose(curvature, by_slope, rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize(
    ("name", "index"), [("gaussian", 0.5), ("exponential", 1.0), ("devaucouleurs", 4.0)]
)
def test_transforms_are_those_of_galsim(name, index):
    galsim = pytest.importorskip("galsim")
    radius = 1.1774100225154747 if name == "gaussian" else 1.0
    accurate = galsim.GSParams(kvalue_accuracy=1e-8)
    theirs = galsim.Sersic(index, half_light_radius=radius, gsparams=accurate)
    k = np.geomspace(1e-2, 30.0, 40)
    expected = np.array([theirs.kValue(float(x), 0.0).real for x in k])
    ours = PROFILES[name].components[0](k**2)[0]
    np.testing.assert_allclose(ours, expected, rtol=0, atol=1e-6)


def test_derivatives_of_the_quadratic_form(to_xp, to_np, dtype):
    eta = np.array([[0.0, 0.0], [0.3, -0.2], [-1.1, 0.9], [1.5, 1.2]])
    size = np.array([1.0, 2.0, 0.7, 1.3])
    x = np.concatenate([eta, np.log(size)[:, None]], axis=1)

    def form(x):
        return Form.of(x[:, :2], np.exp(x[:, 2]))

    here = Form.of(to_xp(eta, dtype), to_xp(size, dtype))
    step = 1e-5
    for j in range(3):
        move = step * np.eye(3)[j]
        above, below = form(x + move), form(x - move)
        slope = (above.values - below.values) / (2.0 * step)
        curvature = (above.slopes - below.slopes) / (2.0 * step)
        np.testing.assert_allclose(to_np(here.slopes)[:, :, j], slope, rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(to_np(here.curvatures)[..., j], curvature, rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("method", ["gauss-3", "exponential", "devaucouleurs"])
def test_derivatives_of_chi2(method, xp, to_xp, to_np):
    # Of a galaxy that is none of these: the model does not fit, nor need it.
    stamps = galaxies(E[1:4], sigma=3.0) + 0.3 * galaxies(E[2:5], centres=CENTRES[2:5])
    psf = fx.Psf.from_image(to_xp(star()))
    problem = CIRCULAR_METHODS[method]
    stamps = to_xp(stamps)
    drawing = Drawing.through(xp, psf, (48, 48), 2, stamps.dtype)
    fit = ImageFit.of(drawing, problem.profile, stamps, size=None)
    x = np.array([[0.1, 0.2, 0.3, -0.2, 0.9], [-0.3, 0.1, 0.0, 0.0, 0.6], [0, 0, 1.0, 0.8, 0.7]])
    _, g, h, _ = (to_np(part) for part in fit.evaluate(to_xp(x)))
    step = 1e-5
    for j in range(5):
        above, below = (fit.evaluate(to_xp(x + sign * step * np.eye(5)[j])) for sign in (1, -1))
        slope = (to_np(above[0]) - to_np(below[0])) / (2.0 * step)
        np.testing.assert_allclose(g[:, j], -0.5 * slope, rtol=1e-6, atol=1e-9)
        curvature = (to_np(above[1]) - to_np(below[1])) / (2.0 * step)
        np.testing.assert_allclose(h[:, :, j], -curvature, rtol=1e-5, atol=3e-8)


# --- the right model -------------------------------------------------------------------


@pytest.mark.parametrize("method", ["gauss-1", "gauss-2", "gauss-3"])
def test_a_gaussian_galaxy_by_gaussians(method, psf, dtype, xp, to_xp):
    stamps = to_xp(galaxies(E, centres=CENTRES), dtype)
    shapes = shape_method(method)(stamps, psf, noise_variance=NOISE)
    assert bool(xp.all(shapes.measured))
    assert_close(shapes.e, to_xp(E, dtype), **tolerance("fitted shapes", dtype), xp=xp)
    assert_close(shapes.centroid, to_xp(23.5 + CENTRES, dtype), **tolerance("fitted shapes", dtype))
    assert_close(shapes.flux, to_xp(np.ones(5), dtype), **tolerance("fitted shapes", dtype))
    assert_equal(shapes.eg, to_xp(np.zeros(5), dtype), xp=xp)
    assert bool(xp.all(shapes.snr > 0))
    if method == "gauss-1":
        size = 2.2 * (1.0 - np.sum(E**2, axis=1)) ** 0.25
        assert_close(shapes.size, to_xp(size, dtype), **tolerance("fitted shapes", dtype), xp=xp)


def test_a_sum_of_two_gaussians(psf, dtype, xp, to_xp):
    stamps = 0.0
    for sigma, flux in ((1.2, 0.4), (1.2 * GAUSSIAN_RATIO, 0.6)):
        stamps = stamps + flux * galaxies(E[1:4], (64, 64), sigma=sigma)
    shapes = shape_method("gauss-2")(to_xp(stamps, dtype), psf)
    assert_close(shapes.e, to_xp(E[1:4], dtype), **tolerance("fitted shapes", dtype), xp=xp)
    size = 1.2 * (1.0 - np.sum(E[1:4] ** 2, axis=1)) ** 0.25
    assert_close(shapes.size, to_xp(size, dtype), **tolerance("fitted sizes", dtype), xp=xp)


@pytest.mark.parametrize("method", ["exponential", "devaucouleurs"])
def test_a_galaxy_by_its_own_law(method, psf, dtype, xp, to_xp):
    eta = np.array([[0.0, 0.0], [0.4, -0.3], [-0.7, 0.2]])
    images = profile_images(PROFILES[method], 3.0, eta, CENTRES[:3]).reshape(3, 48, 48)
    shapes = shape_method(method)(to_xp(images, dtype), psf, padding=2)
    assert_close(shapes.eta, to_xp(eta, dtype), **tolerance("fitted laws", dtype), xp=xp)
    assert_close(shapes.size, to_xp(np.full(3, 3.0), dtype), **tolerance("fitted sizes", dtype))


def test_a_fixed_size_is_kept_and_flagged(psf, dtype, xp, to_xp):
    stamps = to_xp(galaxies(E, centres=CENTRES), dtype)
    shapes = shape_method("gauss-1")(stamps, psf, size=2.0, noise_variance=NOISE)
    assert_close(shapes.size, to_xp(np.full(5, 2.0), dtype), **tolerance("algebra", dtype), xp=xp)
    assert [("SIZE_FIXED" in names(shapes, i)) for i in range(5)] == [True] * 5
    # Round galaxies are round at any size; the others are not far off.
    assert_close(shapes.e, to_xp(E, dtype), rtol=0, atol=0.1, xp=xp)


def test_stamps_that_are_not_square(xp, dtype, to_xp):
    stamps = to_xp(galaxies(E[1:4], (40, 53), sigma=2.0), dtype)
    psf = fx.Psf.from_image(to_xp(star((31, 50)), dtype))
    shapes = shape_method("gauss-1")(stamps, psf)
    assert_close(shapes.e, to_xp(E[1:4], dtype), **tolerance("small stamps", dtype), xp=xp)


# --- errors ----------------------------------------------------------------------------


@pytest.mark.parametrize(("method", "right"), [("gauss-1", True), ("exponential", False)])
def test_errors_are_those_of_the_scatter(method, right):
    # Noise of 1/60 of the galaxy: the errors are still linear. The law need not be right.
    rng = np.random.default_rng(3)
    clean = galaxies(np.tile([[0.3, -0.2]], (400, 1)), (32, 32), sigma=2.0)
    sigma = np.sqrt(np.sum(clean[0] ** 2)) / 60.0
    noisy = clean + sigma * rng.standard_normal(clean.shape)
    shapes = shape_method(method)(noisy, fx.Psf.from_image(star()), noise_variance=sigma**2)
    good = shapes.measured
    assert np.mean(good) == 1.0
    scatter = np.cov(shapes.eta.T)
    reported = np.mean(shapes.eta_cov, axis=0)
    np.testing.assert_allclose(np.sqrt(reported.diagonal()), np.sqrt(scatter.diagonal()), rtol=0.11)
    assert right == (abs(float(np.mean(shapes.e[:, 0])) - 0.3) < 0.01)


# --- one galaxy, many galaxies, other galaxies -----------------------------------------


@pytest.fixture(scope="module")
def noisy():
    rng = np.random.default_rng(8)
    e = rng.uniform(-0.5, 0.5, (8, 2))
    clean = galaxies(e, centres=rng.uniform(-1, 1, (8, 2)))
    sigma = np.sqrt(np.mean(np.sum(clean**2, axis=(1, 2)))) / 200.0
    return clean + sigma * rng.standard_normal(clean.shape), sigma**2


@pytest.mark.parametrize("method", METHODS)
def test_libraries_agree(method, noisy, xp, to_xp):
    expected = shape_method(method)(noisy[0], fx.Psf.from_image(star()), noise_variance=noisy[1])
    psf = fx.Psf.from_image(to_xp(star()))
    shapes = shape_method(method)(to_xp(noisy[0]), psf, noise_variance=noisy[1])
    assert_close(shapes.eta, to_xp(expected.eta), rtol=0, atol=1e-7, xp=xp)
    assert_close(shapes.eta_cov, to_xp(expected.eta_cov), rtol=1e-6, atol=1e-12, xp=xp)
    assert_equal(shapes.flags, to_xp(expected.flags), xp=xp)


def test_alone_or_together_and_beside_the_bad(noisy, dtype, xp, to_xp):
    clean = noisy[0][:3]
    bad = [np.full((48, 48), np.nan), np.zeros((48, 48)), -clean[0]]
    mixed = np.stack([bad[0], clean[0], bad[1], clean[1], bad[2], clean[2]])
    psf = fx.Psf.from_image(to_xp(star(), dtype))
    together = shape_method("exponential")(to_xp(mixed, dtype), psf, chunk_size=4)
    assert [bool(m) for m in together.measured] == [False, True] * 3
    for i in range(3):
        alone = shape_method("exponential")(to_xp(clean[i : i + 1], dtype), psf)
        limits = tolerance("fitted shapes", dtype)
        assert_close(together.eta[2 * i + 1, :], alone.eta[0, :], **limits, xp=xp)
    assert names(together, 0) == ["NON_FINITE_PIXEL"]
    assert "NO_SIGNAL" in names(together, 2)
    assert bool(xp.all(xp.isnan(together.eta[0, :])))


def test_pure_noise_raises_nothing(psf, dtype, to_xp, to_np):
    images = to_xp(np.random.default_rng(4).standard_normal((3, 40, 40)), dtype)
    for method in ("gauss-3", "devaucouleurs"):
        shapes = shape_method(method)(images, psf, noise_variance=1.0)
        measured = to_np(shapes.measured)
        assert np.array_equal(np.isfinite(to_np(shapes.eta[:, 0])), measured)


def test_a_psf_for_each_galaxy_and_a_bad_one(dtype, xp, to_xp, to_np):
    covariances = [PSF_COVARIANCE, gaussian_covariance((-0.1, 0.1), 1.6), 1.3 * PSF_COVARIANCE]
    galaxy = gaussian_covariance((0.25, 0.15), 2.4)
    images = to_xp(np.stack([gaussian_image(galaxy + c) for c in covariances]), dtype)
    stars = np.stack([gaussian_image(c) for c in covariances])
    stars[1] = np.nan
    shapes = shape_method("gauss-1")(images, fx.Psf.from_image(to_xp(stars, dtype)), chunk_size=2)
    assert to_np(shapes.measured).tolist() == [True, False, True]
    assert names(shapes, 1) == ["BAD_PSF"]
    expected = to_xp(np.array([0.25, 0.15]), dtype)
    for i in (0, 2):
        assert_close(shapes.e[i, :], expected, **tolerance("fitted shapes", dtype), xp=xp)


def test_an_empty_batch(psf, dtype, to_xp):
    shapes = shape_method("gauss-1")(to_xp(np.empty((0, 48, 48)), dtype), psf)
    assert shapes.n_gal == 0


def test_the_fit_ends_when_it_may_not_go_on(to_xp, to_np, xp):
    stamps = to_xp(galaxies(E[1:3]))
    psf = fx.Psf.from_image(to_xp(star()))
    drawing = Drawing.through(xp, psf, (48, 48), 2, stamps.dtype)
    fit = ImageFit.of(drawing, exponential(), stamps, size=None)
    minimum = find_minimum(fit, fit.start(0.8), max_iter=1)
    assert to_np(minimum.status).tolist() == [1, 1]
    assert to_np(minimum.n_eval).tolist() == [2, 2]


# --- bad calls -------------------------------------------------------------------------


def test_bad_calls(psf, to_xp, dtype):
    stamps = to_xp(galaxies(E), dtype)
    with pytest.raises(RangeError):
        shape_method("gauss-1")(stamps, psf, size=-1.0)
    with pytest.raises(RangeError):
        shape_method("gauss-1")(stamps, psf, noise_variance=-1.0)
    with pytest.raises(ShapeMismatchError):
        shape_method("gauss-1")(stamps[0, :, :], psf)


def test_an_unknown_method_lists_the_known():
    with pytest.raises(FdntValueError, match=r"gauss-5.*fdnt-ft.*nb07.*gauss-1.*devaucouleurs"):
        shape_method("gauss-5")
