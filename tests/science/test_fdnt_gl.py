"""FDNT-GL and missing pixels on galaxies drawn by GalSim, to the bounds of docs/accuracy.md."""

from __future__ import annotations

from functools import lru_cache

import galsim
import numpy as np
import pytest

import fdnt_xp as fx
from fdnt_xp.flags import Flag
from science.galsim_images import ACCURATE, OFFSET, psf_image, relative_error

SIDE = 64
PSF_ANGLE = 28.6
PSF = galsim.Gaussian(half_light_radius=3.0).shear(e=0.14, beta=PSF_ANGLE * galsim.degrees)
RATIO = (0.5, 1.0, 2.0)
DISTORTION = (0.1, 0.3, 0.5)
ANGLES = (0.0, 25.0, 45.0, 90.0, 120.0)
ALONG, ACROSS = 0.0, 90.0
"""Of galaxies from the PSF, degrees."""
MASKS = ["2 %", "5 %", "10 %", "column", "column before"]
N_MASKS = 20


def ellipticity(e, angle):
    twice = 2.0 * np.radians(PSF_ANGLE + angle)
    return np.multiply(e, [np.cos(twice), np.sin(twice)])


@lru_cache
def stamp(index, e, half_light_radius, angle=ALONG, side=SIDE):
    galaxy = galsim.Sersic(index, half_light_radius=half_light_radius, gsparams=ACCURATE)
    galaxy = galaxy.shear(e=e, beta=(PSF_ANGLE + angle) * galsim.degrees).shift(*OFFSET)
    both = galsim.Convolve([galaxy, PSF], gsparams=ACCURATE)
    return both.drawImage(nx=side, ny=side, scale=1.0, method="no_pixel", dtype=float).array


@pytest.fixture(scope="module")
def star():
    return fx.Psf.from_image(psf_image(PSF, "no_pixel"), floor=1e-6)


def errors(star, index, *, angle=ALONG, transform="gl", order=12):
    """Return |δe|/e by ratio of the sizes and by e, shape (3, 3)."""
    stamps = np.stack([stamp(index, e, 3.0 * r, angle) for r in RATIO for e in DISTORTION])
    truth = np.stack([ellipticity(e, angle) for _ in RATIO for e in DISTORTION])
    shapes = fx.measure_shapes(stamps, star, transform=transform, order=order)
    assert np.all(shapes.measured)
    return relative_error(shapes.e, truth).reshape(3, 3)


# --- whole stamps, no noise ----------------------------------------------------------


@pytest.mark.parametrize("angle", ANGLES)
@pytest.mark.parametrize(
    ("index", "order", "bound"),
    [
        (0.5, 12, 5e-5),
        (1.0, 12, 5e-5),
        (2.0, 12, 1e-3),
        (4.0, 12, 5e-3),
        (0.5, 16, 5e-5),
        (1.0, 16, 5e-5),
        (2.0, 16, 2e-4),
        (4.0, 16, 1e-3),
    ],
)
def test_bias_of_too_few_functions(index, order, bound, angle, star):
    # Of these, the large elongated Gaussian at order 16 is the one that the stamp cuts off.
    assert np.max(errors(star, index, angle=angle, order=order)) <= bound


@pytest.mark.parametrize("order", [12, 16])
def test_galaxies_across_the_psf_are_the_hardest(order, star):
    by_angle = {angle: errors(star, 4.0, angle=angle, order=order) for angle in ANGLES}
    across = by_angle[ACROSS]
    assert max(np.max(error) for error in by_angle.values()) == np.max(across)
    # It is the elongated, small galaxy that is.
    assert np.argmax(across) == 2
    assert across[0, 2] > 2.0 * by_angle[ALONG][0, 2]


def test_a_whole_stamp_needs_no_functions(star):
    ft, gl, gl16 = (
        errors(star, 2.0, angle=ACROSS, transform=transform, order=order)[:2, 1:]
        for transform, order in (("ft", 12), ("gl", 12), ("gl", 16))
    )
    assert np.all(np.max(ft) < gl16)
    assert np.all(gl16 < gl)


def test_a_low_order_is_biased(star):
    assert np.max(errors(star, 4.0, order=4)) > 2e-2


