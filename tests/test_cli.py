"""The command from end to end: what it writes, what it says, what it refuses."""

from __future__ import annotations

import importlib.util
import signal
import subprocess
import sys
import warnings

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from click.testing import CliRunner

import fdnt_xp
from conftest import selected_backends
from fdnt_xp.app import measure_run
from fdnt_xp.app.backends import load_backend
from fdnt_xp.app.cli import main
from fdnt_xp.app.demo import shear_lines
from fdnt_xp.app.noise import find_noise
from fdnt_xp.app.runner import measure_source
from fdnt_xp.data.catalog import read_catalog, write_catalog
from fdnt_xp.data.simulate import great08_image
from fdnt_xp.data.stamps import cube_stamps, grid_stamps
from fdnt_xp.errors import (
    FdntValueError,
    FdntWarning,
    MissingExtraError,
    RangeError,
    ShapeMismatchError,
)
from fdnt_xp.flags import Flag

pytest.importorskip("galsim")

CELL = 48
TESTED = {backend.library for backend in selected_backends()}


@pytest.fixture(scope="module")
def drawn():
    """Twelve galaxies, four by three, without much noise."""
    return great08_image(n_x=4, n_y=3, cell=CELL, snr=200, shear=(0.05, 0.0), seed=2)


@pytest.fixture
def folder(drawn, tmp_path, monkeypatch):
    """A working directory with `image.fits`, `cube.fits`, `psf.fits`, `positions.csv`."""
    monkeypatch.chdir(tmp_path)
    fits.PrimaryHDU(drawn.image.astype("f4")).writeto("image.fits")
    fits.PrimaryHDU(drawn.psf_image).writeto("psf.fits")
    stamps = grid_stamps(drawn.image, CELL).read(0, 12).stamps
    fits.PrimaryHDU(stamps).writeto("cube.fits")
    drawn.truth["id", "x", "y"].write("positions.csv", format="ascii.csv")
    return tmp_path


def run(*arguments, code=0):
    """Run the command line and return what it printed, stdout and stderr together."""
    result = CliRunner().invoke(main, [str(argument) for argument in arguments])
    assert result.exit_code == code, result.output
    assert "Traceback" not in result.output
    return result.output


GRID = ("measure", "image.fits", "--psf", "psf.fits", "--cell", CELL)
CUBE = ("measure", "cube.fits", "--psf", "psf.fits")
POSITIONS = (
    *("measure", "image.fits", "--psf", "psf.fits"),
    *("--positions", "positions.csv", "--stamp-size", CELL - 8),
)


# --- measure ----------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".fits", ".ecsv", ".parquet"])
def test_grid_to_catalog(suffix, folder, drawn):
    output = run(*GRID, "-o", f"catalog{suffix}")
    assert "measured   12 of 12 galaxies (100.00%)" in output
    assert "ms per galaxy" in output
    assert "mean shape e1 = " in output
    table = read_catalog(f"catalog{suffix}")
    assert table.colnames[:7] == ["id", "x", "y", "x_image", "y_image", "eta1", "eta2"]
    assert table["x_image"].unit == "pix"
    assert all(column.description for column in table.itercols())
    assert table["id"].tolist() == list(range(12))
    np.testing.assert_array_equal(table["x"][:4], [23.5, 71.5, 119.5, 167.5])
    np.testing.assert_allclose(table["x_image"], drawn.truth["x"], atol=0.2)
    np.testing.assert_allclose(table["y_image"], drawn.truth["y"], atol=0.2)


def test_shapes_are_true(folder, drawn):
    run(*GRID, "-o", "catalog.fits")
    table = read_catalog("catalog.fits")
    for name in ("g1", "g2"):
        assert np.max(np.abs(table[name] - drawn.truth[name])) < 0.06


@pytest.mark.parametrize("method", ["fdnt-gl", "exponential"])
def test_any_method(method, folder):
    run(*CUBE, "-o", "catalog.fits", "--method", method)
    run(*CUBE, "-o", "ft.fits")
    catalog, ft = read_catalog("catalog.fits"), read_catalog("ft.fits")
    assert catalog.meta["METHOD"] == method
    assert ft.meta["METHOD"] == "fdnt-ft"
    np.testing.assert_allclose(catalog["e1"], ft["e1"], atol=0.2)
    assert np.any(catalog["e1"] != ft["e1"])


