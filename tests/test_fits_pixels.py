"""Large FITS images stay on disk, packed ones too, and are what astropy reads of them."""

from __future__ import annotations

import pickle
import sys
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

from fdnt_xp.data import fits_pixels
from fdnt_xp.data.fits_pixels import FitsSections, let_go
from fdnt_xp.data.images import read_image
from fdnt_xp.data.stamps import cube_stamps, grid_stamps

SHAPES = {"image": (96, 64), "cube": (60, 16, 8)}


@pytest.fixture(params=["scaled", "compressed", "unsigned"])
def packed(request, tmp_path, monkeypatch):
    """Return what writes whole numbers that cannot be mapped, and has them read in sections."""
    monkeypatch.setattr(fits_pixels, "IN_MEMORY", 1000)
    monkeypatch.setattr(fits_pixels, "_READ_AHEAD", 3000)

    def write(shape):
        pixels = np.random.default_rng(1).integers(0, 60000, shape).astype("u2")
        hdu = fits.ImageHDU(pixels)
        if request.param == "scaled":
            hdu = fits.ImageHDU((pixels // 2).astype("i2"))
            hdu.scale("int16", bscale=0.5, bzero=3)
        if request.param == "compressed":
            hdu = fits.CompImageHDU(pixels.astype("f4"), quantize_level=0)
        path = tmp_path / f"{request.param}.fits"
        fits.HDUList([fits.PrimaryHDU(), hdu]).writeto(path)
        return path, fits.getdata(path)

    return write


@pytest.mark.parametrize("kind", SHAPES)
def test_sections_are_the_pixels(kind, packed):
    path, whole = packed(SHAPES[kind])
    pixels = read_image(path, ndim=(2, 3))
    assert isinstance(pixels, FitsSections)
    assert (pixels.shape, pixels.ndim, pixels.size) == (whole.shape, whole.ndim, whole.size)
    assert (len(pixels), pixels.dtype) == (len(whole), whole.dtype)
    elsewhere = pickle.loads(pickle.dumps(pixels))
    some = [0, -1, 5, slice(3, 40), slice(7), slice(80, None, 3), slice(50, 50)]
    for key in [*some, *((rows, slice(2, 7)) for rows in some)]:
        np.testing.assert_array_equal(pixels[key], whole[key])
        np.testing.assert_array_equal(elsewhere[key], whole[key])
    np.testing.assert_array_equal(np.asarray(pixels), whole)
    with pytest.raises(IndexError):
        pixels[len(whole)]


@pytest.mark.parametrize("kind", SHAPES)
def test_stamps_of_sections(kind, packed, monkeypatch):
    path, whole = packed(SHAPES[kind])
    pixels = read_image(path, ndim=(2, 3))
    read = []
    read_section = FitsSections._read

    def count(self, start, stop):
        read.append(self)
        return read_section(self, start, stop)

    monkeypatch.setattr(FitsSections, "_read", count)
    if kind == "cube":
        source, expected = cube_stamps(pixels), whole
    else:
        source = grid_stamps(pixels, 16)
        expected = whole.reshape(6, 16, 4, 16).swapaxes(1, 2).reshape(-1, 16, 16)
    stamps = np.concatenate([chunk.stamps for chunk in source.chunks(7)])
    np.testing.assert_array_equal(stamps, expected)
    # A row of cells, or a few kB of the cube, at a time; not each stamp by itself.
    assert len(read) <= (6 if kind == "image" else -(-60 // (3000 // (128 * whole.itemsize))))


def test_small_files_are_read_at_once(packed, monkeypatch):
    monkeypatch.setattr(fits_pixels, "IN_MEMORY", 2**20)
    path, whole = packed(SHAPES["image"])
    pixels = read_image(path)
    assert type(pixels) is np.ndarray
    np.testing.assert_array_equal(pixels, whole)


def resident():
    """Return the memory of this process, mapped files included, in bytes."""
    pages = Path("/proc/self/statm").read_text().split()[1]
    return int(pages) * 4096


@pytest.mark.skipif(sys.platform != "linux", reason="asks the kernel")
def test_mapped_stamps_do_not_stay_in_memory(tmp_path):
    path = tmp_path / "cube.fits"
    cube = np.arange(20000 * 32 * 32, dtype="f4").reshape(20000, 32, 32)  # 82 MB
    fits.PrimaryHDU(cube).writeto(path)
    source = cube_stamps(read_image(path, ndim=(3,)))
    before = most = resident()
    for chunk in source.chunks(1000):
        np.testing.assert_array_equal(chunk.stamps, cube[chunk.rows])
        most = max(most, resident())
    assert most - before < 2e7
    let_go(source.pixels)
    np.testing.assert_array_equal(source.read(5, 6).stamps, cube[5:6])  # it can be read again


def test_only_what_can_be_read_again_is_let_go(tmp_path):
    path = tmp_path / "pixels.bin"
    np.zeros(10000).tofile(path)
    mine = np.memmap(path, dtype="f8", mode="c")
    mine[:] = 1.0
    let_go(mine)
    assert np.all(mine == 1.0)
    let_go(np.zeros(3))
