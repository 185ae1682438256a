"""Jacobians from the header of an image, beside GalSim's; and `fdnt-xp measure --wcs`."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS
from click.testing import CliRunner

import fdnt_xp as fx
from fdnt_xp.app.cli import main
from fdnt_xp.data.catalog import read_catalog
from fdnt_xp.data.images import read_header
from fdnt_xp.data.wcs import wcs_jacobians
from fdnt_xp.errors import CatalogError
from fdnt_xp.flags import Flag
from images import gaussian_covariance, gaussian_image

CELL, SCALE = 48, 0.2
E = np.array([[0.3, 0.1], [-0.2, 0.4], [0.0, 0.0], [0.1, -0.5]])
"""On the sky: about west, towards north."""


def header(turn=20.0, mirror=True, dec=35.0, kind="TAN"):
    """Return a header of pixels of 0.2 arcsec, sheared by 5 %; east to the left if mirrored."""
    angle = np.radians(turn)
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    matrix = rotation @ np.array([[1.05, 0.03], [0.0, 0.95]]) * SCALE / 3600.0
    wcs = WCS(naxis=2)
    wcs.wcs.ctype = [f"RA---{kind}", f"DEC--{kind}"]
    wcs.wcs.crval = [150.0, dec]
    wcs.wcs.crpix = [CELL, CELL]
    # World coordinates grow to the east.
    wcs.wcs.cd = np.diag([-1.0 if mirror else 1.0, 1.0]) @ matrix
    return wcs.to_header()


POSITIONS = np.array([[0.0, 0.0], [47.5, 47.5], [1000.0, -300.0], [4000.0, 4000.0]])


@pytest.mark.parametrize(
    "options",
    [{}, {"mirror": False}, {"turn": 200.0, "dec": -70.0, "kind": "ARC"}],
    ids=str,
)
def test_it_is_galsims(options):
    galsim = pytest.importorskip("galsim")
    found = wcs_jacobians(header(**options), POSITIONS)
    wcs = galsim.AstropyWCS(header=header(**options), origin=galsim.PositionD(0, 0))
    # GalSim counts from 1, as FITS does.
    expected = [wcs.local(galsim.PositionD(*(p + 1.0))).getMatrix() for p in POSITIONS]
    np.testing.assert_allclose(found, expected, atol=1e-6 * SCALE)


def test_nothing_happens_at_the_pole():
    found = wcs_jacobians(header(dec=89.9999), POSITIONS)
    np.testing.assert_allclose(np.abs(np.linalg.det(found)), 1.05 * 0.95 * SCALE**2, rtol=1e-3)


def test_u_is_west_and_v_is_north():
    (found,) = wcs_jacobians(header(turn=0.0), np.array([[47.0, 47.0]]))
    np.testing.assert_allclose(found, SCALE * np.array([[1.05, 0.03], [0.0, 0.95]]), atol=1e-8)
    (found,) = wcs_jacobians(header(turn=0.0, mirror=False), np.array([[47.0, 47.0]]))
    np.testing.assert_allclose(found, SCALE * np.array([[-1.05, -0.03], [0, 0.95]]), atol=1e-8)


def test_headers_without_a_sky():
    with pytest.raises(CatalogError, match="no celestial coordinates"):
        wcs_jacobians(fits.PrimaryHDU(np.zeros((4, 4))).header, POSITIONS)
    broken = header()
    broken["CTYPE1"] = "RA---XYZ"
    with pytest.raises(CatalogError, match=r"world coordinates|celestial"):
        wcs_jacobians(broken, POSITIONS)


# --- the command ------------------------------------------------------------------------


def run(*arguments, code=0):
    result = CliRunner().invoke(main, ["measure", *map(str, arguments)])
    assert result.exit_code == code, result.output
    return result.output


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Four Gaussian galaxies of known shapes on the sky, as an image with such a header."""
    monkeypatch.chdir(tmp_path)
    (jacobian,) = wcs_jacobians(header(), np.array([[47.5, 47.5]]))
    inverse = np.linalg.inv(jacobian)
    psf = gaussian_covariance((0.1, 0.05), 1.7 * SCALE)

    def seen(covariance):
        return gaussian_image(inverse @ covariance @ inverse.T, (CELL, CELL))

    cells = [seen(gaussian_covariance(tuple(e), 1.9 * SCALE) + psf) for e in E]
    image = np.block([[cells[0], cells[1]], [cells[2], cells[3]]])
    image = image + 1e-6 * np.random.default_rng(1).standard_normal(image.shape)
    fits.PrimaryHDU(image, header=header()).writeto("image.fits")
    fits.PrimaryHDU(seen(psf)).writeto("psf.fits")
    return jacobian


