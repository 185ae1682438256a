"""The simulated population is the one of GREAT08, and the truth table tells the truth."""

from __future__ import annotations

import builtins

import numpy as np
import pytest

from fdnt_xp.data import simulate
from fdnt_xp.data.simulate import great08_image, great08_psf, half_light_radius, sample_g
from fdnt_xp.errors import FdntValueError, MissingExtraError, RangeError

galsim = pytest.importorskip("galsim")


@pytest.fixture(scope="module")
def field():
    """Sixty-four galaxies without noise."""
    return great08_image(n_x=8, n_y=8, cell=48, snr=None, shear=(0.03, -0.02), seed=5)


def _cells(image, cell):
    n_y, n_x = image.shape[0] // cell, image.shape[1] // cell
    return image.reshape(n_y, cell, n_x, cell).swapaxes(1, 2).reshape(-1, cell, cell)


@pytest.mark.parametrize(("sersic_n", "radius"), [(1.0, 1.268), (4.0, 3.016)])
def test_sizes_are_those_of_the_handbook(sersic_n, radius):
    assert half_light_radius(sersic_n) == pytest.approx(radius, abs=1e-3)


@pytest.mark.parametrize(
    ("ratio", "sersic_n", "radius"), [(1.22, 1, 0.802), (1.22, 4, 1.057), (1.6, 1, 1.796)]
)
def test_sizes_at_other_ratios(ratio, sersic_n, radius):
    assert half_light_radius(float(sersic_n), ratio) == pytest.approx(radius, abs=2e-3)


def test_sizes_give_the_ratio_of_widths():
    """As GalSim measures it on a drawn image."""
    psf = galsim.Moffat(beta=3, fwhm=2.85, trunc=5.7)
    galaxy = galsim.Exponential(half_light_radius=half_light_radius(1.0))
    image = galsim.Convolve([galaxy, psf]).drawImage(scale=0.1, method="no_pixel")
    assert image.calculateFWHM() == pytest.approx(1.4 * 2.85, rel=5e-3)


def test_psf():
    psf = great08_psf()
    moments = galsim.hsm.FindAdaptiveMom(psf.drawImage(nx=160, ny=160, scale=0.2))
    # The truncation is sheared along, but the pixel and the weight are round: roughly.
    shape = moments.observed_shape
    assert (shape.g1, shape.g2) == pytest.approx((-0.019, -0.007), abs=1e-3)


def test_distribution_of_shapes():
    """Against the moments of the formula, integrated on another grid."""
    g = np.linspace(0, 1, 20001)
    weight = g * np.cos(np.pi * g / 2) ** 2 * np.exp(-((2 * g / 0.19) ** 0.58))
    weight[g > simulate.MAX_G] = 0
    drawn = sample_g(np.random.default_rng(3), 200_000)
    assert drawn.max() <= simulate.MAX_G
    for power in (1, 2, 4):
        expected = np.average(g**power, weights=weight)
        error = np.std(drawn**power) / np.sqrt(len(drawn))
        assert abs(np.mean(drawn**power) - expected) < 4 * error


def test_little_of_the_distribution_is_cut():
    g = np.linspace(0, 1, 20001)
    weight = simulate.density_g(g)
    assert weight[g > simulate.MAX_G].sum() / weight.sum() < 2e-4


def test_galaxies_come_in_pairs_at_right_angles(field):
    intrinsic = np.stack([field.truth["intrinsic_g1"], field.truth["intrinsic_g2"]], axis=-1)
    np.testing.assert_allclose(intrinsic.sum(axis=0), 0, atol=1e-14)
    rows = {tuple(row) for row in intrinsic}
    assert len(rows) == 64
    assert all(tuple(-row) in rows for row in intrinsic)
    for name in ("kind", "pair"):
        by_shape = dict(zip(map(tuple, intrinsic), field.truth[name], strict=True))
        assert all(by_shape[tuple(-row)] == by_shape[tuple(row)] for row in intrinsic)


def test_half_of_each_kind(field):
    kinds = field.truth["kind"]
    assert sum(kinds == "exp") == sum(kinds == "dev") == 32