# --- missing pixels ------------------------------------------------------------------


def present(name):
    """Return which pixels of 20 stamps are there; those of a column only once."""
    rng = np.random.default_rng(1)
    if name.endswith("%"):
        return rng.random((N_MASKS, SIDE, SIDE)) > 0.01 * float(name[:-1])
    there = np.ones((1, SIDE, SIDE), dtype=bool)
    there[:, :, SIDE // 2 + (1 if name == "column" else -1)] = False
    return there


@pytest.mark.parametrize("angle", [25.0, 90.0, 120.0])
@pytest.mark.parametrize("name", MASKS)
def test_bias_of_missing_pixels(name, angle, star):
    there = present(name)
    for index, bound in ((1.0, 2e-4), (2.0, 2e-3)):
        stamps = np.where(there, stamp(index, 0.3, 3.0, angle), np.nan)
        for transform in ("gl", "hybrid"):
            shapes = fx.measure_shapes(stamps, star, ivar=1.0 * there, transform=transform)
            assert np.all(shapes.measured)
            error = relative_error(shapes.e, np.tile(ellipticity(0.3, angle), (len(there), 1)))
            assert np.max(error) <= bound
            assert np.median(error) <= 0.5 * bound


@pytest.mark.parametrize("transform", ["gl", "hybrid"])
def test_what_is_cut_through_is_flagged(transform, star):
    there = np.ones((9, SIDE, SIDE))
    middle = SIDE // 2
    there[0, middle:, middle:] = 0.0
    there[1, :middle, middle:] = 0.0
    there[2, middle + 3 :, middle + 3 :] = 0.0
    there[3, :, middle + 6 :] = 0.0
    y, x = np.indices((SIDE, SIDE)) - middle
    there[4] = np.hypot(x, y) > 4.0
    there[5] = np.hypot(x, y) > 3.0
    there[6, :, middle - 1 : middle + 3] = 0.0
    there[7, :, middle : middle + 2] = 0.0
    filled = int(Flag.FILLED) if transform == "hybrid" else 0
    for index in (1.0, 2.0):
        stamps = np.repeat(stamp(index, 0.3, 3.0)[None], 9, axis=0)
        shapes = fx.measure_shapes(stamps, star, ivar=there, transform=transform)
        assert shapes.flags.tolist() == [int(Flag.GL_FAILURE)] * 7 + [filled, 0]
        assert np.all(np.isnan(shapes.eta[:7]))


# --- noise ---------------------------------------------------------------------------


def test_errors_are_the_scatter(star):
    n, side = 1000, 48
    image = stamp(1.0, 0.3, 3.0, side=side)
    sigma = np.sqrt(np.sum(image**2)) / 200.0
    rng = np.random.default_rng(2)
    stamps = image + sigma * rng.standard_normal((n, side, side))
    one_mask = rng.random((1, side, side)) > 0.05
    ivar = np.repeat(one_mask, n, axis=0) / sigma**2
    whole = fx.measure_shapes(stamps, star, noise_variance=sigma**2)
    error = {"whole": np.sqrt(np.trace(np.mean(whole.eta_cov, axis=0)))}
    scatter = {"whole": np.sqrt(np.trace(np.cov(whole.eta.T)))}
    for transform in ("gl", "hybrid"):
        shapes = fx.measure_shapes(stamps, star, ivar=ivar, transform=transform)
        assert np.all(shapes.measured)
        error[transform] = np.sqrt(np.trace(np.mean(shapes.eta_cov, axis=0)))
        scatter[transform] = np.sqrt(np.trace(np.cov(shapes.eta.T)))
        d = shapes.eta - np.mean(shapes.eta, axis=0)
        chi_square = np.einsum("gi,gij,gj->g", d, np.linalg.inv(shapes.eta_cov), d)
        assert np.mean(chi_square) == pytest.approx(2.0, abs=4.0 * np.sqrt(4.0 / n))
    for name, reported in error.items():
        assert scatter[name] == pytest.approx(reported, rel=0.05)
        # The same noise with and without the gaps: what they add is seen far better.
        grown = error[name] / error["whole"]
        assert scatter[name] / scatter["whole"] == pytest.approx(grown, rel=0.02)
