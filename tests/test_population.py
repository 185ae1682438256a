"""The population null: exact on isotropic samples, covariant, and clear about what it cannot do."""

from __future__ import annotations

import math

import numpy as np
import pytest
from array_api_extra.testing import assert_close

import fdnt_xp as fx
from fdnt_xp.errors import (
    FdntTypeError,
    FdntValueError,
    FdntWarning,
    NamespaceError,
    RangeError,
    ShapeMismatchError,
)
from fdnt_xp.shears.null_search import find_null
from fdnt_xp.shears.weights import ShapeWeight
from images import SHEAR, ring, star
from tolerances import tolerance

STATISTICS = ["frozen", "eta"]


@pytest.fixture
def psf(to_xp, dtype):
    return fx.Psf.from_image(to_xp(star(), dtype))


# --- the answer ----------------------------------------------------------------------


@pytest.mark.parametrize("statistic", STATISTICS)
def test_a_ring_gives_its_shear(statistic, psf, xp, dtype, to_xp):
    estimate = fx.population_null(to_xp(ring(SHEAR), dtype), psf, statistic=statistic)
    assert_close(estimate.g, to_xp(SHEAR, dtype), **tolerance("nulls", dtype), xp=xp)
    assert estimate.n_used == 8
    assert estimate.n_excluded == 0
    assert statistic in estimate.method


@pytest.mark.parametrize("statistic", STATISTICS)
@pytest.mark.parametrize("angle", [0.0, 45.0, 90.0, 111.0])
@pytest.mark.parametrize("length", [0.0, 0.02, 0.09])
def test_any_shear_at_any_angle(statistic, angle, length):
    g = length * np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle))])
    estimate = fx.population_null(ring(g), fx.Psf.from_image(star()), statistic=statistic)
    np.testing.assert_allclose(estimate.g, g, atol=1e-7)


@pytest.mark.parametrize("statistic", STATISTICS)
def test_turning_the_images_turns_the_answer(statistic):
    # A quarter turn of the pixels is exact; without a ring's symmetry the answer is no shear
    # in particular, but it must turn.
    images = ring((0.05, 0.02), n=5, eta=0.4)
    images = np.concatenate([images[:2], images[3:]])
    straight = fx.population_null(images, fx.Psf.from_image(star()), statistic=statistic)
    turned = fx.population_null(
        np.rot90(images, axes=(1, 2)), fx.Psf.from_image(np.rot90(star())), statistic=statistic
    )
    np.testing.assert_allclose(turned.g, -straight.g, atol=1e-9)
    # The response is a forward difference, which does not turn exactly.
    np.testing.assert_allclose(turned.g_err, straight.g_err, rtol=2e-3)


def test_a_weight_bounds_the_influence_and_keeps_the_answer():
    images, psf = ring(SHEAR), fx.Psf.from_image(star())
    for weight in (ShapeWeight.gaussian(0.5), ShapeWeight.uniform()):
        estimate = fx.population_null(images, psf, statistic="eta", weight=weight)
        np.testing.assert_allclose(estimate.g, SHEAR, atol=1e-7)


def test_a_bound_on_elongated_galaxies_keeps_the_answer():
    estimate = fx.population_null(ring(SHEAR), fx.Psf.from_image(star()), bound=3.0)
    np.testing.assert_allclose(estimate.g, SHEAR, atol=1e-7)


@pytest.mark.parametrize("statistic", STATISTICS)
def test_a_given_size_and_a_smaller_reach(statistic):
    images, psf = ring(SHEAR), fx.Psf.from_image(star())
    estimate = fx.population_null(images, psf, statistic=statistic, size=2.0, max_shear=0.05)
    np.testing.assert_allclose(estimate.g, SHEAR, atol=1e-7)


def test_a_psf_for_each_galaxy(xp, to_xp):
    images = to_xp(ring(SHEAR))
    stars = to_xp(np.stack([star()] * 8))
    estimate = fx.population_null(images, fx.Psf.from_image(stars), chunk_size=3)
    assert_close(estimate.g, to_xp(SHEAR), rtol=0, atol=1e-7, xp=xp)


