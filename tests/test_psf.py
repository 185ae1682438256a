"""The PSF in Fourier space, against direct sums and what is known of Gaussians."""

from __future__ import annotations

import numpy as np
import pytest
from array_api_extra.testing import assert_close, assert_equal
from scipy.integrate import quad
from scipy.optimize import brentq
from scipy.special import i0e, j0

from fdnt_xp.errors import FdntTypeError, FdntValueError, RangeError, ShapeMismatchError
from fdnt_xp.fourier import circles
from fdnt_xp.fourier.grid import half_plane_disc
from fdnt_xp.fourier.psf import Psf
from images import gaussian_covariance, gaussian_image
from tolerances import tolerance

FLOOR = 1e-3
"""High enough that a Gaussian of sigma 1.5 is sampled without aliasing up to kmax."""
SIGMA = 1.5
SHAPE = (22, 25)
ROUND = gaussian_image(gaussian_covariance((0.0, 0.0), SIGMA), SHAPE)
ELLIPTICAL = gaussian_covariance((0.25, -0.15), SIGMA)
SCAN_CELL = np.pi / 47
JAX_COMPILES = pytest.mark.skip_backend(
    "jax", reason="compiles anew for each shape; one shape is run"
)


def elliptical_power(k):
    """Return `<|T|^-2>^-1` of the elliptical Gaussian: `|T|^-2 = exp(k² (a + b cos 2θ))`."""
    a = SIGMA**2
    b = SIGMA**2 * np.hypot(0.25, 0.15)
    return np.exp(-(k**2) * (a + b)) / i0e(k**2 * b)


def direct_transfer(image, kx, ky, oversampling):
    """Return `sum P(x) exp(-i k.x) / sum P` with x from the flux centroid, mode by mode."""
    y, x = np.indices(image.shape) / oversampling
    total = np.sum(image)
    x, y = x - np.sum(image * x) / total, y - np.sum(image * y) / total
    modes = zip(kx, ky, strict=True)
    return np.array([np.sum(image * np.exp(-1j * (p * x + q * y))) for p, q in modes]) / total


@pytest.fixture
def make_grid(xp, device):
    """Return `make(shape, kmax, dtype)`."""

    def make(shape, kmax, dtype):
        return half_plane_disc(xp, shape, kmax, dtype=dtype, device=device)

    return make


@pytest.fixture
def assert_complex(xp, dtype, to_xp):
    """Return the check of a complex array against a NumPy one."""

    def check(actual, expected, quantity="sums"):
        tol = tolerance(quantity, dtype)
        assert_close(xp.real(actual), to_xp(expected.real, dtype), **tol, xp=xp)
        assert_close(xp.imag(actual), to_xp(expected.imag, dtype), **tol, xp=xp)

    return check


# --- the transfer function -----------------------------------------------------------


@pytest.mark.parametrize(
    ("image", "shape", "oversampling"),
    [
        (SHAPE, (11, 12), 2.5),
        pytest.param((5, 6), (5, 6), 1.0, marks=JAX_COMPILES),
        pytest.param((6, 6), (8, 8), 1.0, marks=JAX_COMPILES),
        pytest.param((5, 5), (4, 7), 3.0, marks=JAX_COMPILES),
    ],
    ids=["even x odd, oversampled", "odd x even", "even", "odd, smaller grid"],
)
def test_transfer_is_the_direct_sum(
    image, shape, oversampling, dtype, make_grid, to_xp, to_np, assert_complex
):
    # Any image will do: random ones are off-centre and have no symmetry.
    stars = np.random.default_rng(1).uniform(size=(2, *image))
    psf = Psf.from_image(to_xp(stars, dtype), oversampling=oversampling)
    grid = make_grid(shape, 3.0, dtype)
    kx, ky = to_np(grid.kx).astype(float), to_np(grid.ky).astype(float)
    expected = np.array([direct_transfer(star, kx, ky, oversampling) for star in stars])
    actual = psf.transfer(grid)
    assert actual.shape == (2, grid.n_k)
    assert_complex(actual, expected)


def test_transfer_is_about_the_flux_centroid(dtype, make_grid, to_xp, to_np, assert_complex):
    # A star anywhere in its array, of any brightness, has a real transfer function.
    star = gaussian_image(ELLIPTICAL, SHAPE, centre=(1.3, -0.45), flux=7.0)
    psf = Psf.from_image(to_xp(star, dtype), floor=FLOOR)
    np.testing.assert_allclose(to_np(psf.centre), [[1.3, -0.45]], atol=1e-5)
    grid = make_grid((11, 12), 2.0, dtype)
    modes = np.stack([to_np(grid.kx), to_np(grid.ky)]).astype(float)
    expected = np.exp(-0.5 * np.sum(modes * (ELLIPTICAL @ modes), axis=0))
    assert_complex(psf.transfer(grid), expected[None, :] + 0j, "deconvolved")
    assert to_np(psf.transfer(grid))[0, 0] == pytest.approx(1.0, abs=1e-6)


