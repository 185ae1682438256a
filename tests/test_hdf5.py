"""HDF5 in place of FITS: the same pixels and the same catalogs, read a part at a time."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from astropy.io import fits
from click.testing import CliRunner

from fdnt_xp.app.cli import main
from fdnt_xp.data.catalog import read_catalog
from fdnt_xp.data.hdf5 import open_hdf5
from fdnt_xp.data.images import native_pixels, read_image
from fdnt_xp.data.stamps import cube_stamps
from fdnt_xp.data.tables import read_positions
from fdnt_xp.errors import CatalogError
from images import galaxies, star

h5py = pytest.importorskip("h5py")

CELL = 40
SIGMA = 2e-5
E = np.array([[0.0, 0.0], [0.3, 0.1], [-0.2, 0.45], [0.05, -0.6]])


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The same cube, image, PSF, mask and weight as FITS and in one HDF5 file."""
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(5)
    cube = galaxies(E, (CELL, CELL)) + SIGMA * rng.standard_normal((4, CELL, CELL))
    mask = np.zeros(cube.shape, dtype=np.uint8)
    mask[1, 5, 7] = 2
    whole = cube.reshape(2, 2, CELL, CELL).transpose(0, 2, 1, 3).reshape(2 * CELL, -1)
    ivar = np.where(mask > 0, 0.0, SIGMA**-2)
    pixels = {"stamps": cube, "image": whole, "psf": star(), "mask": mask, "ivar": ivar}
    with h5py.File("all.h5", "w") as file:
        for name, values in pixels.items():
            fits.PrimaryHDU(values).writeto(f"{name}.fits")
            file.create_dataset(f"data/{name}", data=values, compression="gzip")
    with h5py.File("one.hdf5", "w") as file:
        file["deep/inside/stamps"] = cube.astype(">f4")
    return tmp_path


def run(*arguments, code=0):
    result = CliRunner().invoke(main, ["measure", *(str(argument) for argument in arguments)])
    assert result.exit_code == code, result.output
    assert "Traceback" not in result.output
    return result.output


def catalog(*arguments):
    run(*arguments, "-o", "out.fits", "--overwrite", "--quiet")
    return read_catalog("out.fits")


def test_pixels_are_those_written(folder):
    cube = fits.getdata("stamps.fits")
    stored = read_image("all.h5::data/stamps", ndim=(3,))
    assert (stored.shape, stored.ndim, stored.size, len(stored)) == (cube.shape, 3, cube.size, 4)
    np.testing.assert_array_equal(native_pixels(stored), cube)
    np.testing.assert_array_equal(stored[1:3, 4], cube[1:3, 4])
    alone = native_pixels(read_image("one.hdf5", ndim=(3,)))
    assert alone.dtype == np.float32
    assert alone.dtype.isnative
    np.testing.assert_array_equal(alone, cube.astype("f4"))


def test_a_chunk_of_a_cube_reads_that_chunk_alone(tmp_path):
    # A quarter of a terabyte of zeros that no disk holds: HDF5 does not store what was never
    # written, and reading it whole would fail.
    with h5py.File(tmp_path / "huge.h5", "w") as file:
        huge = file.create_dataset("x", (2**23, 64, 64), dtype="f8", chunks=(1, 64, 64))
        huge[2**22] = 1.0
    source = cube_stamps(read_image(tmp_path / "huge.h5", ndim=(3,)))
    part = source.read(2**22 - 1, 2**22 + 2).stamps
    np.testing.assert_array_equal(part[:, 0, 0], [0.0, 1.0, 0.0])


def test_other_processes_open_the_file_for_themselves(folder):
    stored = open_hdf5("all.h5::data/stamps")
    first = stored[0]
    again = pickle.loads(pickle.dumps(stored))
    np.testing.assert_array_equal(again[0], first)
    stored._opened = (-1, None)  # as after a fork
    np.testing.assert_array_equal(stored[0], first)


@pytest.mark.parametrize("chunk", [3, 100])
def test_the_catalog_is_that_of_the_fits_files(chunk, folder):
    def arguments(form, *names):
        return [form.format(name) for name in names]

    options = ("--method", "fdnt-gl", "--chunk", chunk)
    tables = []
    for form in ("{}.fits", "all.h5::data/{}"):
        cube, image, psf, mask, ivar = arguments(form, "stamps", "image", "psf", "mask", "ivar")
        masks = ("--mask", mask, "--weight", ivar)
        tables += [
            catalog(cube, "--psf", psf, *masks, *options),
            catalog(image, "--psf", psf, "--cell", CELL, "--noise-variance", SIGMA**2, *options),
        ]
    for ours, expected in zip(tables[2:], tables[:2], strict=True):
        assert np.all(np.isfinite(expected["eta1"]))
        for name in ("id", "x_image", "eta1", "eta2", "eta1_var", "snr", "masked_fraction"):
            np.testing.assert_array_equal(ours[name], expected[name])
    assert tables[2].meta["IMAGE"] == "all.h5::data/stamps"