# --- batches and bad galaxies --------------------------------------------------------


@pytest.mark.parametrize("statistic", STATISTICS)
@pytest.mark.parametrize("chunk_size", [1, 3, 100])
def test_chunks_change_nothing(statistic, chunk_size):
    images, psf = ring(SHEAR), fx.Psf.from_image(star())
    together = fx.population_null(images, psf, statistic=statistic)
    apart = fx.population_null(images, psf, statistic=statistic, chunk_size=chunk_size)
    np.testing.assert_allclose(apart.g, together.g, atol=1e-10)
    np.testing.assert_allclose(apart.g_err, together.g_err, rtol=1e-6)


@pytest.mark.parametrize("statistic", STATISTICS)
def test_bad_galaxies_count_as_nothing(statistic, psf, xp, dtype, to_xp):
    good = ring(SHEAR)
    bad = np.stack([np.full((48, 48), np.nan), np.zeros((48, 48)), -good[0]])
    estimate = fx.population_null(
        to_xp(np.concatenate([good, bad]), dtype), psf, statistic=statistic
    )
    assert_close(estimate.g, to_xp(SHEAR, dtype), **tolerance("nulls", dtype), xp=xp)
    assert (estimate.n_used, estimate.n_excluded) == (8, 3)


# --- errors --------------------------------------------------------------------------


@pytest.mark.parametrize("statistic", STATISTICS)
def test_errors_are_the_scatter(statistic):
    rng = np.random.default_rng(3)
    psf = fx.Psf.from_image(star())
    etas, starts = rng.uniform(0.0, 0.4, 400), rng.uniform(0.0, np.pi, 400)
    pool = np.concatenate(
        [ring(SHEAR, n=1, eta=e, start=a) for e, a in zip(etas, starts, strict=True)]
    )
    options = {"statistic": statistic, "max_shear": 0.2}
    estimates = [fx.population_null(part, psf, **options) for part in np.split(pool, 20)]
    scatter = np.std([one.g for one in estimates], axis=0, ddof=1)
    predicted = np.sqrt(np.mean([one.g_err**2 for one in estimates], axis=0))
    # Twenty draws of two components fix the ratio to 11 %.
    assert np.sqrt(np.mean((scatter / predicted) ** 2)) == pytest.approx(1.0, abs=0.35)
    whole = fx.population_null(pool, psf, **options)
    np.testing.assert_allclose(whole.g_err_jackknife, whole.g_err, rtol=0.35)
    assert np.all(np.abs(whole.g - SHEAR) < 4.0 * whole.g_err)


# --- bad calls -----------------------------------------------------------------------


def test_one_galaxy_is_no_population(psf, dtype, to_xp):
    with pytest.raises(FdntValueError, match="stamps holds 1 galaxies; a null needs two"):
        fx.population_null(to_xp(ring(SHEAR)[:1], dtype), psf)


@pytest.mark.parametrize("statistic", STATISTICS)
def test_a_sample_without_a_usable_galaxy(statistic, psf, dtype, to_xp):
    with pytest.raises(FdntValueError, match="only 0 of 3 galaxies can be used"):
        fx.population_null(to_xp(np.full((3, 48, 48), np.nan), dtype), psf, statistic=statistic)


@pytest.mark.parametrize("statistic", STATISTICS)
def test_a_shear_out_of_reach(statistic):
    images, psf = ring((0.12, 0.0)), fx.Psf.from_image(star())
    with pytest.raises(FdntValueError, match=r"no null within max_shear.*allowed is 0\.05"):
        fx.population_null(images, psf, statistic=statistic, max_shear=0.05)
    wider = fx.population_null(images, psf, statistic=statistic, max_shear=0.2)
    # Eight angles are isotropic to so large a shear only to this.
    np.testing.assert_allclose(wider.g, [0.12, 0.0], atol=5e-6)


