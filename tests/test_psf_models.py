"""Star images from GalSim objects, Piff and PSFEx models, drawn once where they are the same."""

from __future__ import annotations

import sys
from types import SimpleNamespace

import numpy as np
import pytest
from astropy.io import fits
from click.testing import CliRunner

import fdnt_xp as fx
from fdnt_xp.app.cli import main
from fdnt_xp.data.catalog import read_catalog
from fdnt_xp.data.psf_models import draw_stars, read_piff, read_psfex
from fdnt_xp.errors import (
    CatalogError,
    FdntTypeError,
    FdntValueError,
    MissingExtraError,
    RangeError,
    ShapeMismatchError,
)
from fdnt_xp.flags import flag_names
from images import gaussian_covariance, gaussian_image

galsim = pytest.importorskip("galsim")

XY = np.array([[10.0, 20.0], [300.0, 40.0], [10.0, 20.0], [11.5, 21.0]])
SHEARED = 0.2 * np.array([[1.1, 0.1], [-0.05, -0.9]])


class FakePiff:
    """What `piff.read` returns, as far as it is used: a PSF that grows with x and colour."""

    def __init__(self):
        self.asked = []

    def get_profile(self):
        raise AssertionError("not needed")

    def draw(self, x, y, chipnum=None, stamp_size=48, center=None, colour=0.0):
        self.asked.append((x, y, chipnum, colour))
        sigma = 1.5 + 1e-3 * x + colour
        image = gaussian_image(gaussian_covariance((0.1, 0.0), sigma), (stamp_size, stamp_size))
        assert center is True
        return SimpleNamespace(array=image.astype(np.float32))


@pytest.fixture
def psfex_file(tmp_path):
    """A PSFEx file: a Gaussian sampled at 0.7 of the pixel, that grows with x."""
    side, samp = 45, 0.7

    def star(sigma):
        return gaussian_image(gaussian_covariance((0.2, 0.1), sigma / samp), (side, side))

    constant, slope = star(2.0), star(2.2) - star(2.0)
    basis = np.stack([constant, slope, 0.0 * constant]).astype(np.float32)
    column = fits.Column("PSF_MASK", f"{basis.size}E", dim=f"({side},{side},3)", array=basis[None])
    table = fits.BinTableHDU.from_columns([column], name="PSF_DATA")
    cards = {
        "POLNAXIS": 2,
        "POLNAME1": "X_IMAGE",
        "POLNAME2": "Y_IMAGE",
        "POLNGRP": 1,
        "POLGRP1": 1,
        "POLGRP2": 1,
        "POLDEG1": 1,
        "POLZERO1": 1.0,
        "POLSCAL1": 100.0,
        "POLZERO2": 1.0,
        "POLSCAL2": 100.0,
        "PSFNAXIS": 3,
        "PSFAXIS1": side,
        "PSFAXIS2": side,
        "PSFAXIS3": 3,
        "PSF_SAMP": samp,
    }
    for name, value in cards.items():
        table.header[name] = value
    path = tmp_path / "model.psf"
    fits.HDUList([fits.PrimaryHDU(), table]).writeto(path)
    return path


# --- GalSim objects ------------------------------------------------------------------


def test_a_galsim_object_is_one_star_for_all():
    psf = galsim.Moffat(beta=3, fwhm=2.8).shear(g1=0.05)
    stars = draw_stars(psf, XY, size=32)
    assert stars.images.shape == (1, 32, 32)
    assert stars.psf_index.tolist() == [0, 0, 0, 0]
    expected = psf.drawImage(nx=32, ny=32, scale=1.0, dtype=float).array
    np.testing.assert_allclose(stars.images[0], expected, atol=1e-6)


def test_through_each_jacobian_with_its_pixel():
    psf = galsim.Moffat(beta=3, fwhm=0.6).shear(g2=0.05)
    j = np.stack([SHEARED, 0.2 * np.eye(2), SHEARED, SHEARED])
    stars = draw_stars(psf, XY, size=32, jacobian=j)
    assert stars.psf_index.tolist() == [0, 1, 0, 0]
    wcs = galsim.JacobianWCS(*SHEARED.ravel())
    expected = psf.drawImage(nx=32, ny=32, wcs=wcs, dtype=float).array
    # GalSim draws to a part in 1e4 of the peak, by another grid for another order of things.
    np.testing.assert_allclose(stars.images[0], expected, atol=1e-4 * expected.max())