def test_lensed_shapes_are_the_sum_of_shears(field):
    """In complex notation, as on the page of conventions."""
    intrinsic = field.truth["intrinsic_g1"] + 1j * field.truth["intrinsic_g2"]
    applied = 0.03 - 0.02j
    lensed = (intrinsic + applied) / (1 + np.conj(applied) * intrinsic)
    np.testing.assert_allclose(field.truth["g1"], lensed.real, atol=1e-14)
    np.testing.assert_allclose(field.truth["g2"], lensed.imag, atol=1e-14)


def test_signal_to_noise_by_definition(field):
    snr = np.sqrt(np.sum(_cells(field.image, 48) ** 2, axis=(1, 2))) / simulate.NOISE_SIGMA
    np.testing.assert_allclose(snr, 200, rtol=1e-12)


def test_centroids_lie_in_a_circle_around_the_middle(field):
    number = np.arange(64)
    dx = field.truth["x"] - (number % 8 * 48 + 23.5)
    dy = field.truth["y"] - (number // 8 * 48 + 23.5)
    radius = np.hypot(dx, dy)
    assert radius.max() <= 1
    assert np.mean(radius**2) == pytest.approx(0.5, abs=0.15)


def test_truth_is_where_the_light_is(field):
    cells = _cells(field.image, 48)
    y, x = np.mgrid[:48, :48]
    for i, stamp in enumerate(cells):
        weight = stamp * np.exp(-((x - 23.5) ** 2 + (y - 23.5) ** 2) / 2 / 8**2)
        corner = (i % 8 * 48, i // 8 * 48)
        centre = [
            np.sum(weight * v) / weight.sum() + c for v, c in zip((x, y), corner, strict=True)
        ]
        assert centre == pytest.approx((field.truth["x"][i], field.truth["y"][i]), abs=0.25)


def test_fluxes_are_true(field):
    inside = np.sum(_cells(field.image, 48), axis=(1, 2)) / field.truth["flux"]
    assert np.all(inside <= 1.001)
    assert np.all(inside[field.truth["kind"] == "exp"] > 0.98)


def test_noise(field):
    noisy = great08_image(n_x=8, n_y=8, cell=48, snr=200, shear=(0.03, -0.02), seed=5)
    residual = noisy.image - field.image
    assert residual.std() == pytest.approx(1000, rel=0.01)
    assert abs(residual.mean()) < 4 * 1000 / 384


def test_psf_image(field):
    assert field.psf_image.shape == (48, 48)
    assert field.psf_image.sum() == pytest.approx(1)
    assert field.psf_image.min() >= -1e-6


def test_one_seed_one_image():
    arguments = {"n_x": 3, "n_y": 2, "cell": 32}
    first, again = great08_image(**arguments, seed=1), great08_image(**arguments, seed=1)
    np.testing.assert_array_equal(first.image, again.image)
    assert all(np.all(first.truth[name] == again.truth[name]) for name in first.truth.colnames)
    assert np.any(first.image != great08_image(**arguments, seed=2).image)


def test_layout_shape_and_another_psf():
    drawn = great08_image(n_x=3, n_y=2, cell=32, snr=None, psf=galsim.Gaussian(fwhm=3))
    assert drawn.image.shape == (64, 96)
    assert len(drawn.truth) == 6
    assert all(column.description for column in drawn.truth.itercols())
    moments = galsim.hsm.FindAdaptiveMom(galsim.Image(drawn.psf_image))
    assert moments.observed_shape.g == pytest.approx(0, abs=1e-5)


@pytest.mark.parametrize(
    ("arguments", "error", "match"),
    [
        ({"n_x": 3, "n_y": 3}, FdntValueError, "pairs"),
        ({"n_x": 0}, FdntValueError, "pairs"),
        ({"cell": 4}, RangeError, "cell"),
        ({"shear": (0.8, 0.7)}, RangeError, "shear"),
        ({"snr": 0.0}, RangeError, "snr"),
        ({"snr": float("nan")}, RangeError, "snr"),
    ],
)
def test_bad_arguments(arguments, error, match):
    with pytest.raises(error, match=match):
        great08_image(**arguments)


def test_without_galsim_the_extra_is_named(monkeypatch):
    real = builtins.__import__

    def without(name, *rest):
        if name == "galsim":
            raise ImportError(name)
        return real(name, *rest)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(MissingExtraError, match=r"fdnt-xp\[sim\]"):
        great08_image(n_x=2, n_y=1)