@pytest.mark.parametrize("max_shear", [0.0, -0.1, 0.31, float("nan")])
def test_reaches_out_of_range(max_shear):
    with pytest.raises(RangeError, match="max_shear = "):
        fx.population_null(ring(SHEAR), fx.Psf.from_image(star()), max_shear=max_shear)


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"statistic": "mean"}, FdntValueError, 'statistic must be "frozen" or "eta"'),
        ({"weight": ShapeWeight.gaussian(0.5)}, FdntValueError, "weight goes with"),
        ({"size": -1.0}, RangeError, "size = -1"),
        ({"padding": 0}, RangeError, "padding = 0"),
        ({"chunk_size": 0}, RangeError, "chunk_size = 0"),
    ],
)
def test_other_bad_options(options, error, message):
    with pytest.raises(error, match=message):
        fx.population_null(ring(SHEAR), fx.Psf.from_image(star()), **options)


def test_bad_arrays_are_refused_as_by_measure_shapes():
    psf = fx.Psf.from_image(star())
    with pytest.raises(ShapeMismatchError, match="stamps must have the shape"):
        fx.population_null(star(), psf)
    with pytest.raises(FdntTypeError, match="psf must be a Psf"):
        fx.population_null(ring(SHEAR), star())


# --- noise ---------------------------------------------------------------------------


