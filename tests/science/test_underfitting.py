"""Underfitting, B10 §3 and its Figure 2: models that do not fit, and tests that need none."""

from __future__ import annotations

from functools import partial
from itertools import pairwise

import galsim
import numpy as np
import pytest

import fdnt_xp as fx
import fdnt_xp.peers  # gives its methods their names
from fdnt_xp.data.profiles import gaussian_psf, sersic
from fdnt_xp.data.ring import draw
from fdnt_xp.shapes.methods import shape_method

E = (0.1, 0.3, 0.5)
RADIUS, SIDE = 3.0, 64
METHODS = {
    "gl-12": partial(fx.measure_shapes, transform="gl", order=12),
    "gl-16": partial(fx.measure_shapes, transform="gl", order=16),
}


@pytest.fixture(scope="module")
def measured():
    """Return a function to |de|/e and the error of e by method, index and relative PSF size."""
    done = {}

    def measure(name, index, ratio):
        if (name, index, ratio) not in done:
            psf = gaussian_psf(ratio * RADIUS, (0.1, 0.098))
            galaxies = [sersic(index, RADIUS, (e, 0.0)).shift(0.31, -0.23) for e in E]
            seen = [galsim.Convolve([g, psf], gsparams=psf.gsparams) for g in galaxies]
            stamps = np.stack([draw(image, SIDE, pixel=False) for image in seen])
            star = fx.Psf.from_image(draw(psf, SIDE, pixel=False))
            method = METHODS.get(name) or shape_method(name)
            shapes = method(stamps, star, noise_variance=1e-10)
            bias = np.hypot(shapes.e[:, 0] - E, shapes.e[:, 1]) / E
            error = np.sqrt(shapes.eta_cov[:, 0, 0]) * (1.0 - shapes.e[:, 0] ** 2)
            done[name, index, ratio] = bias, error
        return done[name, index, ratio]

    return measure


# --- the ordering of the paper ---------------------------------------------------------


@pytest.mark.parametrize("index", [1.0, 2.0, 4.0])
@pytest.mark.parametrize("ratio", [0.5, 1.0])
def test_nb07_is_more_biased_than_fdnt(index, ratio, measured):
    nb07, gl, ft = (measured(m, index, ratio)[0] for m in ("nb07-8", "gl-12", "fdnt-ft"))
    assert np.all(nb07 > 2.0 * gl)
    assert np.mean(nb07) > 20.0 * np.mean(gl)
    assert np.max(gl) > np.max(ft)
    assert np.max(ft) < 1e-6


@pytest.mark.parametrize(("ratio", "least", "most"), [(0.5, 1e-2, 4e-2), (1.0, 1e-2, 6e-2)])
def test_nb07_errs_by_several_per_cent_of_de_vaucouleurs(ratio, least, most, measured):
    bias = measured("nb07-8", 4.0, ratio)[0]
    assert np.all((bias > least) & (bias < most))


def test_nb07_is_good_where_the_galaxy_is_resolved_and_smooth(measured):
    for index in (0.5, 1.0):
        assert np.max(measured("nb07-8", index, 0.5)[0]) < 1e-3
        assert np.max(measured("nb07-12", index, 0.5)[0]) < 1e-4


@pytest.mark.parametrize("index", [0.5, 1.0, 2.0, 4.0])
def test_orders_cost_nb07_noise_where_the_psf_is_large(index, measured):
    low, high = (measured(m, index, 2.0)[1] for m in ("nb07-8", "nb07-12"))
    assert np.all(high > 1.15 * low)
    low, high = (measured(m, index, 0.5)[1] for m in ("nb07-8", "nb07-12"))
    np.testing.assert_allclose(high, low, rtol=0.05)
    # FDNT-GL: at any resolution.
    for ratio in (0.5, 1.0):
        low, high = (measured(m, index, ratio)[1] for m in ("gl-12", "gl-16"))
        np.testing.assert_allclose(high, low, rtol=0.10)


@pytest.mark.parametrize("ratio", [0.5, 1.0])
def test_fdnt_is_less_noisy_than_nb07(ratio, measured):
    for index in (0.5, 1.0, 2.0, 4.0):
        nb07, gl, ft = (measured(m, index, ratio)[1] for m in ("nb07-8", "gl-12", "fdnt-ft"))
        assert np.all(gl < nb07)
        np.testing.assert_allclose(gl, ft, rtol=0.05)


# --- circular models -------------------------------------------------------------------


@pytest.mark.parametrize("ratio", [0.5, 1.0, 2.0])
def test_de_vaucouleurs_by_gaussians(ratio, measured):
    biases = [measured(f"gauss-{n}", 4.0, ratio)[0] for n in (1, 2, 3, 4)]
    assert np.all(biases[0] > 0.1)
    for fewer, more in pairwise(biases):
        assert np.all(more < fewer)
    assert np.all(biases[3] < 0.01)


@pytest.mark.parametrize(("method", "index"), [("exponential", 1.0), ("devaucouleurs", 4.0)])
def test_the_right_law_is_unbiased_and_the_wrong_one_is_not(method, index, measured):
    for ratio in (0.5, 1.0, 2.0):
        assert np.max(measured(method, index, ratio)[0]) < 5e-5
        assert np.min(measured(method, 5.0 - index, ratio)[0]) > 0.05


# --- the figure ------------------------------------------------------------------------


def test_the_figure_is_drawn_from_its_rows():
    pytest.importorskip("matplotlib")
    from fdnt_xp.app.underfitting_figure import (
        DISTORTIONS,
        PANELS,
        PSF_SIZES,
        SERSIC,
        method_of,
        plot_underfitting,
    )

    names = [name for panel in PANELS.values() for name in panel]
    rows = [
        {"method": m, "psf_size": p, "sersic": n, "e": e, "bias": 1e-3 * e, "noise": 1.0 + e}
        for m in names
        for p in PSF_SIZES
        for n in SERSIC
        for e in DISTORTIONS
    ]
    rows[0] |= {"bias": float("nan"), "noise": float("nan")}
    figure = plot_underfitting(rows)
    assert len(figure.axes) == 2 * len(PSF_SIZES) * len(PANELS)
    assert [callable(method_of(name)) for name in names] == [True] * len(names)