def test_oversampling_shrinks_the_star(dtype, make_grid, to_xp, to_np, assert_complex):
    # Pixels half as large: half the size and the offset in pixels of the galaxies.
    star = gaussian_image(ELLIPTICAL, SHAPE, centre=(2.0, 1.0))
    psf = Psf.from_image(to_xp(star, dtype), oversampling=2.0, floor=1e-1)
    np.testing.assert_allclose(to_np(psf.centre), [[1.0, 0.5]], atol=1e-5)
    grid = make_grid((11, 12), 2.0, dtype)
    modes = np.stack([to_np(grid.kx), to_np(grid.ky)]).astype(float)
    expected = np.exp(-0.5 * np.sum(modes * (ELLIPTICAL @ modes), axis=0) / 4.0)
    assert_complex(psf.transfer(grid), expected[None, :] + 0j, "deconvolved")
    crossing = 2.0 * brentq(lambda k: elliptical_power(k) - 1e-1, 0.5, 2.0)
    assert float(to_np(psf.kmax)[0]) == pytest.approx(crossing, abs=1e-3)


def test_the_inverse_ends_at_each_kmax(dtype, make_grid, to_xp, to_np, assert_complex):
    wide = gaussian_image(gaussian_covariance((0.0, 0.0), 2.0), SHAPE)
    psf = Psf.from_image(to_xp([ROUND, wide], dtype), floor=FLOOR)
    grid = make_grid((11, 12), psf.largest_kmax + 0.4, dtype)
    kmax, radius = to_np(psf.kmax), np.hypot(to_np(grid.kx), to_np(grid.ky))
    assert psf.largest_kmax == pytest.approx(kmax[0])
    assert kmax[1] < kmax[0]
    inside = radius[None, :] < kmax[:, None]
    assert 0 < np.sum(inside[1]) < np.sum(inside[0]) < grid.n_k
    inverse = to_np(psf.inverse_transfer(grid))
    assert np.all(inverse[~inside] == 0)
    product = to_np(psf.transfer(grid)) * inverse
    np.testing.assert_allclose(product[inside], 1.0, atol=1e-5)


# --- kmax and the weight -------------------------------------------------------------


@pytest.mark.parametrize("floor", [1e-1, 1e-2, 1e-3])
def test_kmax_of_a_gaussian(floor, dtype, to_xp, to_np):
    # |T|² = exp(-k² sigma²). ln P is taken for linear in a cell h of the scan; it is
    # quadratic, and the chord crosses the floor up to h²/8k early.
    psf = Psf.from_image(to_xp(ROUND, dtype), floor=floor)
    exact = np.sqrt(-np.log(floor)) / SIGMA
    early = exact - float(to_np(psf.kmax)[0])
    assert -1e-5 <= early <= SCAN_CELL**2 / (8.0 * exact) + 1e-5


def test_the_weight_ends_at_the_first_fall_below_the_floor(dtype, to_xp, to_np):
    # A ring of stars: T = J0(kR) exp(-k²/2) is zero at kR = 2.405, and large again beyond.
    centres = [(3.0 * np.cos(a), 3.0 * np.sin(a)) for a in 2.0 * np.pi * np.arange(24) / 24]
    ring = np.mean([gaussian_image(np.eye(2), SHAPE, centre=c) for c in centres], axis=0)
    psf = Psf.from_image(to_xp(ring, dtype), floor=1e-2)
    first = brentq(lambda k: j0(3.0 * k) ** 2 * np.exp(-(k**2)) - 1e-2, 0.1, 2.405 / 3.0)
    assert j0(3.8) ** 2 * np.exp(-((3.8 / 3.0) ** 2)) > 1e-2  # the second lobe is above it
    assert float(to_np(psf.kmax)[0]) == pytest.approx(first, abs=SCAN_CELL)


def test_a_point_reaches_the_end_of_the_grid(dtype, make_grid, to_xp, to_np):
    # In float32 pi is rounded up; the Nyquist modes must stay out all the same.
    point = np.zeros((5, 6))
    point[2, 3] = 2.0
    psf = Psf.from_image(to_xp(point, dtype))
    assert psf.largest_kmax == pytest.approx(np.pi)
    assert psf.largest_kmax <= np.pi
    grid = make_grid((8, 8), psf.largest_kmax, dtype)
    assert np.max(to_np(grid.kx)) < 3.0


