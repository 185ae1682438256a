"""Responses of galaxies: against finite shears, in any part of a catalog, on every library."""

from __future__ import annotations

import math

import numpy as np
import pytest
from array_api_extra.testing import assert_close

import fdnt_xp as fx
from fdnt_xp.data.catalog import read_catalog, write_catalog
from fdnt_xp.errors import (
    FdntTypeError,
    FdntValueError,
    NamespaceError,
    RangeError,
    ShapeMismatchError,
)
from fdnt_xp.flags import Flag
from fdnt_xp.shears.cuts import FrameQuantities
from fdnt_xp.shears.responses import COLUMNS, FRAMES
from images import PSF_COVARIANCE, gaussian_image, ring, star
from tolerances import tolerance

SHEAR = np.array([0.02, -0.01])
FIELDS = ("v", "response", "snr", "flux", "size", "centroid")


def noisy_ring(g=SHEAR, *, snr=20.0, n=16, seed=0):
    """Return a ring of galaxies with noise, and the variance of a pixel."""
    images = ring(g, n=n)
    sigma = math.sqrt(np.mean(np.sum(images**2, axis=(1, 2)))) / snr
    noise = np.random.default_rng(seed).standard_normal(images.shape)
    return images + sigma * noise, sigma**2


@pytest.fixture
def psf(to_xp, dtype):
    return fx.Psf.from_image(to_xp(star(), dtype))


# --- what is measured ----------------------------------------------------------------


def test_the_response_is_that_to_a_real_shear():
    psf = fx.Psf.from_image(star())
    plain = fx.measure_responses(ring((0.0, 0.0), n=3), psf, step=0.005)
    for j in (0, 1):
        shear = 0.005 * np.eye(2)[j]
        plus, minus = (
            fx.measure_responses(ring(sign * shear, n=3), psf, step=0.005).v for sign in (1, -1)
        )
        np.testing.assert_allclose(
            plain.response[:, :, j], (plus - minus) / 0.01, atol=1e-5 * np.max(plain.response)
        )


def test_a_round_galaxy_is_isotropic_and_has_its_size_and_flux():
    psf = fx.Psf.from_image(star())
    covariance = 2.2**2 * np.eye(2)
    image = gaussian_image(covariance + PSF_COVARIANCE, centre=(0.4, -0.7), flux=30.0)
    result = fx.measure_responses(image[None], psf)
    np.testing.assert_allclose(result.v, 0.0, atol=1e-6)
    a, b = result.response[0, 0, 0], result.response[0, 1, 1]
    assert a == pytest.approx(b, rel=1e-4)
    assert a > 0
    np.testing.assert_allclose(result.response[0, [0, 1], [1, 0]], 0.0, atol=1e-4 * a)
    np.testing.assert_allclose(result.centroid[0], [23.9, 22.8], atol=1e-5)
    # Under a weight that were a Gaussian the size would be exact.
    assert result.size[0, 0] == pytest.approx(2.2, rel=0.05)
    assert np.all(np.isnan(result.snr))
    assert 0 < result.flux[0, 0] < 30.0


def test_snr_is_the_scatter_of_the_flux():
    psf = fx.Psf.from_image(star())
    image = ring((0.0, 0.0), n=1)[0]
    rng = np.random.default_rng(1)
    sigma = math.sqrt(np.sum(image**2)) / 20.0
    stamps = image + sigma * rng.standard_normal((800, 48, 48))
    for isotropise in (False, True):
        result = fx.measure_responses(
            stamps, psf, noise_variance=sigma**2, isotropise=isotropise, seed=4
        )
        flux = result.flux[:, 0]
        # The scatter of 800 is known to 2.5 %.
        assert np.mean(flux) / np.std(flux) == pytest.approx(np.mean(result.snr[:, 0]), rel=0.08)


def test_the_libraries_agree(xp, dtype, psf, to_xp, to_np):
    stamps, variance = noisy_ring()
    host = fx.measure_responses(stamps, fx.Psf.from_image(star()), noise_variance=variance, seed=3)
    ours = fx.measure_responses(to_xp(stamps, dtype), psf, noise_variance=variance, seed=3)
    for name in FIELDS:
        column = getattr(ours, name)
        assert column.dtype == dtype
        np.testing.assert_allclose(
            to_np(column), getattr(host, name), **tolerance("responses", dtype), err_msg=name
        )
    np.testing.assert_array_equal(to_np(ours.flags), host.flags)