def test_the_three_layouts_agree(folder):
    for arguments, name in ((GRID, "grid"), (CUBE, "cube"), (POSITIONS, "positions")):
        run(*arguments, "--noise-variance", 1e6, "-o", f"out-{name}.fits")
    grid, cube, cut = (read_catalog(f"out-{name}.fits") for name in ("grid", "cube", "positions"))
    np.testing.assert_allclose(grid["eta1"], cube["eta1"], atol=1e-5)  # float32 pixels
    np.testing.assert_allclose(grid["x_image"] % CELL, cube["x_image"], atol=1e-5)
    np.testing.assert_allclose(grid["x_image"], cut["x_image"], atol=0.1)
    np.testing.assert_allclose(grid["g1"], cut["g1"], atol=0.1)


@pytest.mark.parametrize("chunk", [1, 5, 12, 100])
def test_chunks_change_nothing(chunk, folder):
    run(*GRID, "-o", "whole.fits")
    run(*GRID, "-o", "chunks.fits", "--chunk", chunk)
    whole, chunks = read_catalog("whole.fits"), read_catalog("chunks.fits")
    for name in whole.colnames:
        np.testing.assert_allclose(chunks[name], whole[name], rtol=1e-9, atol=1e-9)
        assert chunks[name].description == whole[name].description


def test_provenance_is_in_the_header(folder):
    run(*GRID, "-o", "catalog.fits", "--size", 2.0)
    header = fits.getheader("catalog.fits", 1)
    assert header["FDNTVER"] == fdnt_xp.__version__
    assert header["NUMPYVER"] == header["LIBVER"] == np.__version__
    assert (header["BACKEND"], header["DEVICE"], header["DTYPE"]) == ("numpy", "cpu", "float64")
    assert (header["IMAGE"], header["PSFIMAGE"]) == ("image.fits", "psf.fits")
    assert (header["LAYOUT"], header["CELL"], header["WTSIZE"]) == ("grid", CELL, 2.0)
    assert header["NOISESRC"] == "stamp borders"
    assert header["NOISEVAR"] == pytest.approx(1e6, rel=0.05)
    run(*POSITIONS, "-o", "cut.fits", "--noise-variance", 9e5)
    header = fits.getheader("cut.fits", 1)
    assert (header["NOISEVAR"], header["NOISESRC"]) == (9e5, "given")
    assert (header["POSCAT"], header["STAMPSIZ"]) == ("positions.csv", CELL - 8)


def test_positions_that_give_no_stamp_are_flagged(folder):
    table = Table({"id": ["in", "edge", "off"], "X": [72.0, 3.0, -50.0], "Y": [72.0, 72.0, 72.0]})
    table.write("three.ecsv")
    output = run(*POSITIONS[:4], "--positions", "three.ecsv", "--stamp-size", 40, "-o", "c.fits")
    assert "measured   1 of 3" in output
    assert "EDGE: stamp cut by the edge of the image" in output
    assert "OFF_IMAGE: position not on the image" in output
    catalog = read_catalog("c.fits")
    assert catalog["id"].tolist() == ["in", "edge", "off"]
    assert catalog["flags"].tolist()[1:] == [int(Flag.EDGE), int(Flag.OFF_IMAGE)]
    for name in ("eta1", "e2", "x_image", "flux", "snr", "eta1_var"):
        assert np.isfinite(catalog[name][0])
        assert np.isnan(catalog[name][1:]).all()
    assert catalog["x"].tolist() == [72, 3, -50]


def test_fits_counting_from_one(folder, drawn):
    truth = drawn.truth
    Table({"X_IMAGE": truth["x"] + 1, "Y_IMAGE": truth["y"] + 1}).write("sex.ecsv")
    named = ("--x-column", "X_IMAGE", "--y-column", "Y_IMAGE", "--origin", 1)
    run(*POSITIONS[:4], "--positions", "sex.ecsv", "--stamp-size", 40, *named, "-o", "a.fits")
    run(*POSITIONS, "-o", "b.fits")
    first, second = read_catalog("a.fits"), read_catalog("b.fits")
    np.testing.assert_allclose(first["x"], second["x"])
    np.testing.assert_allclose(first["eta1"], second["eta1"], atol=1e-9)


def test_no_positions(folder):
    Table({"x": np.zeros(0), "y": np.zeros(0)}).write("none.ecsv")
    output = run(*POSITIONS[:4], "--positions", "none.ecsv", "--stamp-size", 40, "-o", "c.fits")
    assert "measured   0 of 0 galaxies" in output
    assert len(read_catalog("c.fits")) == 0
    run("plot", "c.fits")


