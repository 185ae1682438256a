"""`fdnt-xp measure --mask --weight`: what is written, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.io import fits
from click.testing import CliRunner

from fdnt_xp.app.cli import main
from fdnt_xp.data.catalog import read_catalog
from fdnt_xp.flags import Flag
from images import galaxies, star

CELL = 48
SIGMA = 2e-5
E = np.array([[0.0, 0.0], [0.3, 0.1], [-0.2, 0.45], [0.05, -0.6]])
GRID = ("image.fits", "--psf", "psf.fits", "--cell", CELL)
CUBE = ("cube.fits", "--psf", "psf.fits")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Four Gaussian galaxies as an image and as a cube, with bad pixels of 1.0 in two of them."""
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(5)
    cube = galaxies(E, (CELL, CELL)) + SIGMA * rng.standard_normal((4, CELL, CELL))
    mask = np.zeros(cube.shape, dtype=np.uint8)
    mask[1] = rng.random((CELL, CELL)) < 0.05
    mask[2, :, CELL // 2 + 3] = 4
    cube[mask > 0] = 1.0
    ivar = np.where(mask > 0, 0.0, SIGMA**-2)
    for name, pixels in (("cube", cube), ("cubemask", mask), ("cubeivar", ivar)):
        fits.PrimaryHDU(pixels).writeto(f"{name}.fits")
        whole = pixels.reshape(2, 2, CELL, CELL).transpose(0, 2, 1, 3).reshape(2 * CELL, -1)
        image = "image" if name == "cube" else name.removeprefix("cube")
        fits.PrimaryHDU(whole).writeto(f"{image}.fits")
    fits.PrimaryHDU(star()).writeto("psf.fits")
    return tmp_path


def run(*arguments, code=0):
    result = CliRunner().invoke(main, ["measure", *(str(argument) for argument in arguments)])
    assert result.exit_code == code, result.output
    assert "Traceback" not in result.output
    return result.output


def catalog(*arguments):
    run(*arguments, "-o", "out.fits", "--overwrite", "--quiet")
    return read_catalog("out.fits")


@pytest.mark.parametrize("method", ["fdnt-gl", "fdnt-hybrid", "gauss-1", "nb07-8"])
def test_bad_pixels_do_no_harm(method, folder):
    named = ("--method", method, "--noise-variance", SIGMA**2)
    masked = catalog(*GRID, *named, "--mask", "mask.fits")
    without = catalog(*GRID, *named)
    error = [np.hypot(t["e1"] - E[:, 0], t["e2"] - E[:, 1]) for t in (masked, without)]
    # S/N 600 and more: errors of e are below 0.01, and without the mask several tenths.
    assert np.max(error[0]) < 0.02
    assert not np.any(error[1][1:3] < 0.1)
    fraction = fits.getdata("cubemask.fits").astype(bool).mean(axis=(1, 2))
    np.testing.assert_allclose(masked["masked_fraction"], fraction)
    assert np.all(without["masked_fraction"] == 0.0)


def test_the_stamps_transform_flags_them(folder):
    table = catalog(*GRID, "--noise-variance", SIGMA**2, "--mask", "mask.fits")
    masked = int(Flag.MASKED)
    assert table["flags"].tolist() == [0, masked, masked, 0]
    assert np.isnan(table["e1"]).tolist() == [False, True, True, False]


@pytest.mark.parametrize("chunk", [1, 3, 100])
def test_layouts_maps_and_chunks_agree(chunk, folder):
    np.savetxt(
        "positions.csv",
        [[23.5, 23.5], [71.5, 23.5], [23.5, 71.5], [71.5, 71.5]],
        delimiter=",",
        header="x,y",
        comments="",
    )
    named = ("--method", "fdnt-gl", "--chunk", chunk)
    noise = ("--noise-variance", SIGMA**2)
    at = (*GRID[:3], "--positions", "positions.csv", "--stamp-size", CELL)
    expected = catalog(*CUBE, "--method", "fdnt-gl", *noise, "--mask", "cubemask.fits")
    for other in (
        catalog(*GRID, *named, *noise, "--mask", "mask.fits"),
        catalog(*at, *named, *noise, "--mask", "mask.fits"),
        catalog(*GRID, *named, "--weight", "ivar.fits"),
        catalog(*CUBE, *named, "--weight", "cubeivar.fits"),
        catalog(*CUBE, *named, "--weight", "cubeivar.fits", "--mask", "cubemask.fits"),
    ):
        for name in ("eta1", "eta2", "eta1_var", "snr", "masked_fraction", "flags"):
            np.testing.assert_allclose(other[name], expected[name], rtol=1e-7, atol=1e-10)


def test_the_noise_is_measured_on_what_is_left(folder):
    table = catalog(*GRID, "--method", "gauss-1", "--mask", "mask.fits")
    assert table.meta["NOISESRC"] == "stamp borders"
    assert table.meta["NOISEVAR"] == pytest.approx(SIGMA**2, rel=0.3)
    assert table.meta["MASKIMG"] == "mask.fits"
    mapped = catalog(*GRID, "--method", "gauss-1", "--weight", "ivar.fits")
    assert (mapped.meta["NOISESRC"], mapped.meta["IVARIMG"]) == ("weight map", "ivar.fits")
    assert "NOISEVAR" not in mapped.meta
    np.testing.assert_allclose(
        mapped["snr"], table["snr"] * np.sqrt(table.meta["NOISEVAR"]) / SIGMA, rtol=1e-6
    )


def test_the_edge_of_the_image_is_flagged_as_ever(folder):
    np.savetxt("two.csv", [[3.0, 3.0], [47.5, 47.5]], delimiter=",", header="x,y", comments="")
    at = (*GRID[:3], "--positions", "two.csv", "--stamp-size", 32, "--method", "gauss-1")
    table = catalog(*at, "--weight", "ivar.fits")
    assert table["flags"][0] == int(Flag.EDGE)
    assert table["masked_fraction"][0] == 0.0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--mask", "no.fits"), "cannot read the mask: no.fits does not exist"),
        (("--weight", "psf.fits"), "the weight map has the shape (48, 48); it must have that of"),
        (("--mask", "cubemask.fits"), "the mask has the shape (4, 48, 48)"),
        (("--weight", "ivar.fits", "--noise-variance", 1.0), "give no --noise-variance and no"),
        (("--weight", "ivar.fits", "--noise-image", "image.fits"), "give no --noise-variance"),
        (("--mask", "mask.fits", "--responses"), "not for --responses"),
        (("--weight", "ivar.fits", "-o", "ivar.fits", "--overwrite"), "ivar.fits is an input"),
        (("--mask", "mask.fits", "-o", "mask.fits", "--overwrite"), "mask.fits is an input"),
    ],
)
def test_what_is_refused(arguments, message, folder):
    before = sorted(folder.iterdir())
    output = () if "-o" in arguments else ("-o", "c.fits")
    said = run(*GRID, *arguments, *output, code=1)
    assert said.startswith("Error: ")
    assert message in said
    assert said.count("\n") == 1
    assert sorted(folder.iterdir()) == before


def test_a_mask_without_any_noise_is_refused(folder):
    fits.PrimaryHDU(np.zeros((2 * CELL, 2 * CELL))).writeto("blank.fits")
    said = run("blank.fits", *GRID[1:], "--mask", "mask.fits", "-o", "c.fits", code=1)
    assert "give --noise-variance or --weight" in said
