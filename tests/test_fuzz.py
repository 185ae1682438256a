"""Malformed arrays and files: a clear error or flags, never a traceback nor half an output."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from damage import damaged, damaged_bytes, refused_or_done
from hypothesis import given, settings
from hypothesis import strategies as st

import fdnt_xp as fx
from fdnt_xp.errors import FdntError
from fdnt_xp.flags import FAILED
from images import galaxies, star

SIDE = 16
N_GAL = 3
STAR = star((SIDE, SIDE))
GALAXIES = galaxies(np.array([[0.1, 0.2], [-0.3, 0.0], [0.0, 0.1]]), (SIDE, SIDE), sigma=1.5)

# --- arrays -------------------------------------------------------------------------------

_NUMBERS = st.sampled_from([0, -1, 1, 2, 0.5, 3.7, 2.0, np.nan, np.inf, 1e300, 1e-300, "a", 10**9])


@st.composite
def calls(draw):
    """Return a PSF, stamps and options."""
    each = np.repeat(STAR[None], N_GAL, axis=0)
    image = draw(damaged(STAR if draw(st.booleans()) else each))
    options = {}
    match draw(st.sampled_from(["", "variance", "number", "ivar"])):
        case "variance":
            options["noise_variance"] = draw(damaged(np.full(N_GAL, 1e-6)))
        case "number":
            options["noise_variance"] = draw(_NUMBERS)
        case "ivar":
            ivar = np.full(GALAXIES.shape, 1e6)
            ivar[0, 5, 5:7] = 0.0
            options["ivar"] = draw(damaged(ivar))
    if draw(st.booleans()):
        matrix = np.array([[0.2, 0.01], [0.0, 0.2]])
        matrices = np.repeat(matrix[None], N_GAL, axis=0)
        options["jacobian"] = draw(damaged(matrix if draw(st.booleans()) else matrices))
    options["transform"] = draw(st.sampled_from(["ft", "ft", "gl", "hybrid", "no"]))
    options["order"] = 4
    for name in ("size", "padding", "chunk_size", "max_iter", "order"):
        if draw(st.integers(0, 5)) == 0:
            options[name] = draw(_NUMBERS)
    if options.get("padding") == 10**9:
        del options["padding"]  # it asks for that much memory
    return image, draw(damaged(GALAXIES)), options


def measured_or_refused(image, stamps, options):
    """Return a result, or None if the call was refused in our words."""
    try:
        psf = fx.Psf.from_image(image)
        return fx.measure_shapes(stamps, psf, **options)
    except FdntError:
        return None


@settings(max_examples=60)
@given(calls())
@pytest.mark.filterwarnings("ignore::RuntimeWarning", "ignore::fdnt_xp.errors.FdntWarning")
def test_arrays_are_measured_or_refused(call):
    """Overflow of absurd numbers may be warned of by NumPy; it must be flagged by us."""
    result = measured_or_refused(*call)
    if result is None:
        return
    failed = (result.flags & int(FAILED)) != 0
    for name in ("eta", "eg", "centroid", "size", "flux"):
        column = getattr(result, name)
        numbers = np.isfinite(column).all(axis=tuple(range(1, column.ndim)))
        np.testing.assert_array_equal(numbers, ~failed, err_msg=name)
    for name in ("eta_cov", "snr"):
        assert np.isnan(getattr(result, name)[failed]).all()


@settings(max_examples=15)
@given(damaged(GALAXIES), st.integers(0, N_GAL - 1))
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_a_damaged_stamp_changes_no_other(stamps, place):
    if stamps.shape != GALAXIES.shape or stamps.dtype != np.float64:
        return
    psf = fx.Psf.from_image(STAR)
    mixed = GALAXIES.copy()
    mixed[place] = stamps[place]
    others = np.arange(N_GAL) != place
    result, clean = (fx.measure_shapes(s, psf, noise_variance=1e-6) for s in (mixed, GALAXIES))
    np.testing.assert_allclose(result.eta[others], clean.eta[others], atol=1e-10)
    np.testing.assert_array_equal(result.flags[others], clean.flags[others])


# --- files --------------------------------------------------------------------------------

CUBE = ("measure", "cube.fits", "--psf", "psf.fits", "-o", "out.fits", "--noise-variance", "1e-6")
AROUND = (
    *("measure", "image.fits", "--psf", "psf.fits", "-o", "out.fits", "--noise-variance", "1e-6"),
    *("--positions", "positions.csv", "--stamp-size", "12"),
)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A working directory with files that can be measured."""
    monkeypatch.chdir(tmp_path)
    write_inputs()
    return tmp_path


def write_inputs():
    for file in Path().iterdir():
        file.unlink()
    fits.PrimaryHDU(GALAXIES).writeto("cube.fits")
    fits.PrimaryHDU(STAR).writeto("psf.fits")
    fits.PrimaryHDU(GALAXIES.reshape(-1, SIDE)).writeto("image.fits")
    Path("positions.csv").write_text("id,x,y\n1,7.5,7.5\n2,8.0,23.0\n")