GRID = ("image.fits", "--psf", "psf.fits", "--cell", CELL, "-o", "out.fits", "--overwrite")


def test_shapes_are_those_on_the_sky(folder):
    text = ",".join(f"{number:.12g}" for number in folder.ravel())
    for options in (("--wcs",), ("--jacobian", text)):
        run(*GRID, *options)
        table = read_catalog("out.fits")
        np.testing.assert_allclose(np.stack([table["e1"], table["e2"]], axis=-1), E, atol=2e-3)
        said = fits.getheader("out.fits", 1)["JACOBIAN"]
        if options == ("--wcs",):
            assert said == "wcs"
        else:
            np.testing.assert_allclose(np.fromstring(said, sep=","), folder.ravel(), rtol=1e-5)
    np.testing.assert_allclose(table["size"][2], 1.9 * SCALE, rtol=0.01)


def test_responses_are_those_on_the_sky(folder):
    run(*GRID, "--responses", "--wcs", "--noise-variance", 1e-12)
    table = read_catalog("out.fits")
    v = np.stack([table["v1"], table["v2"]], axis=-1)
    assert abs(v[2]).max() < 1e-3
    # Along the shapes: the noise is nothing.
    for row in (0, 1, 3):
        cosine = v[row] @ E[row] / np.linalg.norm(v[row]) / np.linalg.norm(E[row])
        assert cosine == pytest.approx(1.0, abs=1e-3)
    stamps = fits.getdata("image.fits")[:CELL, :CELL][None]
    j = wcs_jacobians(read_header("image.fits"), np.array([[23.5, 23.5]]))
    alone = fx.measure_responses(
        np.array(stamps, dtype=float),
        fx.Psf.from_image(np.array(fits.getdata("psf.fits"), dtype=float)),
        noise_variance=1e-12,
        jacobian=j,
        isotropise=False,
        size=0.5,
    )
    run(*GRID, "--responses", "--wcs", "--noise-variance", 1e-12, "--size", 0.5)
    np.testing.assert_allclose(read_catalog("out.fits")["v1"][0], alone.v[0, 0], atol=1e-3)


def test_positions_off_the_sky_are_flagged(folder):
    # A cylindrical map of all the sky, of which a part of the image is none.
    wide = header(kind="AIT")
    wide["CD1_1"], wide["CD2_2"], wide["CD1_2"], wide["CD2_1"] = -4.0, 4.0, 0.0, 0.0
    for name in list(wide):
        if name.startswith("PC"):
            del wide[name]
    fits.PrimaryHDU(fits.getdata("image.fits"), header=wide).writeto("wide.fits")
    run("wide.fits", *GRID[1:], "--wcs")
    flags = np.asarray(read_catalog("out.fits")["flags"])
    assert np.any(flags & int(Flag.BAD_JACOBIAN))


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("--jacobian", "1,2,3"), "--jacobian must be four numbers"),
        (("--jacobian", "1,0,0,x"), "--jacobian must be four numbers"),
        (("--jacobian", "1,1,1,1"), "not singular"),
        (("--jacobian", "1,0,0,1", "--wcs"), "no --jacobian"),
        (("--wcs", "--method", "gauss-1"), "--jacobian and --wcs are for"),
    ],
)
def test_what_the_command_refuses_is_one_line(folder, arguments, says):
    said = run(*GRID, *arguments, code=1)
    assert said.startswith("Error: ")
    assert says in said
