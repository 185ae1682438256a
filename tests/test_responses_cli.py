"""Responses and shears from the command line, from images to the last digit printed."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from click.testing import CliRunner

import fdnt_xp as fx
from conftest import selected_backends
from fdnt_xp.app import noise as noise_module
from fdnt_xp.app.backends import load_backend
from fdnt_xp.app.cli import main
from fdnt_xp.app.noise import Noise, find_noise
from fdnt_xp.app.plots import plot_catalog
from fdnt_xp.app.responses import galaxy_numbers, measure_source_responses
from fdnt_xp.app.shear import catalog_shear, parse_cut
from fdnt_xp.data.catalog import read_catalog, write_catalog
from fdnt_xp.data.simulate import great08_image
from fdnt_xp.data.stamps import cube_stamps, grid_stamps
from fdnt_xp.errors import CatalogError, FdntValueError, FdntWarning, ShapeMismatchError
from fdnt_xp.flags import Flag
from fdnt_xp.shapes.methods import method_in_noise, shape_method
from fdnt_xp.shapes.results import PSF_COLUMNS
from fdnt_xp.shears.responses import COLUMNS

pytest.importorskip("galsim")

CELL = 40
SIDE = 6
N_GAL = SIDE**2
SIGMA = 1000.0
SUFFIXES = [".fits", ".ecsv", ".parquet"]
TESTED = {backend.library for backend in selected_backends()}


@pytest.fixture(scope="module")
def drawn():
    """Galaxies of S/N 40 in pairs at 90 degrees."""
    return great08_image(n_x=SIDE, n_y=SIDE, cell=CELL, snr=40, shear=(0.1, 0.0), seed=2)


@pytest.fixture
def folder(drawn, tmp_path, monkeypatch):
    """A working directory with an image, its PSF, positions with names, and blank sky."""
    monkeypatch.chdir(tmp_path)
    fits.PrimaryHDU(drawn.image).writeto("image.fits")
    fits.PrimaryHDU(drawn.psf_image).writeto("psf.fits")
    rng = np.random.default_rng(1)
    white = SIGMA * rng.standard_normal((10 * CELL, 10 * CELL))
    fits.PrimaryHDU(white.astype("f4")).writeto("white.fits")
    correlated = (white + 0.5 * np.roll(white, 1, axis=1)) / np.sqrt(1.25)
    fits.PrimaryHDU(correlated).writeto("correlated.fits")
    return tmp_path


def run(*arguments, code=0):
    """Run the command line and return what it printed, stdout and stderr together."""
    result = CliRunner().invoke(main, [str(argument) for argument in arguments])
    assert result.exit_code == code, result.output
    assert "Traceback" not in result.output
    return result.output


MEASURE = ("measure", "image.fits", "--psf", "psf.fits", "--cell", CELL, "--responses")


# --- measure --responses ----------------------------------------------------------------


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_image_to_shear(suffix, folder, drawn):
    output = run(*MEASURE, "-o", f"catalog{suffix}")
    assert f"measured   {N_GAL} of {N_GAL} galaxies (100.00%)" in output
    table = read_catalog(f"catalog{suffix}")
    names = ["id", "x", "y", "x_image", "y_image"]
    measured = [name for name in COLUMNS if name not in ("x", "y")]
    assert table.colnames == [*names, *measured, *PSF_COLUMNS]
    assert all(column.description for column in table.itercols())
    assert table["size_1p"].unit == "pix"
    np.testing.assert_allclose(table["x_image"], drawn.truth["x"], atol=0.5)
    assert table.meta["RSTEP"] == 0.01
    estimate = fx.shear_from_responses(table)
    assert estimate.n_used == N_GAL
    said = re.search(r"mean shear g1 = ([+-][\d.]+) ± [\d.]+, g2 = ([+-][\d.]+) ± ", output)
    assert [float(g) for g in said.groups()] == pytest.approx(list(estimate.g), abs=1e-3)
    assert abs(estimate.g[0] - 0.1) < 4 * estimate.g_err[0]
    assert abs(estimate.g[1]) < 4 * estimate.g_err[1]


def test_it_is_what_the_library_measures(folder, drawn):
    run(*MEASURE, "-o", "catalog.fits", "--seed", 5, "--chunk", 7, "--noise-variance", SIGMA**2)
    table = read_catalog("catalog.fits")
    stamps = grid_stamps(drawn.image, CELL).read(0, N_GAL).stamps
    psf = fx.Psf.from_image(drawn.psf_image)
    columns = fx.measure_responses(stamps, psf, noise_variance=SIGMA**2, seed=5).to_columns()
    for name, values in columns.items():
        if name not in ("x", "y"):
            np.testing.assert_allclose(table[name], values, rtol=1e-9, atol=1e-9)


def test_the_header_says_how(folder):
    run(*MEASURE, "-o", "catalog.fits", "--seed", 7)
    header = fits.getheader("catalog.fits", 1)
    assert (header["METHOD"], header["SEED"], header["RSTEP"]) == ("responses", 7, 0.01)
    assert header["NOISESRC"] == "stamp borders"
    assert header["NOISEVAR"] == pytest.approx(SIGMA**2, rel=0.1)
    assert 0.003 < header["NOISEERR"] < 0.05
    run(*MEASURE[:-1], "-o", "shapes.fits", "--noise-variance", 1e6)
    header = fits.getheader("shapes.fits", 1)
    assert header["METHOD"] == "fdnt-ft"
    assert header["NOISESRC"] == "given"
    assert not {"SEED", "RSTEP", "NOISEERR", "NOISECOR"} & set(header)


def test_seeds_differ(folder):
    for seed in (0, 0, 1):
        run(*MEASURE, "-o", f"{seed}.fits", "--seed", seed, "--overwrite")
    zero, one = read_catalog("0.fits"), read_catalog("1.fits")
    difference = np.abs(zero["v1"] - one["v1"])
    assert np.min(difference) > 0
    assert np.max(difference) < 0.05


def test_names_in_any_order_have_the_same_noise(folder, drawn):
    names = np.array([f"J{i:04d}+{i * 7 % 11}" for i in range(N_GAL)])
    order = np.random.default_rng(3).permutation(N_GAL)
    positions = ("--positions", "p.ecsv", "--stamp-size", CELL - 6)
    tables = []
    for rows, chunk in ((np.arange(N_GAL), 100), (order, 5)):
        table = Table({"id": names, "x": drawn.truth["x"], "y": drawn.truth["y"]})[rows]
        table.write("p.ecsv", overwrite=True)
        arguments = (*MEASURE[:4], *positions, "--responses", "--noise-variance", 1e6)
        run(*arguments, "--chunk", chunk, "-o", "named.fits", "--overwrite")
        tables.append(read_catalog("named.fits"))
    straight, shuffled = tables
    assert straight["id"].tolist() == names.tolist()
    for name in straight.colnames[1:]:
        np.testing.assert_allclose(shuffled[name], straight[name][order], rtol=1e-9, atol=1e-9)


def test_galaxies_without_a_stamp_have_a_row(folder):
    table = Table({"id": ["in", "edge", "off"], "x": [60.0, 3.0, -50.0], "y": [60.0, 60.0, 60.0]})
    table.write("three.ecsv")
    arguments = (*MEASURE[:4], "--positions", "three.ecsv", "--stamp-size", 32, "--responses")
    output = run(*arguments, "--noise-variance", 1e6, "-o", "three.fits")
    rows = read_catalog("three.fits")
    assert rows["flags"].tolist() == [0, int(Flag.EDGE), int(Flag.OFF_IMAGE)]
    assert np.isnan(rows["v1"][1:]).all()
    assert "mean shear cannot be told: 1 of 3 galaxies are measured" in output
    assert "1 of 3 galaxies are measured" in run("shear", "three.fits", code=1)


def test_no_galaxies(folder):
    Table({"x": np.zeros(0), "y": np.zeros(0)}).write("none.ecsv")
    arguments = (*MEASURE[:4], "--positions", "none.ecsv", "--stamp-size", 32, "--responses")
    assert "0 of 0" in run(*arguments, "--noise-variance", 1e6, "-o", "none.fits")
    assert len(read_catalog("none.fits")) == 0


def test_psfs_of_their_own_share_one_weight(drawn):
    """The default size is that of the sample, which no chunk of a cube of PSFs knows."""
    y, x = np.mgrid[:CELL, :CELL] - (CELL - 1) / 2
    sigma = np.where(np.arange(N_GAL) < N_GAL // 2, 1.5, 1.9)[:, None, None]
    psfs = np.exp(-(x**2 + y**2) / 2 / sigma**2)
    source = grid_stamps(drawn.image, CELL)
    noise = Noise(variance=SIGMA**2)
    backend = load_backend()
    table = measure_source_responses(source, psfs, backend=backend, noise=noise, chunk=9)
    stamps = source.read(0, N_GAL).stamps
    whole = fx.measure_responses(stamps, fx.Psf.from_image(psfs), noise_variance=SIGMA**2)
    np.testing.assert_allclose(table["v1"], whole.v[:, 0], atol=1e-9)
    np.testing.assert_allclose(table["R21"], whole.response[:, 1, 0], atol=1e-8)
    np.testing.assert_allclose(table["size"], whole.size[:, 0], atol=1e-8)


@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("library", ["numpy", "torch", "jax", "cupy"])
def test_backends_agree(library, dtype, folder):
    if library not in TESTED:
        pytest.skip(f"{library} is not installed, or not among the backends under test")
    where = ("--backend", library, "--dtype", dtype)
    if (library, dtype) == ("jax", "float32"):
        assert "64-bit integers" in run(*MEASURE, "-o", "other.fits", *where, code=1)
        return
    run(*MEASURE, "-o", "numpy.fits")
    run(*MEASURE, "-o", "other.fits", *where)
    one, other = read_catalog("numpy.fits"), read_catalog("other.fits")
    for name in ("v1", "v2", "R11"):
        limit = 1e-9 if dtype == "float64" else 5e-3
        np.testing.assert_allclose(other[name], one[name], atol=limit)


# --- identifiers ------------------------------------------------------------------------


def test_whole_numbers_stay():
    for ids in (np.array([3, -1, 2**62]), np.array([3.0, 7.0]), np.array([1, 2], dtype="u2")):
        numbers = galaxy_numbers(ids)
        assert numbers.dtype == np.int64
        assert numbers.tolist() == ids.tolist()


def test_texts_are_hashed_alike_everywhere():
    numbers = galaxy_numbers(np.array(["a", "b", "J0001+2"]))
    assert numbers.tolist() == [2340832890917691671, 4771952420932724666, 5112672208582001154]
    assert galaxy_numbers(np.array([b"a", b"b"])).tolist() == numbers[:2].tolist()
    assert galaxy_numbers(np.array(["b   ", "a"], dtype=object)).tolist() == numbers[1::-1].tolist()
    assert len(galaxy_numbers(np.array([0.5, np.nan]))) == 2


def test_one_name_for_two_galaxies_is_warned_of():
    with pytest.warns(FdntWarning, match="the same id"):
        galaxy_numbers(np.array(["a", "b", "a"]))


# --- noise images -----------------------------------------------------------------------


def test_a_white_noise_image(folder):
    run(*MEASURE, "--noise-image", "white.fits", "-o", "catalog.fits")
    header = fits.getheader("catalog.fits", 1)
    assert (header["NOISESRC"], header["NOISEIMG"]) == ("noise image", "white.fits")
    assert header["NOISECOR"] is False
    assert header["NOISEVAR"] == pytest.approx(SIGMA**2, rel=0.02)
    assert header["NOISEERR"] == pytest.approx(np.sqrt(2 / (100 * CELL**2)), rel=0.5)
    run(*MEASURE, "--noise-variance", header["NOISEVAR"], "-o", "given.fits")
    one, other = read_catalog("catalog.fits"), read_catalog("given.fits")
    np.testing.assert_array_equal(one["v1"], other["v1"])


def test_a_correlated_noise_image(folder, drawn):
    run(*MEASURE, "--noise-image", "correlated.fits", "-o", "catalog.fits")
    assert fits.getheader("catalog.fits", 1)["NOISECOR"] is True
    source = grid_stamps(drawn.image, CELL)
    noise = find_noise(source, blank=fits.getdata("correlated.fits"))
    stamps, psf = source.read(0, N_GAL).stamps, fx.Psf.from_image(drawn.psf_image)
    whole = fx.measure_responses(stamps, psf, noise_power=noise.power)
    np.testing.assert_allclose(read_catalog("catalog.fits")["v1"], whole.v[:, 0], atol=1e-9)


@pytest.mark.parametrize("method", ["fdnt-ft", "fdnt-gl", "gauss-1"])
def test_shapes_in_correlated_noise(method, folder, drawn):
    shapes = ("measure", "image.fits", "--psf", "psf.fits", "--cell", CELL, "--method", method)
    run(*shapes, "--noise-image", "correlated.fits", "-o", "catalog.fits")
    header, table = fits.getheader("catalog.fits", 1), read_catalog("catalog.fits")
    source = grid_stamps(drawn.image, CELL)
    noise = find_noise(source, blank=fits.getdata("correlated.fits"))
    stamps, psf = source.read(0, N_GAL).stamps, fx.Psf.from_image(drawn.psf_image)
    if method == "gauss-1":  # knows white noise only
        assert "NOISECOR" not in header
        whole = shape_method(method)(stamps, psf, noise_variance=noise.variance)
    else:
        assert header["NOISECOR"] is True
        whole = method_in_noise(method, noise.power)(stamps, psf)
    np.testing.assert_allclose(table["eta1_var"], whole.eta_cov[:, 0, 0], rtol=1e-6)


def test_a_cube_of_blank_stamps_and_plain_shapes(folder):
    cube = SIGMA * np.random.default_rng(5).standard_normal((60, CELL, CELL))
    fits.PrimaryHDU(cube).writeto("blank.fits")
    run(*MEASURE[:-1], "--noise-image", "blank.fits", "-o", "catalog.fits")
    header = fits.getheader("catalog.fits", 1)
    assert (header["METHOD"], header["NOISESRC"]) == ("fdnt-ft", "noise image")
    assert header["NOISEVAR"] == pytest.approx(SIGMA**2, rel=0.02)


def test_noise_images_that_cannot_be_used(folder):
    def refused(*arguments):
        return run(*MEASURE, *arguments, "-o", "catalog.fits", code=1)

    assert "cannot read the noise image: no.fits" in refused("--noise-image", "no.fits")
    assert "not both" in refused("--noise-image", "white.fits", "--noise-variance", 1.0)
    assert "fits into a noise image" in refused("--noise-image", "psf.fits", "--cell", 2 * CELL)
    fits.PrimaryHDU(np.ones((60, 32, 32))).writeto("small.fits")
    assert "they must be the same" in refused("--noise-image", "small.fits")
    assert "of 1 blank stamps" in refused("--noise-image", "psf.fits")
    output = run(*MEASURE, "--noise-image", "white.fits", "-o", "white.fits", code=1)
    assert "is an input" in output
    assert not (folder / "catalog.fits").exists()


def test_noise_of_the_source_and_of_blank_sky():
    source = cube_stamps(2.0 * np.random.default_rng(1).standard_normal((50, 16, 16)))
    assert find_noise(source, 5.0).relative_err is None
    border = find_noise(source)
    assert (border.origin, border.power) == ("stamp borders", None)
    assert 0 < border.relative_err < 0.1
    with pytest.raises(ShapeMismatchError, match="16 x 16"):
        find_noise(source, blank=np.ones((30, 16, 20)))


# --- shear ------------------------------------------------------------------------------


@pytest.mark.parametrize("layout", ["image", "cube"])
def test_much_blank_sky_is_sampled(layout, monkeypatch):
    """Evenly, whatever there is of it, so that memory is bounded."""
    rng = np.random.default_rng(4)
    source = cube_stamps(np.zeros((1, 16, 20)))
    n_rows, n_columns = 40, 5
    scale = np.repeat(np.linspace(0.5, 1.5, n_rows), n_columns)[:, None, None]
    stamps = scale * rng.standard_normal((n_rows * n_columns, 16, 20))
    blank = stamps
    if layout == "image":
        cells = stamps.reshape(n_rows, n_columns, 16, 20)
        blank = np.pad(cells.swapaxes(1, 2).reshape(n_rows * 16, -1), ((0, 7), (0, 3)))
    whole = find_noise(source, blank=blank)
    assert whole.blank.n_stamps + whole.blank.n_rejected == 200
    monkeypatch.setattr(noise_module, "_BLANK_BYTES", 100 * 16 * 20 * 8)
    part = find_noise(source, blank=blank)
    assert part.blank.n_stamps + part.blank.n_rejected == 100
    assert part.variance == pytest.approx(whole.variance, rel=0.05)


@pytest.fixture
def catalog(folder):
    run(*MEASURE, "-o", "catalog.fits", "-q")
    return read_catalog("catalog.fits")


def test_shear(catalog):
    estimate = fx.shear_from_responses(catalog)
    lines = run("shear", "catalog.fits").splitlines()
    assert lines[0] == f"galaxies   {N_GAL} of {N_GAL}: 0 cut, 0 not measured"
    for i in (0, 1):
        name, value, sign, error = lines[1 + i].split()
        assert (name, sign) == (f"g{i + 1}", "±")
        assert float(value) == pytest.approx(estimate.g[i], abs=6e-4)
        assert float(error) == pytest.approx(estimate.g_err[i], rel=0.05)


def test_shear_with_cuts_as_json(catalog):
    middle = float(np.median(catalog["size"]))
    cuts = (f"size>{middle}", "snr < 1e3")
    facts = json.loads(run("shear", "catalog.fits", "--cut", cuts[0], "--cut", cuts[1], "--json"))
    estimate = fx.shear_from_responses(
        catalog, cut=[fx.Cut(quantity="size", low=middle), fx.Cut(quantity="snr", high=1e3)]
    )
    assert facts["g1"] == float(estimate.g[0])
    assert facts["g2_err"] == float(estimate.g_err[1])
    assert facts["n_used"] + facts["n_excluded"] == facts["n_gal"] == N_GAL
    assert facts["n_used"] == pytest.approx(N_GAL / 2, abs=1)
    assert (facts["catalog"], facts["cuts"]) == ("catalog.fits", list(cuts))


def test_any_rows_of_a_catalog(catalog):
    write_catalog(catalog[:20], "part.ecsv")
    assert "20 of 20" in run("shear", "part.ecsv")


@pytest.mark.parametrize("cut", ["snr", "snr=15", "snr>", ">15", "snr>much", "snr>1>2", "snr>nan"])
def test_cuts_that_are_none(cut, catalog):
    assert "cut" in run("shear", "catalog.fits", "--cut", cut, code=1)


def test_what_has_no_shear(catalog):
    assert "no quantity 'e1'" in run("shear", "catalog.fits", "--cut", "e1>0", code=1)
    assert "0 of 36" in run("shear", "catalog.fits", "--cut", "snr>1e9", code=1)
    assert "does not exist" in run("shear", "no.fits", code=1)
    run(*MEASURE[:-1], "-o", "shapes.fits")
    assert "no responses" in run("shear", "shapes.fits", code=1)
    with pytest.raises(CatalogError, match="no responses"):
        catalog_shear(Table({"a": [1.0]}))


def test_parsed_cuts():
    assert parse_cut(" snr > 15 ") == fx.Cut(quantity="snr", low=15.0)
    assert parse_cut("size<1.2") == fx.Cut(quantity="size", high=1.2)
    with pytest.raises(FdntValueError, match="NAME>VALUE"):
        parse_cut("snr>=15")


# --- plot -------------------------------------------------------------------------------


def test_plot(catalog, folder):
    pytest.importorskip("matplotlib")
    run("plot", "catalog.fits")
    assert (folder / "catalog.png").read_bytes().startswith(b"\x89PNG")
    figure = plot_catalog(catalog)
    titles = {axes.get_title(loc="left") for axes in figure.axes}
    assert {"Quadrupoles on the image", "Components", "Responses"} <= titles
    assert "mean shear g1 = " in figure.get_suptitle()


@pytest.mark.parametrize("n", [0, 1, 2])
def test_plot_of_few(n, catalog):
    pytest.importorskip("matplotlib")
    plot_catalog(catalog[:n]).canvas.draw()


def test_plot_of_a_cube(folder, drawn):
    pytest.importorskip("matplotlib")
    stamps = grid_stamps(drawn.image, CELL).read(0, 12).stamps
    fits.PrimaryHDU(stamps).writeto("cube.fits")
    run("measure", "cube.fits", "--psf", "psf.fits", "--responses", "-o", "catalog.ecsv")
    run("plot", "catalog.ecsv")
