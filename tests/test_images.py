"""FITS images come in whatever way a file holds them; a broken file says what is wrong."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.io import fits

from fdnt_xp.data.images import native_pixels, read_image, write_image
from fdnt_xp.errors import CatalogError


@pytest.fixture
def pixels():
    return np.random.default_rng(1).normal(scale=100, size=(40, 60)).astype("float32")


@pytest.fixture
def file(tmp_path, pixels):
    path = tmp_path / "image.fits"
    write_image(pixels, path, cell=20)
    return path


def test_round_trip(file, pixels):
    read = read_image(file)
    assert read.shape == (40, 60)
    np.testing.assert_array_equal(read, pixels)
    assert fits.getheader(file)["CELL"] == 20


def test_pixels_are_mapped_not_loaded(file):
    base = read_image(file)
    while isinstance(base, np.ndarray) and base.base is not None:
        base = base.base
    assert not isinstance(base, np.ndarray)


@pytest.mark.parametrize("dtype", ["u1", "i2", "u2", "i4", "f4", "f8"])
def test_every_type_of_pixel(dtype, pixels, tmp_path):
    stored = (np.abs(pixels) % 100).astype(dtype)
    fits.PrimaryHDU(stored).writeto(tmp_path / "image.fits")
    native = native_pixels(read_image(tmp_path / "image.fits"))
    np.testing.assert_array_equal(native, stored)
    assert native.dtype == ("float32" if dtype == "f4" else "float64")
    assert native.dtype.isnative
    assert native.flags.c_contiguous
    assert native.flags.writeable


def test_negative_strides_and_foreign_order_become_native(pixels):
    native = native_pixels(pixels[::-1, ::2].astype(">f8"))
    np.testing.assert_array_equal(native, pixels[::-1, ::2])
    assert native.flags.c_contiguous


@pytest.mark.parametrize("suffix", ["", "[SCI]", "[sci]", "[1]"])
def test_the_first_image_or_the_one_named(suffix, pixels, tmp_path):
    path = tmp_path / "image.fits"
    table = fits.BinTableHDU.from_columns([fits.Column("a", "D", array=[1.0])])
    science = fits.ImageHDU(pixels, name="SCI")
    fits.HDUList([fits.PrimaryHDU(), science, table, fits.ImageHDU(-pixels)]).writeto(path)
    np.testing.assert_array_equal(read_image(f"{path}{suffix}"), pixels)
    np.testing.assert_array_equal(read_image(f"{path}[3]"), -pixels)


def test_compressed_images(pixels, tmp_path):
    path = tmp_path / "image.fits.gz"
    fits.PrimaryHDU(pixels).writeto(path)
    np.testing.assert_array_equal(read_image(path), pixels)
    tiled = fits.CompImageHDU(pixels.round().astype("i4"))
    fits.HDUList([fits.PrimaryHDU(), tiled]).writeto(tmp_path / "tiled.fits")
    np.testing.assert_array_equal(read_image(tmp_path / "tiled.fits"), pixels.round())


def test_missing_file(tmp_path):
    with pytest.raises(CatalogError, match=r"cannot read the PSF image: .*no\.fits does not exist"):
        read_image(tmp_path / "no.fits", what="PSF image")
    with pytest.raises(CatalogError, match="is a folder"):
        read_image(tmp_path)


@pytest.mark.parametrize("extension", ["[9]", "[NOPE]"])
def test_missing_extension(extension, file):
    with pytest.raises(CatalogError, match=r"has no extension .*it has 0 PRIMARY"):
        read_image(f"{file}{extension}")


@pytest.mark.parametrize("fraction", [0.3, 0.5, 0.9, 0.999])
def test_truncated_file(fraction, file):
    content = file.read_bytes()
    file.write_bytes(content[: int(fraction * len(content))])
    with pytest.raises(CatalogError, match=r"image\.fits: it is truncated"):
        read_image(file)


@pytest.mark.parametrize("fraction", [0.2, 0.6, 0.95])
def test_truncated_compressed_file(fraction, pixels, tmp_path):
    path = tmp_path / "image.fits.gz"
    fits.PrimaryHDU(pixels).writeto(path)
    content = path.read_bytes()
    path.write_bytes(content[: int(fraction * len(content))])
    with pytest.raises(CatalogError, match=r"cannot read the image .*image\.fits\.gz"):
        read_image(path)


@pytest.mark.parametrize("content", [b"", b"text, not pixels\n" * 500, bytes(range(256)) * 40])
def test_not_fits(content, tmp_path):
    path = tmp_path / "image.fits"
    path.write_bytes(content)
    with pytest.raises(CatalogError, match=r"cannot read the image .*image\.fits: "):
        read_image(path)


def test_no_image_in_the_file(tmp_path):
    fits.PrimaryHDU().writeto(tmp_path / "empty.fits")
    with pytest.raises(CatalogError, match="holds no image"):
        read_image(tmp_path / "empty.fits")


@pytest.mark.parametrize(
    ("ndim", "expected"),
    [((3,), r"expected a cube \(n, ny, nx\)"), ((1,), "expected rank 1")],
)
def test_wrong_rank(ndim, expected, file):
    with pytest.raises(CatalogError, match=rf"2 axes, shape \(40, 60\); {expected}"):
        read_image(file, ndim=ndim)


def test_an_image_is_not_overwritten_by_accident(file, pixels):
    before = file.read_bytes()
    with pytest.raises(CatalogError, match="exists"):
        write_image(-pixels, file)
    assert file.read_bytes() == before
    write_image(-pixels, file, overwrite=True)
    np.testing.assert_array_equal(read_image(file), -pixels)