def test_the_weight_is_the_harmonic_mean_of_the_power(xp, dtype, to_xp, to_np):
    # For an elliptical Gaussian it is known; and so is the ending, P (1 - t⁸ P_end/P)².
    psf = Psf.from_image(to_xp(gaussian_image(ELLIPTICAL, SHAPE), dtype), floor=FLOOR)
    kmax = float(to_np(psf.kmax)[0])
    crossing = brentq(lambda k: elliptical_power(k) - FLOOR, 0.5, 3.0)
    assert kmax == pytest.approx(crossing, abs=1e-3)
    t = np.linspace(0.0, 1.0, 53)[None, :]
    power, end = elliptical_power(kmax * t), elliptical_power(kmax)
    expected = to_xp(power * (1.0 - t**8 * end / power) ** 2, dtype)
    value, _ = psf.weight.evaluate(to_xp(t, dtype))
    assert_close(value, expected, **tolerance("weight", dtype), xp=xp)


def test_the_weight_ends_smoothly(dtype, to_xp, to_np):
    psf = Psf.from_image(to_xp(ROUND, dtype), floor=1e-1)
    near = 1.0 - np.array([[0.04, 0.02, 0.01, 0.0, -0.5]])
    value, slope = (to_np(part)[0] for part in psf.weight.evaluate(to_xp(near, dtype)))
    assert np.all(value[3:] == 0.0)
    assert np.all(slope[3:] == 0.0)
    # As a square: half as far from the end, a quarter of the value and half of the slope.
    np.testing.assert_allclose(value[:2] / value[1:3], 4.0, rtol=0.2)
    np.testing.assert_allclose(slope[:2] / slope[1:3], 2.0, rtol=0.2)
    # To the very end: no kink remains where the table stops.
    _, last = psf.weight.evaluate(to_xp([[1.0 - 1e-5]], dtype))
    assert abs(float(to_np(last)[0, 0])) < 2e-3 * abs(slope[2])


@JAX_COMPILES
def test_a_psf_that_the_grid_cuts_keeps_its_weight(dtype, to_xp, to_np):
    # T = 0.6 + 0.2 (cos 2kx + cos 2ky) is 0.2 in the middle of a quadrant, and 1 at (pi, 0):
    # the power at the end is larger than inside.
    star = np.zeros((5, 5))
    star[2, 2], star[[0, 2, 2, 4], [2, 0, 4, 2]] = 6.0, 1.0
    psf = Psf.from_image(to_xp(star, dtype))
    assert float(to_np(psf.kmax)[0]) == pytest.approx(np.pi)

    def power(k):
        def inverse(angle):
            x, y = 2.0 * k * np.cos(angle), 2.0 * k * np.sin(angle)
            return (0.6 + 0.2 * (np.cos(x) + np.cos(y))) ** -2

        return np.pi / quad(inverse, 0.0, np.pi)[0]

    assert power(np.pi) > 2.0 * power(2.2)
    t = np.array([0.1, 0.4, 0.7, 0.9])
    inside, end = np.array([power(np.pi * x) for x in t]), power(np.pi)
    expected = inside * np.maximum(0.0, 1.0 - t**8 * end / inside) ** 2
    assert np.all(expected[:3] > 0.01)
    value, _ = psf.weight.evaluate(to_xp(t[None, :], dtype))
    # Twelve points on a quarter circle do not average it better.
    np.testing.assert_allclose(to_np(value)[0], expected, atol=1e-4)


# --- stacks --------------------------------------------------------------------------


@pytest.fixture(autouse=True)
def _two_at_a_time(monkeypatch):
    """Let stacks be worked on in parts."""
    monkeypatch.setattr(circles, "_PSFS_AT_ONCE", 2)


@pytest.fixture
def three(dtype, to_xp):
    """Three PSFs of three sizes and places, and their stack."""
    stars = [
        gaussian_image(gaussian_covariance((0.1, 0.0), sigma), SHAPE, centre=(x, 0.0), flux=flux)
        for sigma, x, flux in ((1.5, 0.0, 1.0), (1.8, 0.4, 30.0), (2.1, -0.7, 0.1))
    ]
    return stars, Psf.from_image(to_xp(stars, dtype), floor=FLOOR)