def test_a_noise_image(folder):
    rng = np.random.default_rng(2)
    with h5py.File("sky.h5", "w") as file:
        file["blank"] = SIGMA * rng.standard_normal((6 * CELL, 5 * CELL))
    table = catalog("stamps.fits", "--psf", "psf.fits", "--noise-image", "sky.h5")
    assert table.meta["NOISEVAR"] == pytest.approx(SIGMA**2, rel=0.05)


def test_positions_of_records_and_of_columns(tmp_path):
    x, y = np.array([3.0, 4.5, 7.25]), np.array([1.0, 2.0, 3.0])
    records = np.zeros(3, dtype=[("X", "f4"), ("Y", "f4"), ("id", "S3")])
    records["X"], records["Y"], records["id"] = x, y, [b"a", b"bc", b"d"]
    with h5py.File(tmp_path / "table.h5", "w") as file:
        file["records"] = records
        file["photometry/x"], file["photometry/y"], file["photometry/id"] = x, y, [7, 8, 9]
        file["photometry/about/version"] = 1
    with h5py.File(tmp_path / "columns.hdf5", "w") as file:
        file["x"], file["y"] = x + 1, y + 1
    with h5py.File(tmp_path / "single.hdf5", "w") as file:
        file["deep/records"] = records
    named = read_positions(tmp_path / "table.h5::records")
    assert named.ids.tolist() == ["a", "bc", "d"]
    numbered = read_positions(f"{tmp_path / 'table.h5'}::photometry")
    assert numbered.ids.tolist() == [7, 8, 9]
    plain = read_positions(tmp_path / "columns.hdf5", origin=1)
    for table in (named, numbered, plain, read_positions(tmp_path / "single.hdf5")):
        np.testing.assert_array_equal(table.xy, np.stack([x, y], axis=-1))


@pytest.mark.parametrize(
    ("image", "message"),
    [
        ("no.h5", "cannot read the image: no.h5 does not exist"),
        ("all.h5", "all.h5 holds data/image, data/ivar, data/mask, data/psf, data/stamps; say"),
        ("all.h5::stamps", "has no dataset 'stamps'; it has data/image, data/ivar, data/mask"),
        ("all.h5::data", "has no dataset 'data'"),
        ("all.h5::data/image", "is one image of 80 x 80 pixels: say where its galaxies are"),
        ("text.h5", "cannot read the image text.h5: "),
        ("half.h5", "cannot read the image half.h5: "),
        ("words.h5", "the dataset 'a' of words.h5 is no image: it holds object, not numbers"),
        ("scalar.h5", "has 0 axes"),
        ("empty.h5", "empty.h5 holds no dataset"),
    ],
)
def test_what_is_refused(image, message, folder):
    (folder / "text.h5").write_text("not HDF5\n" * 300)
    (folder / "half.h5").write_bytes((folder / "all.h5").read_bytes()[:3000])
    for name, content in (("words", ["x", "y"]), ("scalar", 1.0), ("empty", None)):
        with h5py.File(f"{name}.h5", "w") as file:
            if content is not None:
                file["a"] = content
    said = run(image, "--psf", "psf.fits", "-o", "c.fits", code=1)
    assert said.startswith("Error: ")
    assert message in said
    assert said.count("\n") == 1
    assert not (folder / "c.fits").exists()


def test_maps_and_tables_that_do_not_fit(folder):
    cube = ("stamps.fits", "--psf", "psf.fits", "-o", "c.fits")
    assert "the mask has the shape" in run(*cube, "--mask", "all.h5::data/image", code=1)
    for name, reason in (("::data/none", "has no 'data/none'"), ("", "is no table")):
        with pytest.raises(CatalogError, match=reason):
            read_positions(f"all.h5{name}")
    with h5py.File("a.h5", "w") as file:
        file["a"] = [1.0, 2.0]
    with pytest.raises(CatalogError, match="has no column 'x'; it has a"):
        read_positions("a.h5")