def test_an_oversampled_star_is_the_same_psf():
    psf = galsim.Gaussian(sigma=0.5).shear(g1=0.1)
    galaxy = galsim.Gaussian(sigma=0.6).shear(g2=0.2)
    wcs = galsim.JacobianWCS(*SHEARED.ravel())
    stamp = galsim.Convolve([galaxy, psf]).drawImage(nx=64, ny=64, wcs=wcs, dtype=float).array
    shapes = []
    for oversampling, size in ((1.0, 64), (3.0, 160)):
        stars = draw_stars(psf, XY[:1], size=size, jacobian=SHEARED, oversampling=oversampling)
        star = fx.Psf.from_image(
            stars.images, psf_index=stars.psf_index, oversampling=stars.oversampling
        )
        shapes.append(fx.measure_shapes(stamp[None], star, jacobian=SHEARED).g[0])
    # GalSim draws to a part in 1e5.
    np.testing.assert_allclose(shapes, [[0.0, 0.2]] * 2, atol=2e-4)


def test_bad_places_and_pixels_are_flagged_later():
    model = FakePiff()
    stars = draw_stars(model, [[1.0, 2.0], [np.nan, 3.0], [np.inf, 0.0]], size=32)
    assert stars.psf_index.tolist() == [0, 1, 1]
    assert np.all(np.isnan(stars.images[1]))
    psf = galsim.Gaussian(sigma=1.8)
    j = np.stack([np.eye(2), np.zeros((2, 2)), np.full((2, 2), np.nan)])
    stars = draw_stars(psf, XY[:3], size=32, jacobian=j)
    assert stars.psf_index.tolist() == [0, 1, 1]
    stamps = np.stack([gaussian_image(gaussian_covariance((0.2, 0.0), 3.0), (32, 32))] * 3)
    star = fx.Psf.from_image(stars.images, psf_index=stars.psf_index)
    shapes = fx.measure_shapes(stamps, star, jacobian=j)
    assert flag_names(int(shapes.flags[0])) == []
    assert flag_names(int(shapes.flags[1])) == ["BAD_PSF", "BAD_JACOBIAN"]


# --- Piff ----------------------------------------------------------------------------


def test_piff_is_asked_once_for_each_place_and_counts_from_one():
    model = FakePiff()
    stars = draw_stars(model, XY, size=24, properties={"chipnum": 3})
    assert model.asked == [(11.0, 21.0, 3, 0.0), (301.0, 41.0, 3, 0.0), (12.5, 22.0, 3, 0.0)]
    assert stars.psf_index.tolist() == [0, 1, 0, 2]
    assert stars.images.shape == (3, 24, 24)
    assert stars.images.dtype == np.float64


def test_properties_of_each_galaxy():
    model = FakePiff()
    stars = draw_stars(model, XY, properties={"chipnum": 1, "colour": [0.1, 0.2, 0.3, 0.1]})
    assert stars.psf_index.tolist() == [0, 1, 2, 3]
    assert [asked[3] for asked in model.asked] == [0.1, 0.2, 0.3, 0.1]


def test_cells_share_the_star_of_their_middle():
    model = FakePiff()
    stars = draw_stars(model, XY, cell=100.0)
    assert stars.psf_index.tolist() == [0, 1, 0, 0]
    # Of pixels 0 to 99 and of 300 to 399; counted from one.
    assert model.asked[0][:2] == (50.5, 50.5)
    assert model.asked[1][:2] == (350.5, 50.5)


def test_equal_stars_are_kept_once():
    model = FakePiff()
    xy = np.array([[10.0, 1.0], [10.0, 2.0], [20.0, 3.0]])
    stars = draw_stars(model, xy)
    assert len(model.asked) == 3
    assert stars.psf_index.tolist() == [0, 0, 1]