def test_a_stack_is_its_psfs(three, xp, dtype, make_grid, to_xp):
    stars, stack = three
    assert stack.n_psf == 3
    grid = make_grid((11, 12), 1.5, dtype)
    t = to_xp(np.linspace(0.0, 1.0, 7)[None, :], dtype)
    transfer = stack.transfer(grid)
    for i, star in enumerate(stars):
        alone = Psf.from_image(to_xp(star, dtype), floor=FLOOR)
        row = stack.take(to_xp([i]))
        assert_close(row.kmax, alone.kmax, **tolerance("default", dtype), xp=xp)
        assert_close(row.centre, alone.centre, **tolerance("sums", dtype), xp=xp)
        ours, theirs = row.weight.evaluate(t)[0], alone.weight.evaluate(t)[0]
        assert_close(ours, theirs, **tolerance("sums", dtype), xp=xp)
        ours, theirs = transfer[i : i + 1, :], alone.transfer(grid)
        assert_close(xp.real(ours), xp.real(theirs), **tolerance("sums", dtype), xp=xp)
        assert_close(xp.imag(ours), xp.imag(theirs), **tolerance("sums", dtype), xp=xp)


def test_take_reorders_and_repeats(three, xp, dtype, to_xp):
    _, stack = three
    rows = to_xp([2, 0, 2])
    taken = stack.take(rows)
    for name in ("image", "centre", "kmax", "usable"):
        expected = xp.take(getattr(stack, name), rows, axis=0)
        assert_equal(getattr(taken, name), expected, xp=xp)
    t = to_xp([0.2, 0.3, 0.4], dtype)
    ours = taken.weight.evaluate(t, to_xp([0, 1, 2]))
    theirs = stack.weight.evaluate(t, rows)
    assert_equal(ours[0], theirs[0], xp=xp)
    assert (taken.oversampling, taken.largest_kmax) == (stack.oversampling, stack.largest_kmax)


@pytest.mark.parametrize("shape", [(6, 8), (7, 6), (5, 7)], ids=str)
@pytest.mark.parametrize("unit", [None, [[0.9, 0.2], [-0.1, 1.1]]], ids=["pixels", "sky"])
def test_power_on_circles_is_that_of_direct_sums(shape, unit, dtype, to_xp, to_np):
    # Points of a circle and their mirror images, waves by parity: nothing of it may show.
    images = np.random.default_rng(3).standard_normal((3, *shape))
    frame = None if unit is None else to_xp(np.broadcast_to(unit, (3, 2, 2)).copy(), dtype)
    radii = np.array([[0.0, 0.7, 2.9]])
    power = circles.power_on_circles(
        to_xp(images, dtype), to_xp(np.repeat(radii, 3, axis=0), dtype), 4, 1.5, frame
    )
    angle = np.pi * (np.arange(4) + 0.5) / 4
    sky = np.stack([radii[0, :, None] * np.cos(angle), radii[0, :, None] * np.sin(angle)])
    k = np.tensordot(np.eye(2) if unit is None else np.transpose(unit), sky, axes=1)
    y, x = (np.indices(shape) - 0.5 * (np.array(shape) - 1)[:, None, None]) / 1.5
    waves = np.exp(-1j * (k[0][..., None, None] * x + k[1][..., None, None] * y))
    expected = np.abs(np.einsum("nyx,raxy->nra", images, np.swapaxes(waves, -1, -2))) ** 2
    rtol = 1e-10 if "64" in str(dtype) else 1e-4
    np.testing.assert_allclose(to_np(power), expected, rtol=rtol, atol=rtol)


def test_psfs_of_any_width_are_what_they_are_alone(dtype, to_xp, to_np):
    # They share the circles on which they are summed up, by their width.
    stars = np.stack(
        [gaussian_image(gaussian_covariance((0.1, 0.0), s), (40, 41)) for s in (0.8, 3.5, 1.5, 1.6)]
    )
    together = Psf.from_image(to_xp(stars, dtype), floor=FLOOR)
    tol = 1e-12 if "64" in str(dtype) else 1e-5
    for row, star in enumerate(stars):
        alone = Psf.from_image(to_xp(star, dtype), floor=FLOOR)
        for name in ("kmax", "ln_power"):
            one, other = to_np(getattr(together, name))[row], to_np(getattr(alone, name))[0]
            np.testing.assert_allclose(one, other, rtol=tol, atol=tol, err_msg=name)
    np.testing.assert_allclose(
        to_np(together.kmax)[1], 1.5 / 3.5 * to_np(together.kmax)[2], rtol=1e-3
    )