def noisy(snr, n=64, seed=0):
    """Return a lensed sample with noise, and the variance of a pixel."""
    rng = np.random.default_rng(seed)
    images = np.concatenate([ring(SHEAR, n=8, eta=0.5, start=s) for s in rng.uniform(0, 1, n // 8)])
    sigma = math.sqrt(np.mean(np.sum(images**2, axis=(1, 2)))) / snr
    return images + sigma * rng.standard_normal(images.shape), sigma**2


@pytest.mark.parametrize("statistic", STATISTICS)
def test_noisy_samples_on_every_library(statistic, psf, xp, dtype, to_xp, to_np):
    stamps, variance = noisy(100.0)
    options = {"statistic": statistic, "noise_variance": variance, "seed": 5}
    host = fx.population_null(stamps, fx.Psf.from_image(star()), **options)
    ours = fx.population_null(to_xp(stamps, dtype), psf, **options)
    assert_close(ours.g, to_xp(host.g, dtype), **tolerance("noisy nulls", dtype), xp=xp)
    assert np.all(np.abs(host.g - SHEAR) < 5.0 * host.g_err)


def test_names_carry_the_noise_into_any_order_and_chunk():
    stamps, variance = noisy(20.0)
    psf, names = fx.Psf.from_image(star()), np.arange(64) + 2**40
    order = np.random.default_rng(1).permutation(64)
    options = {"noise_variance": variance, "seed": 2}
    whole = fx.population_null(stamps, psf, identifiers=names, **options)
    again = fx.population_null(
        stamps[order], psf, identifiers=names[order], chunk_size=7, **options
    )
    # What the search leaves is a ten-thousandth of the error.
    np.testing.assert_allclose(again.g, whole.g, atol=1e-3 * float(np.min(whole.g_err)))
    other = fx.population_null(stamps, psf, identifiers=names, noise_variance=variance, seed=3)
    assert np.all(np.abs(other.g - whole.g) > 1e-3 * whole.g_err)


def test_a_variance_for_each_galaxy_and_a_white_spectrum_are_the_same():
    stamps, variance = noisy(20.0)
    psf = fx.Psf.from_image(star())
    number = fx.population_null(stamps, psf, noise_variance=variance)
    each = fx.population_null(stamps, psf, noise_variance=np.full(64, variance))
    np.testing.assert_array_equal(each.g, number.g)
    spectrum = np.full((48, 48), variance)
    psfs = fx.Psf.from_image(np.stack([star()] * 64))
    for power in (spectrum, np.stack([spectrum] * 64)):
        for stars in (psf, psfs):
            white = fx.population_null(stamps, stars, noise_power=power, chunk_size=30)
            np.testing.assert_allclose(white.g, number.g, atol=1e-9)


def test_a_large_sample_begins_with_a_part_of_it(monkeypatch):
    stamps, variance = noisy(20.0)
    psf = fx.Psf.from_image(star())
    whole = fx.population_null(stamps, psf, noise_variance=variance)
    monkeypatch.setattr("fdnt_xp.shears.population._PILOT", 16)
    begun = fx.population_null(stamps, psf, noise_variance=variance)
    np.testing.assert_allclose(begun.g, whole.g, atol=1e-3 * float(np.min(whole.g_err)))
    # The response is taken where the part's null is.
    np.testing.assert_allclose(begun.g_err, whole.g_err, rtol=0.05)


def test_the_error_that_the_noise_power_brings():
    stamps, variance = noisy(10.0, n=400)
    psf = fx.Psf.from_image(star())
    estimate = fx.population_null(stamps, psf, noise_variance=variance, noise_error=0.2)
    told = [
        fx.population_null(stamps, psf, noise_variance=variance * factor).g for factor in (0.8, 1.2)
    ]
    moved = np.abs(told[1] - told[0]) / 2
    # One component is next to nothing: what the search leaves of it is seen there.
    left = 0.1 * np.max(moved)
    np.testing.assert_allclose(estimate.g_err_noise_power, moved, rtol=0.3, atol=left)
    none = fx.population_null(stamps, psf, noise_variance=variance)
    assert none.g_err_noise_power is None
    assert set(estimate.to_dict()) - set(none.to_dict()) == {
        "g1_err_noise_power",
        "g2_err_noise_power",
    }


@pytest.mark.parametrize(("isotropise", "bound"), [(True, 0.0), (False, 0.0), (True, 3.0)])
def test_the_error_by_noise_is_the_scatter_of_repeated_observations(isotropise, bound):
    # Round galaxies too faint for anything but noise to matter would hide a lost term in v.
    clean, psf, rng = (
        ring((0.0, 0.0), n=8, eta=0.8),
        fx.Psf.from_image(star()),
        np.random.default_rng(4),
    )
    clean = np.concatenate([clean] * 4)
    sigma = math.sqrt(np.mean(np.sum(clean**2, axis=(1, 2)))) / 30.0
    found = [
        fx.population_null(
            clean + sigma * rng.standard_normal(clean.shape),
            psf,
            noise_variance=sigma**2,
            isotropise=isotropise,
            bound=bound,
            seed=seed,
        )
        for seed in range(300)
    ]
    scatter = np.std([one.g for one in found], axis=0)
    stated = np.sqrt(np.mean([one.g_err_noise**2 for one in found], axis=0))
    # 300 draws tell a standard deviation to 4 %.
    np.testing.assert_allclose(stated, scatter, rtol=0.12)
    assert np.all(stated < 0.5 * np.mean([one.g_err for one in found], axis=0))


def test_without_noise_or_with_solved_shapes_there_is_no_error_by_noise():
    images, psf = ring(SHEAR), fx.Psf.from_image(star())
    assert fx.population_null(images, psf).g_err_noise is None
    stamps, variance = noisy(100.0)
    eta = fx.population_null(stamps, psf, statistic="eta", noise_variance=variance)
    assert eta.g_err_noise is None


def test_a_cut_leaves_some_out():
    stamps, variance = noisy(20.0)
    psf = fx.Psf.from_image(star())
    result = fx.measure_responses(stamps, psf, noise_variance=variance)
    middle = float(np.median(result.snr[:, 0]))
    cut = fx.population_null(stamps, psf, noise_variance=variance, cut={"snr": (middle, None)})
    assert cut.n_used + cut.n_excluded == 64
    assert 20 < cut.n_used < 44
    with pytest.raises(FdntValueError, match="the cut keeps 0 of 64 galaxies"):
        fx.population_null(stamps, psf, noise_variance=variance, cut={"snr": (1e6, None)})


def test_eta_at_low_snr_is_warned_of():
    stamps, variance = noisy(30.0)
    psf = fx.Psf.from_image(star())
    with pytest.warns(FdntWarning, match="below an S/N of 50"):
        fx.population_null(stamps, psf, noise_variance=variance, statistic="eta", max_shear=0.3)


def test_a_shear_beyond_the_margin_widens_it():
    images, psf = ring((0.12, 0.0)), fx.Psf.from_image(star())
    found = fx.population_null(images, psf)
    given = fx.population_null(images, psf, max_shear=0.3)
    np.testing.assert_array_equal(found.g, given.g)


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"isotropise": True}, FdntValueError, "isotropise needs noise_variance or noise_power"),
        ({"noise_variance": 0, "isotropise": True}, FdntValueError, "there is no noise to make"),
        ({"noise_variance": -1.0}, RangeError, "noise_variance = -1"),
        ({"noise_variance": math.nan}, RangeError, "noise_variance = nan"),
        ({"noise_variance": np.ones(3)}, ShapeMismatchError, r"have the shape \(8,\)"),
        ({"noise_variance": -np.ones(8)}, FdntValueError, "finite and not negative"),
        ({"noise_variance": np.full(8, np.nan)}, FdntValueError, "finite and not negative"),
        ({"noise_variance": np.ones(8, np.float32)}, NamespaceError, "dtype"),
        ({"noise_power": np.ones((4, 4))}, ShapeMismatchError, r"noise_power must have the shape"),
        ({"noise_power": -np.ones((48, 48))}, FdntValueError, "not negative"),
        ({"noise_power": np.arange(48.0**2).reshape(48, 48)}, FdntValueError, "k and -k"),
        ({"noise_power": np.ones((48, 48)), "noise_variance": 1.0}, FdntValueError, "not both"),
        ({"noise_variance": 1.0, "identifiers": np.ones(8)}, FdntTypeError, "whole numbers"),
        ({"noise_variance": 1.0, "identifiers": np.arange(3)}, ShapeMismatchError, "identifiers"),
        ({"noise_error": -0.1}, RangeError, "noise_error = -0.1"),
        ({"softening": -1.0}, RangeError, "softening = -1"),
        ({"bound": math.nan}, RangeError, "bound = nan"),
        ({"bound": 3.0, "statistic": "eta"}, FdntValueError, "bound goes with"),
        ({"cut": {"snr": (5.0, None)}}, FdntValueError, "a cut on snr needs"),
        ({"cut": 3}, FdntTypeError, "cut must be"),
    ],
)
def test_noise_that_makes_no_sense(options, error, message):
    with pytest.raises(error, match=message):
        fx.population_null(ring(SHEAR), fx.Psf.from_image(star()), **options)