def test_chunks_order_and_bad_mates_change_nothing():
    stamps, variance = noisy_ring()
    psf = fx.Psf.from_image(star())
    names = np.arange(100, 116)
    whole = fx.measure_responses(stamps, psf, noise_variance=variance, identifiers=names)
    order = np.random.default_rng(2).permutation(16)
    bad = np.concatenate([stamps[order], np.full((1, 48, 48), np.nan), np.zeros((1, 48, 48))])
    again = fx.measure_responses(
        bad,
        psf,
        noise_variance=variance,
        identifiers=np.concatenate([names[order], [1, 2]]),
        chunk_size=5,
    )
    for name in FIELDS:
        np.testing.assert_allclose(
            getattr(again, name)[:16], getattr(whole, name)[order], rtol=1e-9, atol=1e-11
        )
        assert np.all(np.isnan(getattr(again, name)[16:]))
    assert again.flags[16:].tolist() == [int(Flag.NON_FINITE_PIXEL), int(Flag.NO_SIGNAL)]
    assert again.measured.tolist() == [True] * 16 + [False] * 2


def test_the_seed_and_the_name_choose_the_noise():
    stamps, variance = noisy_ring(n=8)
    psf = fx.Psf.from_image(star())
    options = {"noise_variance": variance, "identifiers": np.zeros(8, dtype=np.int64)}
    one = fx.measure_responses(stamps, psf, seed=1, **options)
    assert np.array_equal(one.v, fx.measure_responses(stamps, psf, seed=1, **options).v)
    assert not np.any(one.v == fx.measure_responses(stamps, psf, seed=2, **options).v)
    same = fx.measure_responses(np.stack([stamps[0]] * 2), psf, noise_variance=variance)
    assert not np.any(same.v[0] == same.v[1])


def test_a_galaxy_lost_in_a_frame_counts_nothing_there():
    # So far from the middle of its stamp that the search does not arrive.
    covariance = 2.2**2 * np.eye(2) + PSF_COVARIANCE
    image = gaussian_image(covariance, centre=(11.0, 9.0))
    result = fx.measure_responses(image[None], fx.Psf.from_image(star()), noise_variance=1e-9)
    assert result.flags.tolist() == [int(Flag.LOST_IN_FRAME)]
    assert bool(result.measured[0])
    np.testing.assert_array_equal(result.v, 0.0)
    assert np.isnan(result.snr[0, 0])


# --- the shear of a catalog ----------------------------------------------------------


def test_a_ring_gives_its_shear_to_second_order(psf, xp, dtype, to_xp):
    result = fx.measure_responses(to_xp(ring(SHEAR, n=16), dtype), psf)
    estimate = fx.shear_from_responses(result)
    bound = 2.0 * np.sum(SHEAR**2) * np.linalg.norm(SHEAR)
    assert_close(estimate.g, to_xp(SHEAR, dtype), rtol=0, atol=bound, xp=xp)
    assert estimate.n_used == 16
    assert estimate.method == "responses"


def test_the_error_is_of_second_order_in_the_shear():
    psf = fx.Psf.from_image(star())
    m = []
    for g in (0.02, 0.04, 0.08):
        result = fx.measure_responses(ring((g, 0.0), n=16), psf, step=0.0025)
        m.append(float(fx.shear_from_responses(result).g[0]) / g - 1.0)
    assert abs(m[0]) < 1e-3
    np.testing.assert_allclose(np.array(m[1:]) / m[0], [4.0, 16.0], rtol=0.15)


def test_errors_are_those_of_the_ratio():
    stamps, variance = noisy_ring(snr=15.0, n=400)
    psf = fx.Psf.from_image(star())
    result = fx.measure_responses(stamps, psf, noise_variance=variance)
    # Neighbours in the ring are not independent, as the jackknife wants its groups.
    result = result.take(np.random.default_rng(1).permutation(400))
    estimate = fx.shear_from_responses(result)
    np.testing.assert_allclose(estimate.g_err_jackknife, estimate.g_err, rtol=0.3)
    parts = [
        fx.shear_from_responses(result.take(np.arange(20 * i, 20 * i + 20))).g for i in range(20)
    ]
    scatter = np.std(parts, axis=0, ddof=1) / math.sqrt(20)
    # Twenty parts of two components fix their scatter to 11 %.
    ratio = np.sqrt(np.mean((scatter / estimate.g_err) ** 2))
    assert ratio == pytest.approx(1.0, abs=0.35)


def test_weights_and_rows():
    stamps, variance = noisy_ring(n=32)
    result = fx.measure_responses(stamps, fx.Psf.from_image(star()), noise_variance=variance)
    half = np.where(np.arange(32) % 2 == 0, 1.0, 0.0)
    weighed = fx.shear_from_responses(result, galaxy_weight=half)
    taken = fx.shear_from_responses(result.take(np.arange(0, 32, 2)))
    np.testing.assert_allclose(weighed.g, taken.g, rtol=1e-12)
    assert weighed.n_used == taken.n_used == 16