def test_a_higher_floor_ends_the_weight_where_the_power_falls_below(three, dtype, to_np):
    _, psf = three
    higher = psf.ending_at(0.03)
    assert higher.kmax.dtype == higher.weight.coefficients[0].dtype == dtype
    assert higher.largest_kmax == pytest.approx(float(np.max(to_np(higher.kmax))))
    direct = Psf.from_image(psf.image, floor=0.03)
    # The table of the first has its own smooth end, of no weight where the second's is.
    np.testing.assert_allclose(to_np(higher.kmax), to_np(direct.kmax), rtol=2e-3)
    again = psf.ending_at(1e-12)
    np.testing.assert_allclose(to_np(again.kmax), to_np(psf.kmax), rtol=0.02)


def test_restricted_marks_what_ends_too_early(three, to_np):
    _, stack = three
    kmax = to_np(stack.kmax)
    assert kmax[0] > kmax[1] > kmax[2]
    assert to_np(stack.restricted(float(kmax[1])).usable).tolist() == [True, True, False]
    assert to_np(stack.usable).tolist() == [True, True, True]


BAD = {
    "zero": 0.0 * ROUND,
    "negative": -ROUND,
    "NaN": np.where(ROUND.max() == ROUND, np.nan, ROUND),
    "infinite": np.where(ROUND.max() == ROUND, np.inf, ROUND),
    "both infinities": np.where(ROUND.max() == ROUND, np.inf, -np.inf),
}


def test_a_bad_psf_is_marked_and_harms_no_other(xp, dtype, make_grid, to_xp, to_np):
    psf = Psf.from_image(to_xp([ROUND, *BAD.values(), ROUND], dtype), floor=FLOOR)
    assert to_np(psf.usable).tolist() == [True, *[False] * len(BAD), True]
    kmax = to_np(psf.kmax)
    assert np.all(np.isfinite(kmax))
    assert kmax[0] == kmax[-1] == pytest.approx(2.6283 / SIGMA, abs=1e-3)  # sqrt(ln 1000)
    # Whatever is computed for the bad ones is finite.
    transfer = to_np(psf.transfer(make_grid((11, 12), 1.5, dtype)))
    assert np.all(np.isfinite(transfer))
    np.testing.assert_allclose(transfer[0], transfer[-1], atol=1e-6)
    for coefficients in psf.weight.coefficients:
        assert bool(xp.all(xp.isfinite(coefficients)))


@JAX_COMPILES
def test_no_psfs_at_all(dtype, make_grid, to_xp):
    psf = Psf.from_image(to_xp(np.empty((0, *SHAPE)), dtype))
    assert psf.n_psf == 0
    assert psf.kmax.shape == psf.usable.shape == (0,)
    assert psf.kmax.dtype == dtype
    grid = make_grid((6, 6), 2.0, dtype)
    assert psf.transfer(grid).shape == psf.inverse_transfer(grid).shape == (0, grid.n_k)


# --- what is refused -----------------------------------------------------------------


@pytest.mark.parametrize("name", BAD)
def test_a_single_bad_psf_is_refused(name, to_xp):
    with pytest.raises(FdntValueError, match="image must be finite, with a positive sum"):
        Psf.from_image(to_xp(BAD[name]))


@pytest.mark.parametrize("shape", [(5,), (), (2, 2, 5, 5), (0, 5), (5, 0), (3, 0, 5)], ids=str)
def test_other_ranks_and_empty_axes_are_refused(shape, to_xp):
    with pytest.raises(ShapeMismatchError, match="image must have the shape"):
        Psf.from_image(to_xp(np.ones(shape)))


@pytest.mark.parametrize("oversampling", [0.0, -1.0, np.nan, np.inf])
def test_meaningless_oversampling_is_refused(oversampling, to_xp):
    with pytest.raises(RangeError, match="oversampling"):
        Psf.from_image(to_xp(ROUND), oversampling=oversampling)


@pytest.mark.parametrize("floor", [0.0, 1.0, -0.1, 2.0, np.nan])
def test_meaningless_floor_is_refused(floor, to_xp):
    with pytest.raises(RangeError, match="floor"):
        Psf.from_image(to_xp(ROUND), floor=floor)


def test_what_is_no_array_is_refused():
    with pytest.raises(FdntTypeError, match="image must be an array"):
        Psf.from_image(ROUND.tolist())


def test_counts_become_float64(xp, to_xp):
    counts = np.rint(1000.0 * ROUND / ROUND.max()).astype(np.int32)
    psf = Psf.from_image(to_xp(counts))
    assert psf.image.dtype == xp.float64
    assert_close(psf.image[0, ...], to_xp(counts / counts.sum()), rtol=1e-14, xp=xp)