def test_a_psf_for_each_galaxy(folder, drawn):
    fits.PrimaryHDU(np.repeat(drawn.psf_image[None], 12, axis=0)).writeto("psfs.fits")
    run(*GRID, "-o", "one.fits", "--noise-variance", 1e6)
    each = ("measure", "image.fits", "--psf", "psfs.fits", "--cell", CELL, "--chunk", 5)
    run(*each, "--noise-variance", 1e6, "-o", "each.fits")
    one, many = read_catalog("one.fits"), read_catalog("each.fits")
    np.testing.assert_allclose(many["eta1"], one["eta1"], atol=1e-9)


def test_quiet(folder):
    assert run(*GRID, "-o", "catalog.fits", "--quiet") == ""


def test_backgrounds_are_warned_of(folder, drawn):
    fits.PrimaryHDU(drawn.image + 500).writeto("sky.fits")
    output = run("measure", "sky.fits", "--psf", "psf.fits", "--cell", CELL, "-o", "c.fits")
    assert "Warning: the borders of the stamps are not at zero but at 5" in output


# --- bad input --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("no.fits", "--psf", "psf.fits", "--cell", 48), "no.fits does not exist"),
        (("image.fits", "--psf", "no.fits", "--cell", 48), "cannot read the PSF image: no.fits"),
        (("image.fits", "--psf", "psf.fits", "--cell", 50), "not a whole number of cells of 50"),
        (("image.fits", "--psf", "psf.fits"), "say where its galaxies are, by --cell"),
        (("cube.fits", "--psf", "psf.fits", "--cell", 48), "has 3 axes"),
        (
            ("image.fits", "--psf", "psf.fits", "--cell", 48, "--positions", "positions.csv"),
            "not both",
        ),
        (("image.fits", "--psf", "psf.fits", "--positions", "positions.csv"), "go together"),
        (
            ("image.fits", "--psf", "psf.fits", "--positions", "no.csv", "--stamp-size", 40),
            "no.csv does not exist",
        ),
        (("image.fits", "--psf", "cube2.fits", "--cell", 48), "2 PSF images but 12 galaxies"),
        (("cut.fits", "--psf", "psf.fits", "--cell", 48), "cut.fits: it is truncated"),
        (("image.fits", "--psf", "psf.fits", "--cell", 48, "--noise-variance", -1), "= -1"),
        (("image.fits", "--psf", "psf.fits", "--cell", 48, "--device", "cuda"), "cpu only"),
        (("image.fits", "--psf", "psf.fits", "--cell", 48, "--method", "no"), "fdnt-gl"),
        (
            ("cube.fits", "--psf", "psf.fits", "--method", "fdnt-gl", "--responses"),
            "not --responses",
        ),
    ],
)
def test_what_cannot_be_measured(arguments, message, folder, drawn):
    fits.PrimaryHDU(np.repeat(drawn.psf_image[None], 2, axis=0)).writeto("cube2.fits")
    content = (folder / "image.fits").read_bytes()
    (folder / "cut.fits").write_bytes(content[: len(content) // 2])
    before = sorted(folder.iterdir())
    output = run("measure", *arguments, "-o", "catalog.fits", code=1)
    assert output.startswith("Error: ")
    assert message in output
    assert output.count("\n") == 1
    assert sorted(folder.iterdir()) == before


@pytest.mark.parametrize(
    ("output", "message"),
    [
        ("no/catalog.fits", "no does not exist"),
        ("psf.fits/catalog.fits", "psf.fits is not a folder"),
        ("old.fits", "old.fits exists"),
        ("psf.fits", "psf.fits is an input"),
        ("catalog.txt", "known are .fits"),
    ],
)
def test_outputs_are_refused_before_any_work(output, message, folder, monkeypatch):
    monkeypatch.setattr(measure_run, "measure_rows", pytest.fail)
    (folder / "old.fits").write_text("old")
    assert message in run(*GRID, "-o", output, code=1)
    assert (folder / "old.fits").read_text() == "old"


def test_an_input_is_never_overwritten(folder):
    assert "is an input" in run(*GRID, "-o", "./image.fits", "--overwrite", code=1)
    assert fits.getdata("image.fits").ndim == 2


def test_overwrite(folder):
    (folder / "catalog.fits").write_text("old")
    run(*GRID, "-o", "catalog.fits", "--overwrite")
    assert len(read_catalog("catalog.fits")) == 12


def test_usage_errors_are_clicks(folder):
    assert "Missing option '--psf'" in run("measure", "image.fits", "-o", "c.fits", code=2)
    assert "Invalid value" in run(*GRID, "-o", "c.fits", "--backend", "fortran", code=2)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_leaves_nothing_and_says_so(number, folder, monkeypatch):
    def interrupt(*_, **__):
        signal.raise_signal(number)

    before = sorted(folder.iterdir())
    monkeypatch.setattr(measure_run, "measure_rows", interrupt)
    output = run(*GRID, "-o", "catalog.fits", code=130)
    assert output == "Interrupted: nothing unfinished was left behind.\n"
    assert sorted(folder.iterdir()) == before


def test_no_more_memory_is_one_line(folder, monkeypatch):
    def no_room(*_, **__):
        raise MemoryError("Unable to allocate 417. GiB")

    monkeypatch.setattr(measure_run, "measure_rows", no_room)
    said = run(*GRID, "-o", "catalog.fits", code=1)
    assert said == "Error: out of memory: Unable to allocate 417. GiB\n"


# --- backends ---------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("library", [name for name in ("torch", "jax") if name in TESTED])
def test_backends_agree(library, dtype, folder):
    run_apart(*GRID, "-o", "a.fits", "--backend", library, "--dtype", dtype)
    run(*GRID, "-o", "b.fits")
    header = fits.getheader("a.fits", 1)
    assert (header["BACKEND"], header["DTYPE"]) == (library, dtype)
    tolerance = 1e-8 if dtype == "float64" else 1e-3
    first, second = read_catalog("a.fits"), read_catalog("b.fits")
    np.testing.assert_allclose(first["eta1"], second["eta1"], atol=tolerance)


def run_apart(*arguments):
    """Run the command in a process of its own: it may change the settings of a library."""
    command = [sys.executable, "-c", "from fdnt_xp.app.cli import main; main()"]
    done = subprocess.run([*command, *map(str, arguments)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("library", ["torch", "jax", "cupy"])
def test_a_missing_library_names_the_remedy(library, monkeypatch):
    monkeypatch.setitem(sys.modules, library, None)
    remedy = "cupy-cuda" if library == "cupy" else rf"fdnt-xp\[{library}\]"
    with pytest.raises(MissingExtraError, match=rf"{library} is not installed: .*{remedy}"):
        load_backend(library)


def test_devices_that_are_not_there():
    torch = pytest.importorskip("torch")
    if not torch.cuda.is_available():
        with pytest.raises(FdntValueError, match="no CUDA device"):
            load_backend("torch", "cuda")
    with pytest.raises(FdntValueError, match="torch cannot use the device 'moon'"):
        load_backend("torch", "moon")
    if importlib.util.find_spec("jax"):
        with pytest.raises(FdntValueError, match="jax cannot use the device 'moon'"):
            load_backend("jax", "moon", "float32")


def test_unknown_names():
    with pytest.raises(FdntValueError, match="known are numpy, torch, jax, cupy"):
        load_backend("fortran")
    with pytest.raises(FdntValueError, match="known are float64, float32"):
        load_backend("numpy", dtype="float16")


def test_arrays_are_copies_in_the_right_precision():
    host = np.arange(4, dtype=">f8")
    for library in ("numpy", *(["torch"] if importlib.util.find_spec("torch") else [])):
        array = load_backend(library, dtype="float32").from_numpy(host)
        assert str(array.dtype).endswith("float32")
        array[0] = 9
        assert host[0] == 0


# --- noise and PSFs, beneath the command line -------------------------------------------


def test_noise_given_or_found():
    source = cube_stamps(2.0 * np.random.default_rng(1).standard_normal((50, 32, 32)))
    assert find_noise(source, 5.0).variance == 5.0
    assert find_noise(source, 5.0).border is None
    assert find_noise(source).variance == pytest.approx(4.0, rel=0.05)
    for bad in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(RangeError, match="noise_variance"):
            find_noise(source, bad)
    with pytest.warns(FdntWarning, match="no noise can be measured"):
        assert find_noise(cube_stamps(np.zeros((2, 32, 32)))).variance is None


def test_psfs_must_fit_the_galaxies():
    source = cube_stamps(np.zeros((3, 32, 32)))
    with pytest.raises(ShapeMismatchError, match="2 PSF images but 3 galaxies"):
        measure_source(source, np.ones((2, 32, 32)), backend=load_backend(), noise_variance=None)


# --- plot and demo ----------------------------------------------------------------------


def test_plot(folder):
    pytest.importorskip("matplotlib")
    run(*GRID, "-o", "catalog.fits")
    assert "catalog.png" in run("plot", "catalog.fits")
    assert (folder / "catalog.png").read_bytes().startswith(b"\x89PNG")
    assert "exists" in run("plot", "catalog.fits", code=1)
    run("plot", "catalog.fits", "--overwrite")
    run("plot", "catalog.fits", "-o", "page.pdf")
    assert "does not exist" in run("plot", "no.fits", code=1)
    assert "known figure format" in run("plot", "catalog.fits", "-o", "page.doc", code=1)


def test_plot_of_another_table(folder):
    write_catalog(Table({"a": [1.0]}), "other.fits")
    assert "no column x, y" in run("plot", "other.fits", code=1)


DEMO = ("demo", "-o", "show", "--n-side", 6, "--cell", 48)
WRITTEN = ["catalog.fits", "catalog.png", "image.fits", "psf.fits", "truth.ecsv"]


def test_demo(folder):
    pytest.importorskip("matplotlib")
    output = run(*DEMO, "--shear", 0.02, -0.01)
    assert sorted(file.name for file in (folder / "show").iterdir()) == WRITTEN
    assert "36 galaxies" in output
    assert "truth +0.0200" in output
    assert "truth -0.0100" in output
    for line in output.splitlines():
        if "sigma" in line:
            assert abs(float(line.split()[-2])) < 4
    truth = read_catalog("show/truth.ecsv")
    assert (truth.meta["SHEAR1"], truth.meta["SHEAR2"], truth.meta["SEED"]) == (0.02, -0.01, 1)
    assert len(read_catalog("show/catalog.fits")) == len(truth) == 36
    before = (folder / "show" / "catalog.fits").read_bytes()
    assert "exists" in run(*DEMO, code=1)
    assert (folder / "show" / "catalog.fits").read_bytes() == before
    run(*DEMO, "--overwrite", "--random-shear", "--noise-free", "--quiet")
    shear = read_catalog("show/truth.ecsv").meta
    assert max(abs(shear["SHEAR1"]), abs(shear["SHEAR2"])) <= 0.03


def test_pairs_cancel_their_own_shapes():
    """Shapes of thirty pairs, known but for a small noise, with one galaxy missing."""
    rng = np.random.default_rng(1)
    shapes, noise = rng.normal(size=(30, 2)), 0.01 * rng.normal(size=(60, 2))
    eta = np.concatenate([shapes, -shapes]) + noise
    table = Table({"eta1": eta[:, 0], "eta2": eta[:, 1], "flags": np.zeros(60, dtype="i4")})
    table["flags"][3] = int(Flag.NO_SIGNAL)
    pairs = np.tile(np.arange(30), 2)

    def errors(lines):
        return [float(line.split("±")[1].split()[0]) for line in lines]

    alone, paired = errors(shear_lines(table, None)), errors(shear_lines(table, None, pairs))
    assert all(0.003 < p / a < 0.03 for p, a in zip(paired, alone, strict=True))


def test_demo_of_the_users_own_image(folder):
    pytest.importorskip("matplotlib")
    output = run("demo", "-o", "mine", "--image", "image.fits", "--psf", "psf.fits", "--cell", 48)
    assert sorted(file.name for file in (folder / "mine").iterdir()) == WRITTEN[:2]
    assert "12 of 12" in output
    assert "truth" not in output
    assert "go together" in run("demo", "--image", "image.fits", code=2)


def test_version_and_help():
    assert run("--version") == f"fdnt-xp, version {fdnt_xp.__version__}\n"
    for command in ((), ("measure",), ("plot",), ("demo",)):
        assert "Usage: " in run(*command, "--help")


def test_warnings_of_other_libraries_are_not_shown(folder, monkeypatch):
    def warn(*_, **__):
        warnings.warn("inner workings", RuntimeWarning, stacklevel=1)
        warnings.warn("about a galaxy", FdntWarning, stacklevel=1)
        raise FdntValueError("the end")

    monkeypatch.setattr(measure_run, "measure_rows", warn)
    with warnings.catch_warnings():
        warnings.simplefilter("default")
        output = run(*GRID, "-o", "catalog.fits", code=1)
    assert output == "Warning: about a galaxy\nError: the end\n"