def test_a_real_piff_model(tmp_path):
    piff = pytest.importorskip("piff")
    profile = galsim.Gaussian(sigma=0.5).shear(g1=0.1)
    wcs = galsim.JacobianWCS(*SHEARED.ravel())
    stars = []
    for x in (20.0, 50.0, 80.0):
        star = piff.Star.makeTarget(x=x, y=50.0, wcs=wcs, stamp_size=32)
        image = star.image
        profile.drawImage(image, center=(x, 50.0))
        weight = galsim.Image(np.full_like(image.array, 1e6), bounds=image.bounds)
        data = piff.StarData(image, galsim.PositionD(x, 50.0), weight=weight)
        stars.append(piff.Star(data, star.fit))
    psf = piff.SimplePSF(piff.Gaussian(), piff.Mean())
    psf.fit(stars, {0: wcs}, None)
    path = tmp_path / "model.piff"
    psf.write(str(path))
    model = read_piff(path)
    drawn = draw_stars(model, XY, size=32)
    assert drawn.psf_index.tolist() == [0, 0, 0, 0]
    expected = profile.drawImage(nx=32, ny=32, wcs=wcs, dtype=float).array
    np.testing.assert_allclose(drawn.images[0], expected, atol=1e-6 * expected.max())
    with pytest.raises(FdntValueError, match="colour"):
        draw_stars(model, XY, properties={"colour": 1.0})


def test_properties_that_the_model_does_not_know():
    with pytest.raises(FdntValueError, match=r"does not draw with the properties .*'seeing': 1"):
        draw_stars(FakePiff(), XY, properties={"seeing": 1})


# --- PSFEx ---------------------------------------------------------------------------


def test_psfex_draws_where_it_is_asked(psfex_file):
    stars = draw_stars(read_psfex(psfex_file), [[0.0, 0.0], [100.0, 7.0], [0.0, 50.0]], size=40)
    assert stars.psf_index.tolist() == [0, 1, 0]
    # At x = 1 (the first pixel) the constant, 100 further the slope in full.
    for image, sigma in zip(stars.images, (2.0, 2.2), strict=True):
        expected = gaussian_image(gaussian_covariance((0.2, 0.1), sigma), (40, 40))
        # Lanczos 3 between samples.
        np.testing.assert_allclose(image, expected, atol=5e-3 * expected.max())


def test_psfex_oversampled(psfex_file):
    model = read_psfex(psfex_file)
    stars = draw_stars(model, [[0.0, 0.0]], size=80, oversampling=2.0)
    expected = gaussian_image(gaussian_covariance((0.2, 0.1), 4.0), (80, 80))
    np.testing.assert_allclose(stars.images[0], expected, atol=5e-3 * expected.max())


# --- what is no model, and calls that mean nothing ------------------------------------


@pytest.mark.parametrize("model", [None, np.ones((8, 8)), "psf.fits", galsim.Shear(g1=0.1)])
def test_what_is_no_model(model):
    with pytest.raises(FdntTypeError, match="GalSim object, or a Piff or PSFEx model, not"):
        draw_stars(model, XY)


def test_calls_that_mean_nothing(psfex_file):
    psf = galsim.Gaussian(sigma=2)
    for xy in (np.zeros(2), np.zeros((2, 3))):
        with pytest.raises(ShapeMismatchError, match="positions"):
            draw_stars(psf, xy)
    for name, value in (
        ("size", 4),
        ("size", 20.5),
        ("oversampling", 0.0),
        ("oversampling", np.nan),
        ("cell", -1.0),
    ):
        with pytest.raises(RangeError, match=name):
            draw_stars(psf, XY, **{name: value})
    with pytest.raises(ShapeMismatchError, match="jacobian"):
        draw_stars(psf, XY, jacobian=np.ones((3, 2, 2)))
    with pytest.raises(FdntValueError, match="singular"):
        draw_stars(psf, XY, jacobian=np.ones((2, 2)))
    with pytest.raises(FdntValueError, match="jacobian is for GalSim objects"):
        draw_stars(FakePiff(), XY, jacobian=np.eye(2))
    with pytest.raises(FdntValueError, match="properties are for Piff"):
        draw_stars(psf, XY, properties={"chipnum": 1})
    with pytest.raises(FdntValueError, match="oversampling must be 1 for Piff"):
        draw_stars(FakePiff(), XY, oversampling=2.0)
    with pytest.raises(ShapeMismatchError, match="'colour'"):
        draw_stars(FakePiff(), XY, properties={"colour": [1.0, 2.0]})


def test_no_galaxies():
    stars = draw_stars(FakePiff(), np.zeros((0, 2)), size=32)
    assert stars.images.shape == (0, 32, 32)
    assert stars.psf_index.shape == (0,)


def test_files_that_are_no_models(tmp_path, psfex_file):
    with pytest.raises(CatalogError, match="there is no file"):
        read_psfex(tmp_path / "none.psf")
    with pytest.raises(CatalogError, match="there is no file"):
        read_psfex(psfex_file, tmp_path / "none.fits")
    other = tmp_path / "image.fits"
    fits.PrimaryHDU(np.zeros((4, 4))).writeto(other)
    with pytest.raises(CatalogError, match="is no PSFEx model"):
        read_psfex(other)
    other.write_text("nothing")
    with pytest.raises(CatalogError, match="is no PSFEx model"):
        read_psfex(other)


