"""Galaxies that share PSFs: the same answers as with one PSF each, in any order, on any library."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from array_api_extra.testing import assert_close, assert_equal

import fdnt_xp as fx
from fdnt_xp.data.noise_control import KnownNoise, second_order
from fdnt_xp.errors import FdntTypeError, FdntValueError, NamespaceError, ShapeMismatchError
from fdnt_xp.flags import flag_names
from fdnt_xp.shapes import job as job_module
from images import gaussian_covariance, gaussian_image
from tolerances import tolerance

N_GAL, SIDE = 12, 40
INDEX = np.array([2, 0, 1, 0, 2, 2, 1, 0, 2, 1, 0, 2])
NOISE = 1e-8  # variance of a pixel: an S/N of 500


def psf_covariances():
    return [
        gaussian_covariance(e, s) for e, s in (((0.1, 0), 1.7), ((0, 0.1), 1.8), ((-0.1, 0), 2))
    ]


@pytest.fixture
def stars(dtype, to_xp):
    return to_xp(np.stack([gaussian_image(c, (SIDE, SIDE)) for c in psf_covariances()]), dtype)


@pytest.fixture
def stamps(dtype, to_xp):
    """Galaxies in a ring, each behind its own PSF, with a little noise."""
    angle = 2.0 * np.pi * np.arange(N_GAL) / N_GAL
    rng = np.random.default_rng(3)
    images = [
        gaussian_image(
            gaussian_covariance((0.2 * np.cos(a), 0.2 * np.sin(a)), 2.2) + psf_covariances()[i],
            (SIDE, SIDE),
            centre=(0.3 * np.cos(2 * a), 0.1),
        )
        for a, i in zip(angle, INDEX, strict=True)
    ]
    return to_xp(
        np.stack(images) + np.sqrt(NOISE) * rng.standard_normal((N_GAL, SIDE, SIDE)), dtype
    )


@pytest.fixture(params=[1, 1000], ids=["together", "one by one"])
def psfs(request, monkeypatch, stars, to_xp):
    """The PSFs by index, and one for each galaxy; those that share one in work together or not."""
    for fewest in ("_FEWEST_ON_A_PSF", "_FEWEST_TO_MEASURE"):
        monkeypatch.setattr(job_module, fewest, request.param)
    shared = fx.Psf.from_image(stars, psf_index=to_xp(INDEX))
    assert (shared.n_psf, shared.n_gal) == (3, N_GAL)
    return shared, fx.Psf.from_image(stars).with_index(to_xp(INDEX)).take(to_xp(np.arange(N_GAL)))


@pytest.mark.parametrize("chunk_size", [None, 3])
def test_shapes(chunk_size, psfs, stamps, dtype, xp):
    shared, each = (
        fx.measure_shapes(stamps, psf, noise_variance=NOISE, chunk_size=chunk_size) for psf in psfs
    )
    assert bool(xp.all(each.measured))
    for name in ("eta", "centroid", "eta_cov", "flux", "size"):
        ours, theirs = getattr(shared, name), getattr(each, name)
        assert_close(ours, theirs, **tolerance("shapes", dtype), xp=xp)


@pytest.mark.parametrize("statistic", ["frozen", "eta"])
def test_the_null(statistic, psfs, stamps, dtype, xp):
    shared, each = (
        fx.population_null(
            stamps, psf, noise_variance=NOISE, statistic=statistic, chunk_size=3, max_shear=0.1
        )
        for psf in psfs
    )
    assert_close(shared.g, each.g, **tolerance("nulls", dtype), xp=xp)
    assert_close(shared.g_err, each.g_err, rtol=1e-3, xp=xp)
    assert shared.n_used == each.n_used == N_GAL


def test_responses_are_in_the_order_of_the_galaxies(psfs, stamps, dtype, xp):
    shared, each = (fx.measure_responses(stamps, psf, noise_variance=NOISE) for psf in psfs)
    for name in ("v", "response", "centroid"):
        ours, theirs = getattr(shared, name), getattr(each, name)
        assert_close(ours, theirs, **tolerance("shapes", dtype), xp=xp)
    assert_close(shared.snr, each.snr, rtol=1e-5, xp=xp)


def test_the_stack_and_its_groups(psfs, stamps, dtype, xp):
    shared, each = (fx.shear_from_stack(stamps, psf, n_groups=4, chunk_size=5) for psf in psfs)
    assert_close(shared.g, each.g, **tolerance("shapes", dtype), xp=xp)
    assert_close(shared.g_err, each.g_err, rtol=1e-2, xp=xp)


def test_masks_follow_their_galaxies(psfs, stamps, dtype, to_xp, to_np):
    mask = np.zeros((N_GAL, SIDE, SIDE), dtype=bool)
    mask[4, 20, 20] = True
    for psf in psfs:
        found = fx.measure_responses(stamps, psf, noise_variance=NOISE, mask=to_xp(mask))
        lost = np.flatnonzero(np.isnan(to_np(found.v)[:, 0]))
        assert lost.tolist() == [4]


def test_a_bad_star_costs_its_own_galaxies(stars, stamps, dtype, to_xp, to_np, monkeypatch):
    for fewest in ("_FEWEST_ON_A_PSF", "_FEWEST_TO_MEASURE"):
        monkeypatch.setattr(job_module, fewest, 1)
    images = to_np(stars).copy()
    images[1] = 0.0
    psf = fx.Psf.from_image(to_xp(images, dtype), psf_index=to_xp(INDEX))
    shapes = fx.measure_shapes(stamps, psf)
    np.testing.assert_array_equal(to_np(shapes.measured), INDEX != 1)
    assert flag_names(int(to_np(shapes.flags)[2])) == ["BAD_PSF"]


def test_a_star_that_no_galaxy_has(stars, stamps, to_xp, to_np, monkeypatch):
    for fewest in ("_FEWEST_ON_A_PSF", "_FEWEST_TO_MEASURE"):
        monkeypatch.setattr(job_module, fewest, 1)
    index = np.where(INDEX == 1, 0, INDEX)
    shapes = fx.measure_shapes(stamps, fx.Psf.from_image(stars, psf_index=to_xp(index)))
    assert to_np(shapes.measured).all()


def test_the_control_of_noise_bias(monkeypatch):
    for fewest in ("_FEWEST_ON_A_PSF", "_FEWEST_TO_MEASURE"):
        monkeypatch.setattr(job_module, fewest, 1)
    images = np.stack([gaussian_image(c, (SIDE, SIDE)) for c in psf_covariances()])
    clean = np.stack([gaussian_image(3.0 * c, (SIDE, SIDE)) for c in psf_covariances()])[INDEX]
    psf = fx.Psf.from_image(images, psf_index=INDEX)
    known = KnownNoise(
        clean=clean,
        noise=1e-4 * np.random.default_rng(0).standard_normal(clean.shape),
        psf=psf,
        variance=1e-8,
        identifiers=np.arange(N_GAL),
        symmetry=np.zeros(N_GAL, dtype=np.int64),
        seed=1,
    )
    each = dataclasses.replace(known, psf=psf.take(np.arange(N_GAL)))
    ours, theirs = (second_order(one, (0.04, 0.0)) for one in (known, each))
    np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-12)
    assert np.abs(ours).max() > 1e-6


# --- bad calls: one clear error ------------------------------------------------------


def test_an_index_beyond_the_stars(stars, to_xp):
    with pytest.raises(FdntValueError, match=r"psf_index must be from 0 to 2.* from 0 to 3"):
        fx.Psf.from_image(stars, psf_index=to_xp([0, 3]))
    with pytest.raises(FdntValueError, match=r"it goes from -1 to 2"):
        fx.Psf.from_image(stars, psf_index=to_xp([-1, 2]))


def test_an_index_of_no_whole_numbers(stars, dtype, to_xp):
    with pytest.raises(FdntTypeError, match="psf_index must hold whole numbers"):
        fx.Psf.from_image(stars, psf_index=to_xp([0.0, 1.0], dtype))


def test_an_index_of_another_rank(stars, to_xp):
    with pytest.raises(ShapeMismatchError, match=r"psf_index must have the shape \(n_gal,\)"):
        fx.Psf.from_image(stars, psf_index=to_xp([[0, 1]]))


def test_an_index_of_another_library():
    import array_api_strict

    with pytest.raises(NamespaceError, match="psf_index"):
        fx.Psf.from_image(np.ones((2, 8, 8)), psf_index=array_api_strict.asarray([0, 1]))


def test_an_index_for_other_galaxies(stars, stamps, to_xp):
    psf = fx.Psf.from_image(stars, psf_index=to_xp(INDEX[:5]))
    with pytest.raises(ShapeMismatchError, match="psf is for 5 galaxies, but there are 12 stamps"):
        fx.measure_shapes(stamps, psf)


def test_an_index_into_a_single_star(stars, stamps, xp, to_xp):
    psf = fx.Psf.from_image(stars[0, :, :], psf_index=to_xp(np.zeros(N_GAL, dtype=np.int64)))
    alone = fx.Psf.from_image(stars[0, :, :])
    ours, theirs = (fx.measure_shapes(stamps, one).eta for one in (psf, alone))
    assert_equal(ours, theirs, xp=xp)