# --- the search ----------------------------------------------------------------------


def test_the_search_finds_a_bent_null():
    def mean(gamma):
        x, y = gamma[0] - 0.08, gamma[1] + 0.05
        return -x + 0.3 * x * y, -1.2 * y + 0.4 * x * x

    calls = []

    def counted(gamma):
        calls.append(gamma)
        return mean(gamma)

    jac = [(-1.05, 0.0), (0.0, -1.1)]
    found = find_null(counted, mean((0.0, 0.0)), jac, largest=1.0, tolerance=1e-12)
    np.testing.assert_allclose(found, (0.08, -0.05), atol=1e-11)
    assert len(calls) <= 8


def test_a_dead_response_is_said():
    with pytest.raises(FdntValueError, match="does not respond"):
        find_null(
            lambda _: (1.0, 1.0), (1.0, 1.0), [(0.0, 0.0), (0.0, 0.0)], largest=1, tolerance=0
        )


def test_a_search_without_end_is_said():
    with pytest.raises(FdntValueError, match="no null found in"):
        find_null(
            lambda g: (1e-3 * math.cos(1e6 * g[0]), 1e-3 * math.sin(1e6 * g[0])),
            (1e-3, 0.0),
            [(-1.0, 0.0), (0.0, -1.0)],
            largest=10.0,
            tolerance=1e-15,
        )