@pytest.mark.parametrize("quantity", ["snr", "flux", "size"])
def test_a_cut_brings_its_response(quantity):
    # Sizes and fluxes spread as those of a survey, cut softly in the middle: what passes
    # depends on the shear, and the shear comes back all the same.
    psf, g = fx.Psf.from_image(star()), (0.01, 0.0)
    parts = [(flux, sigma) for flux in (0.5, 1.0, 2.0) for sigma in (1.6, 2.0, 2.5)]
    images = np.concatenate([flux * ring(g, n=16, sigma=sigma) for flux, sigma in parts])
    options = {"noise_variance": 1e-6, "isotropise": False}
    result = fx.measure_responses(images, psf, **options)
    value = getattr(result, quantity)[:, 0]
    cut = fx.Cut(quantity=quantity, low=float(np.median(value)), width=0.1 * float(np.ptp(value)))
    estimate = fx.shear_from_responses(result, cut=cut)
    np.testing.assert_allclose(estimate.g, g, atol=1e-5)
    # Without the response of the cut itself it is felt.
    weight = cut(
        FrameQuantities(flux=result.flux[:, 0], snr=result.snr[:, 0], size=result.size[:, 0])
    )
    naive = np.sum(weight * result.v[:, 0]) / np.sum(weight * result.response[:, 0, 0])
    assert abs(naive - g[0]) > 1e-4
    # The null needs no response, and is exact.
    null = fx.population_null(images, psf, cut=cut, **options)
    np.testing.assert_allclose(null.g, g, atol=2e-6)


@pytest.mark.parametrize("suffix", [".fits", ".ecsv"])
def test_a_catalog_on_disk_gives_the_same(tmp_path, suffix):
    stamps, variance = noisy_ring()
    result = fx.measure_responses(stamps, fx.Psf.from_image(star()), noise_variance=variance)
    cut = {"snr": (10.0, None)}
    path = tmp_path / f"catalog{suffix}"
    table = result.to_table()
    assert table.colnames == list(COLUMNS)
    write_catalog(table, path)
    here = fx.shear_from_responses(result, cut=cut)
    there = fx.shear_from_responses(read_catalog(path), cut=cut)
    np.testing.assert_allclose(there.g, here.g, rtol=1e-12)
    np.testing.assert_allclose(there.g_err, here.g_err, rtol=1e-9)


# --- bad calls -----------------------------------------------------------------------


@pytest.mark.parametrize("step", [0.0, 0.2, float("nan")])
def test_steps_out_of_range(step):
    with pytest.raises(RangeError, match="step = "):
        fx.measure_responses(ring(SHEAR), fx.Psf.from_image(star()), step=step)


def test_no_stamps_are_no_error():
    result = fx.measure_responses(np.zeros((0, 48, 48)), fx.Psf.from_image(star()))
    assert result.v.shape == (0, 2)
    assert result.snr.shape == (0, len(FRAMES))
    with pytest.raises(FdntValueError, match="0 of 0 galaxies"):
        fx.shear_from_responses(result)


def test_what_is_no_catalog():
    result = fx.measure_responses(ring(SHEAR), fx.Psf.from_image(star()))
    with pytest.raises(FdntTypeError, match="responses must be"):
        fx.shear_from_responses(3.0)
    table = result.to_table()
    del table.meta["RSTEP"]
    with pytest.raises(FdntTypeError, match="RSTEP"):
        fx.shear_from_responses(table)
    table.remove_column("R12")
    with pytest.raises(FdntTypeError, match="no column R12"):
        fx.shear_from_responses(table)


def test_cuts_and_weights_that_do_not_fit():
    result = fx.measure_responses(ring(SHEAR), fx.Psf.from_image(star()))
    with pytest.raises(FdntValueError, match="0 of 8 galaxies are measured and pass the cut"):
        fx.shear_from_responses(result, cut={"size": (100.0, None)})
    with pytest.raises(ShapeMismatchError, match="galaxy_weight must have the shape"):
        fx.shear_from_responses(result, galaxy_weight=np.ones(3))
    with pytest.raises(FdntValueError, match="galaxy_weight must be finite"):
        fx.shear_from_responses(result, galaxy_weight=-np.ones(8))
    with pytest.raises(NamespaceError):
        fx.shear_from_responses(result, galaxy_weight=np.ones(8, dtype=np.float32))