def test_missing_packages_are_named(monkeypatch, psfex_file):
    monkeypatch.setitem(sys.modules, "piff", None)
    with pytest.raises(MissingExtraError, match="pip install piff"):
        read_piff(psfex_file)
    monkeypatch.setitem(sys.modules, "galsim", None)
    with pytest.raises(MissingExtraError, match="GalSim"):
        read_psfex(psfex_file)


def test_a_piff_file_that_is_none(monkeypatch, tmp_path, psfex_file):
    def fail(path):
        raise ValueError("no psf here")

    monkeypatch.setitem(sys.modules, "piff", SimpleNamespace(read=fail))
    with pytest.raises(CatalogError, match="is no Piff model: no psf here"):
        read_piff(psfex_file)
    with pytest.raises(CatalogError, match="there is no file"):
        read_piff(tmp_path / "none.piff")


# --- the command ----------------------------------------------------------------------


@pytest.fixture
def folder(psfex_file, monkeypatch):
    """A working directory with an image of four galaxies behind the PSF of `model.psf`."""
    monkeypatch.chdir(psfex_file.parent)
    middles = np.array([[19.5, 19.5], [59.5, 19.5], [19.5, 59.5], [59.5, 59.5]])
    cells = []
    for x, _ in middles:
        stars = [gaussian_covariance((0.2, 0.1), sigma) for sigma in (2.0, 2.2)]
        galaxy = gaussian_covariance((-0.1, 0.2), 2.0)
        parts = [gaussian_image(galaxy + one, (40, 40)) for one in stars]
        cells.append(parts[0] + x / 100.0 * (parts[1] - parts[0]))
    image = np.block([[cells[0], cells[1]], [cells[2], cells[3]]])
    fits.PrimaryHDU(image).writeto("image.fits")
    return middles


MEASURE = ("measure", "image.fits", "--cell", "40", "--noise-variance", "1e-6", "--quiet")


def catalog(*arguments):
    result = CliRunner().invoke(main, [*MEASURE, *arguments, "-o", "out.fits", "--overwrite"])
    assert result.exit_code == 0, result.output
    return read_catalog("out.fits")


@pytest.mark.parametrize("kind", [(), ("--responses",)], ids=str)
def test_a_catalog_with_a_model_is_that_with_its_stars(kind, folder):
    table = catalog("--psf", "model.psf", "--psf-model", "psfex", "--chunk", "3", *kind)
    stars = draw_stars(read_psfex("model.psf"), folder, size=40)
    fits.PrimaryHDU(stars.images[stars.psf_index]).writeto("stars.fits")
    same = catalog("--psf", "stars.fits", *kind)
    assert table.colnames == same.colnames
    for name in table.colnames:
        np.testing.assert_allclose(table[name], same[name], rtol=1e-9, atol=1e-12)
    assert table.meta["PSFMODEL"] == "psfex"
    assert "PSFMODEL" not in same.meta
    assert len(np.unique(np.round(table["psf_size"], 9))) == 2
    if not kind:
        np.testing.assert_allclose(table["e1"], -0.1, atol=0.01)
        np.testing.assert_allclose(table["e2"], 0.2, atol=0.01)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("--psf", "image.fits", "--psf-model", "psfex"), "image.fits is no PSFEx model"),
        (("--psf", "no.psf", "--psf-model", "psfex"), "there is no file"),
        (("--psf", "model.psf"), "holds no image"),
    ],
)
def test_models_that_are_refused(arguments, says, folder):
    result = CliRunner().invoke(main, [*MEASURE, *arguments, "-o", "out.fits"])
    assert result.exit_code == 1
    assert result.output.startswith("Error: ")
    assert says in result.output
    assert result.output.count("\n") == 1


def test_a_cube_has_no_places(folder):
    fits.PrimaryHDU(np.ones((2, 40, 40))).writeto("cube.fits")
    command = ["measure", "cube.fits", "--psf", "model.psf", "--psf-model", "psfex", "-o", "o.fits"]
    result = CliRunner().invoke(main, command)
    assert "Error: --psf-model psfex wants an image with --cell or --positions" in result.output