@settings(max_examples=40)
@given(st.data())
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_damaged_files_are_refused_or_measured(folder, data):
    write_inputs()
    command = data.draw(st.sampled_from([CUBE, AROUND]))
    names = [name for name in command if str(name).endswith((".fits", ".csv")) and name[0] != "o"]
    name = Path(data.draw(st.sampled_from(names)))
    name.write_bytes(data.draw(damaged_bytes(name.read_bytes())))
    options = data.draw(
        st.sampled_from([(), ("--mask", name), ("--weight", name), ("--noise-image", name)])
    )
    refused_or_done([*command, *options])


def table_hdu(n):
    return fits.BinTableHDU(Table({"x": np.arange(n) + 7.0, "y": np.arange(n) + 7.0}))


OTHERS = {
    "table for an image": lambda: fits.HDUList([fits.PrimaryHDU(), table_hdu(3)]),
    "nothing": lambda: fits.HDUList([fits.PrimaryHDU()]),
    "empty table": lambda: fits.HDUList([fits.PrimaryHDU(), table_hdu(0)]),
    "one axis": lambda: fits.HDUList([fits.PrimaryHDU(np.ones(7))]),
    "four axes": lambda: fits.HDUList([fits.PrimaryHDU(np.ones((2, 2, 8, 8)))]),
    "a single pixel": lambda: fits.HDUList([fits.PrimaryHDU(np.ones((1, 1)))]),
    "all NaN": lambda: fits.HDUList([fits.PrimaryHDU(np.full((SIDE, SIDE), np.nan))]),
    "all zero": lambda: fits.HDUList([fits.PrimaryHDU(np.zeros((SIDE, SIDE), dtype="i2"))]),
    "flat cube": lambda: fits.HDUList([fits.PrimaryHDU(np.ones((N_GAL, 2, 2)))]),
}


NO_IMAGE = ("table for an image", "nothing", "empty table", "one axis", "four axes")


@pytest.mark.parametrize("what", OTHERS)
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_other_kinds_of_fits_files(what, folder):
    for option in ("IMAGE", "--psf", "--positions", "--mask", "--weight", "--noise-image"):
        OTHERS[what]().writeto("other.fits", overwrite=True)
        command = [str(word) for word in (CUBE if option != "--positions" else AROUND)]
        if option == "IMAGE":
            command[1] = "other.fits"
        elif option in command:
            command[command.index(option) + 1] = "other.fits"
        else:
            command += [option, "other.fits"]
        no_image = what in NO_IMAGE and option != "--positions"
        refused_or_done(command, refused=True if no_image else None)
        Path("out.fits").unlink(missing_ok=True)


@pytest.mark.parametrize(
    "content",
    [
        "x,y\n",
        "a,b\n1,2\n",
        "x,y\n1\n",
        "x,y\nred,blue\n",
        "x,y\nnan,inf\n",
        "x,y\n-1e300,1e300\n",
        "id,x,y\n,7,7\n\xe9\xe8,8,8\n",
        "x,y,x\n1,2,3\n",
        "# %ECSV 1.0\n# ---\n# datatype:\n# - {name: x, datatype: complex128}\nx y\n1 2\n",
        "\n",
    ],
)
def test_odd_tables_of_positions(content, folder):
    Path("positions.csv").write_text(content, encoding="utf-8")
    refused_or_done(AROUND)


_WORDS = ["0", "-1", "-5", "1e9", "nan", "inf", "x", "", "7", "cube.fits", "nowhere.fits", "."]
_OPTIONS = [
    *("--cell", "--stamp-size", "--x-column", "--origin", "--method", "--seed", "--device"),
    *("--noise-variance", "--size", "--chunk", "--oversampling", "--jobs", "--dtype"),
    *("--mask", "--weight", "--noise-image", "--positions", "--psf", "-o", "--backend"),
]


@settings(max_examples=40)
@given(st.lists(st.tuples(st.sampled_from(_OPTIONS), st.sampled_from(_WORDS)), max_size=3))
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_odd_options_are_refused_or_measured(folder, options):
    for name in ("out.fits", "nowhere.fits"):
        Path(name).unlink(missing_ok=True)
    if any(option == ("--jobs", "7") for option in options):
        return  # it is right, and slow
    refused_or_done([*CUBE, *(word for option in options for word in option)])


@settings(max_examples=25)
@given(st.data())
def test_damaged_catalogs(folder, data):
    """`shear` and `plot` read what someone may have touched."""
    suffix = data.draw(st.sampled_from([".fits", ".ecsv"]))
    name = Path(f"touched{suffix}")
    table = Table({"x": [1.0], "y": [2.0], "flags": [0], "e1": [0.1], "e2": [0.2]})
    table.write(name, overwrite=True)
    name.write_bytes(data.draw(damaged_bytes(name.read_bytes())))
    refused_or_done(["shear", name], refused=True)
    name.unlink()
