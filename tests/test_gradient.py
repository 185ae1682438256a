"""The ellipticity gradient, against shapes that are solved again at another shrink factor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from array_api_extra.testing import assert_close
from scipy.optimize import root

import fdnt_xp as fx
from fdnt_xp.fourier.transform import deconvolve
from fdnt_xp.nulltests.tests import NullTests
from fdnt_xp.shapes.job import check_stamps, prepare
from images import galaxies, star
from tolerances import tolerance

galsim = pytest.importorskip("galsim")

N = 128
PARAMS = galsim.GSParams(folding_threshold=1e-3, stepk_minimum_hlr=15, kvalue_accuracy=1e-7)


def sersic(flux, n, radius, e1, e2=0.0, shift=(0.0, 0.0)):
    profile = galsim.Sersic(n, half_light_radius=radius, flux=flux, gsparams=PARAMS)
    return profile.shear(e1=e1, e2=e2).shift(*shift)


# The three galaxies of SPEC.md 5.
GALAXIES = {
    1: sersic(0.2, 1.5, 1.5, 0.05) + sersic(0.8, 1.0, 11.8, 0.2),
    2: sersic(0.4, 4.0, 3.0, -0.3) + sersic(0.6, 1.0, 10.0, 0.4),
    3: sersic(0.3, 4.0, 2.5, 0.1, 0.4, (4.0, 3.0)) + sersic(0.7, 1.0, 9.0, 0.5),
}


def drawn(profile):
    return profile.drawImage(nx=N, ny=N, scale=1.0, method="no_pixel", dtype=float).array


def observed(number, radius, degrees=0.0):
    """Return the stamp of a galaxy, turned, and its PSF."""
    psf = galsim.Gaussian(half_light_radius=radius, gsparams=PARAMS)
    psf = psf.shear(e=0.14, beta=28.6 * galsim.degrees)
    galaxy = GALAXIES[number].rotate(degrees * galsim.degrees)
    both = galsim.Convolve([galaxy, psf], gsparams=PARAMS)
    return drawn(both)[None], drawn(psf)


def eta_at(shrink, stamps, psf, shapes, monkeypatch):
    """Solve the tests at a given s, by SciPy and its own numerical derivatives."""
    view_of = NullTests._view

    def view_at(self, eta, centroid):
        view = view_of(self, eta, centroid)
        s = np.full_like(view.shrink, shrink)
        factor, slope = self.weight.psf_factor(view.square, s)
        return replace(view, shrink=s, psf_factor=factor, psf_slope=slope)

    xp, stamps = check_stamps(stamps, psf)
    job = prepare(xp, stamps, psf, padding=1, max_iter=50)
    data = deconvolve(stamps, psf.inverse_transfer(job.coarse), job.coarse)
    tests = NullTests(grid=job.coarse, galaxies=data, weight=job.weight, length=1.0)

    def scaled(x):
        values = tests.at(x[None, :2], x[None, 2:])[0].values[0]
        return values[:4] / values[4]

    start = np.concatenate([shapes.eta[0], shapes.centroid[0] - 0.5 * (N - 1)])
    with monkeypatch.context() as patch:
        patch.setattr(NullTests, "_view", view_at)
        solution = root(scaled, start, method="hybr", tol=1e-13)
    assert np.max(np.abs(solution.fun)) < 1e-12
    return solution.x[:2]


@pytest.mark.parametrize("radius", [2.0, 4.0])
@pytest.mark.parametrize("number", GALAXIES)
def test_against_solving_again(number, radius, monkeypatch):
    stamps, image = observed(number, radius, degrees=20.0)
    psf = fx.Psf.from_image(image)
    shapes = fx.measure_shapes(stamps, psf)
    norm = np.linalg.norm(shapes.eta[0])
    ln_s, step = 0.5 * norm, 1e-3

    def eta(offset):
        return eta_at(np.exp(ln_s + offset), stamps, psf, shapes, monkeypatch)

    np.testing.assert_allclose(eta(0.0), shapes.eta[0], atol=1e-9)
    slope = (8 * (eta(step) - eta(-step)) - (eta(2 * step) - eta(-2 * step))) / (12 * step)
    expected = 0.5 * slope @ shapes.eta[0] / norm
    assert shapes.eg[0] == pytest.approx(expected, abs=1e-7)


@pytest.mark.parametrize(("radius", "eg"), [(2.0, 0.047), (4.0, 0.0255), (6.0, 0.0102)])
def test_sign_and_size(radius, eg):
    # SPEC.md 5, galaxy 1: rounder in the core, so more elongated as the weight looks outward.
    stamps, image = observed(1, radius)
    shapes = fx.measure_shapes(stamps, fx.Psf.from_image(image))
    assert shapes.eg[0] == pytest.approx(eg, rel=0.015)


def test_ellipses_have_no_gradient():
    # What is left is the sum over the cells of the k grid: 2e-7 here, 2e-6 at 48 pixels.
    e = np.array([[0.1, 0.0], [0.3, -0.2], [0.0, 0.6], [-0.5, 0.1]])
    shape = (96, 96)
    shapes = fx.measure_shapes(galaxies(e, shape), fx.Psf.from_image(star(shape)), padding=2)
    assert np.max(np.abs(shapes.eg)) < 1e-6
    psf = galsim.Gaussian(half_light_radius=3.0, gsparams=PARAMS).shear(e1=0.1, e2=-0.06)
    both = galsim.Convolve([sersic(1.0, 1.0, 4.0, 0.3, 0.2), psf], gsparams=PARAMS)
    shapes = fx.measure_shapes(drawn(both)[None], fx.Psf.from_image(drawn(psf)))
    assert abs(shapes.eg[0]) < 1e-6


@pytest.mark.parametrize("degrees", [45.0, 90.0, 20.0])
def test_it_does_not_turn_with_the_galaxy(degrees):
    first, turned = observed(3, 3.0), observed(3, 3.0, degrees)
    eg = [fx.measure_shapes(s, fx.Psf.from_image(p)).eg[0] for s, p in (first, turned)]
    # The PSF does not turn along, but the weight is round whatever the PSF.
    assert eg[1] == pytest.approx(eg[0], rel=2e-5)


def test_on_every_library(xp, dtype, to_xp):
    stamps = np.concatenate([observed(number, 3.0)[0] for number in GALAXIES])
    image = observed(1, 3.0)[1]
    expected = fx.measure_shapes(stamps, fx.Psf.from_image(image)).eg
    assert np.min(np.abs(expected)) > 1e-3
    actual = fx.measure_shapes(to_xp(stamps, dtype), fx.Psf.from_image(to_xp(image, dtype))).eg
    assert_close(actual, to_xp(expected, dtype), **tolerance("backends", dtype), xp=xp)
