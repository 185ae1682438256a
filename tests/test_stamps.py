"""Stamps are cut where they should be, positions that give none are flagged, noise is found."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.table import MaskedColumn, Table

from fdnt_xp.data.noise import measure_border_noise
from fdnt_xp.data.stamps import cube_stamps, grid_stamps, position_stamps
from fdnt_xp.data.tables import read_positions
from fdnt_xp.errors import CatalogError, FdntValueError, RangeError, ShapeMismatchError
from fdnt_xp.flags import Flag


@pytest.fixture
def image():
    """Return an image whose pixels tell where they are: 1000 y + x."""
    y, x = np.mgrid[:40, :60]
    return (1000.0 * y + x).astype(">f8")


# --- grid -------------------------------------------------------------------------------


def test_grid(image):
    source = grid_stamps(image, 20)
    assert source.n_gal == 6
    chunk = source.read(0, 6)
    assert chunk.stamps.shape == (6, 20, 20)
    assert chunk.stamps.dtype == np.float64
    assert chunk.stamps.dtype.isnative
    np.testing.assert_array_equal(chunk.stamps[:, 0, 0], [0, 20, 40, 20000, 20020, 20040])
    np.testing.assert_array_equal(source.positions[4], [29.5, 29.5])
    np.testing.assert_array_equal(source.corners[4], [20, 20])
    assert not source.flags.any()


@pytest.mark.parametrize("size", [1, 4, 6, 100])
def test_chunks_cover_all_in_order(size, image):
    source = grid_stamps(image, 20)
    chunks = list(source.chunks(size))
    assert all(len(chunk.stamps) <= size for chunk in chunks)
    together = np.concatenate([chunk.stamps for chunk in chunks])
    np.testing.assert_array_equal(together, source.read(0, 6).stamps)
    assert [i for chunk in chunks for i in range(6)[chunk.rows]] == list(range(6))


def test_float32_stays(image):
    assert grid_stamps(image.astype("f4"), 20).read(0, 1).stamps.dtype == np.float32
    assert grid_stamps(image.astype("i4"), 20).read(0, 1).stamps.dtype == np.float64


@pytest.mark.parametrize("cell", [16, 40, 64])
def test_image_not_a_multiple_of_the_cell(cell, image):
    with pytest.raises(ShapeMismatchError, match=f"60 x 40 pixels .* cells of {cell} pixels"):
        grid_stamps(image, cell)


@pytest.mark.parametrize("cell", [0, -20, 4])
def test_cells_too_small(cell, image):
    with pytest.raises(RangeError, match="cell"):
        grid_stamps(image, cell)


def test_wrong_rank(image):
    with pytest.raises(ShapeMismatchError, match="two axes"):
        grid_stamps(image[None], 20)
    with pytest.raises(ShapeMismatchError, match="three axes"):
        cube_stamps(image)
    with pytest.raises(ShapeMismatchError, match="two axes"):
        position_stamps(image[0], np.zeros((1, 2)), 10)
    with pytest.raises(ShapeMismatchError, match=r"\(n, 2\)"):
        position_stamps(image, np.zeros((2, 3)), 10)
    with pytest.raises(FdntValueError, match="whole number"):
        position_stamps(image, np.zeros((1, 2)), 10.5)


# --- cube -------------------------------------------------------------------------------


def test_cube():
    cube = np.arange(3 * 10 * 12, dtype=float).reshape(3, 10, 12)
    source = cube_stamps(cube)
    assert source.stamp_shape == (10, 12)
    np.testing.assert_array_equal(source.read(1, 3).stamps, cube[1:])
    np.testing.assert_array_equal(source.positions, [[5.5, 4.5]] * 3)


# --- positions --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("size", "x", "corner"),
    [
        (11, 20.0, 15),  # centred on the pixel
        (11, 20.4, 15),
        (11, 20.6, 16),
        (11, 19.5, 15),  # half up
        (10, 20.0, 16),  # the middle is between pixels: 15.5 rounds up
        (10, 20.5, 16),
        (10, 20.4, 16),
    ],
)
def test_stamps_are_centred_to_half_a_pixel(size, x, corner, image):
    source = position_stamps(image, np.array([[x, x]]), size)
    assert source.corners.tolist() == [[corner, corner]]
    assert np.all(np.abs(source.positions - source.corners - (size - 1) / 2) <= 0.5)
    assert source.read(0, 1).stamps[0, 0, 0] == 1000 * corner + corner


def test_positions_off_the_image_are_flagged_and_disturb_nobody(image):
    edge, off = int(Flag.EDGE), int(Flag.OFF_IMAGE)
    cases = [
        ((30.0, 20.0), 0),
        ((5.0, 5.0), 0),  # the stamp just fits
        ((54.0, 34.0), 0),
        ((4.0, 20.0), edge),
        ((30.0, 35.0), edge),
        ((-0.5, 20.0), edge),
        ((59.4, 39.4), edge),
        ((-0.6, 20.0), off),
        ((59.5, 20.0), off),
        ((30.0, 1e9), off),
        ((np.nan, 20.0), off),
        ((30.0, np.inf), off),
    ]
    source = position_stamps(image, np.array([xy for xy, _ in cases]), 11)
    assert source.flags.tolist() == [flag for _, flag in cases]
    chunk = source.read(0, len(cases))
    for (xy, flag), stamp in zip(cases, chunk.stamps, strict=True):
        assert np.isnan(stamp).all() if flag else stamp[5, 5] == 1000 * xy[1] + xy[0]


def test_no_positions(image):
    source = position_stamps(image, np.zeros((0, 2)), 11)
    assert source.n_gal == 0
    assert source.read(0, 5).stamps.shape == (0, 11, 11)
    assert list(source.chunks(5)) == []


# --- tables of positions ----------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".fits", ".ecsv", ".csv", ".parquet", ".txt"])
def test_positions_from_any_table(suffix, tmp_path):
    path = tmp_path / f"positions{suffix}"
    formats = {".csv": "ascii.csv", ".txt": "ascii.commented_header", ".ecsv": "ascii.ecsv"}
    table = Table({"id": [7, 8], "X": [1.5, 2.5], "Y": [3, 4]})
    table.write(path, format=formats.get(suffix, suffix[1:]))
    positions = read_positions(path)
    np.testing.assert_array_equal(positions.xy, [[1.5, 3], [2.5, 4]])
    assert positions.ids.tolist() == [7, 8]
    np.testing.assert_array_equal(read_positions(path, origin=1).xy, [[0.5, 2], [1.5, 3]])


def test_columns_by_name_and_ids_by_number(tmp_path):
    path = tmp_path / "positions.ecsv"
    columns = {"X_IMAGE": [1.0, 2.0], "Y_IMAGE": MaskedColumn([3.0, 4.0], mask=[False, True])}
    Table(columns).write(path)
    positions = read_positions(path, x_column="X_IMAGE", y_column="y_image")
    np.testing.assert_array_equal(positions.xy, [[1, 3], [2, np.nan]])
    assert positions.ids.tolist() == [0, 1]


def test_tables_that_cannot_be_used(tmp_path):
    path = tmp_path / "positions.ecsv"
    Table({"x": ["a", "b"], "y": [1.0, 2.0], "v": [[1, 2], [3, 4]]}).write(path)
    with pytest.raises(CatalogError, match="no column 'z'; it has x, y, v"):
        read_positions(path, x_column="z")
    with pytest.raises(CatalogError, match=r"'x' .* does not hold numbers"):
        read_positions(path)
    with pytest.raises(CatalogError, match="more than a number"):
        read_positions(path, x_column="v")
    with pytest.raises(FdntValueError, match="origin must be 0 or 1"):
        read_positions(path, origin=2)
    with pytest.raises(CatalogError, match="does not exist"):
        read_positions(tmp_path / "no.ecsv")
    path.write_text("not a table: \0\1\2")
    with pytest.raises(CatalogError, match=r"cannot read the positions .*positions\.ecsv"):
        read_positions(path)


# --- noise ------------------------------------------------------------------------------


def _cells(rng, sigma=3.0, n=144, cell=40):
    return sigma * rng.standard_normal((n, cell, cell))


def test_border_noise_is_right_to_a_few_percent():
    noise = measure_border_noise(cube_stamps(_cells(np.random.default_rng(1))))
    assert noise.known
    assert not noise.has_background
    assert noise.variance == pytest.approx(9.0, rel=0.03)
    assert abs(noise.level) < 5 * noise.level_err
    assert noise.n_pixels == 144 * (40**2 - 36**2)


def test_galaxies_and_bright_neighbours_do_not_matter():
    cells = _cells(np.random.default_rng(2))
    y, x = np.mgrid[:40, :40] - 19.5
    cells += 1e4 * np.exp(-(x**2 + y**2) / 2 / 3.0**2)
    cells[::12] += 1e5  # one in twelve is covered by a star
    noise = measure_border_noise(cube_stamps(cells))
    # A twelfth of outliers widens the median deviation by a tenth, not by 10^9.
    assert noise.variance == pytest.approx(9.0, rel=0.3)
    clean = measure_border_noise(cube_stamps(np.delete(cells, np.s_[::12], axis=0)))
    assert clean.variance == pytest.approx(9.0, rel=0.03)


@pytest.mark.parametrize("sigma", [1.0, 2.3, 50.0])
def test_noise_of_whole_numbers(sigma):
    cells = np.round(_cells(np.random.default_rng(3), sigma)).astype("i4")
    noise = measure_border_noise(cube_stamps(cells))
    assert noise.variance == pytest.approx(cells.var(), rel=0.06)


def test_background_is_noticed():
    cells = _cells(np.random.default_rng(4))
    assert measure_border_noise(cube_stamps(cells + 1.0)).has_background
    assert measure_border_noise(cube_stamps(cells - 1.0)).has_background
    # A hundredth of the noise is certain here, but it is what wings of galaxies leave.
    assert not measure_border_noise(cube_stamps(cells + 0.1)).has_background


def test_no_noise_to_measure(image):
    constant = measure_border_noise(cube_stamps(np.ones((3, 20, 20))))
    assert constant.variance == 0
    assert not constant.known
    none = measure_border_noise(position_stamps(image, np.full((2, 2), -9.0), 11))
    assert np.isnan(none.variance)
    assert not none.known
    assert not none.has_background


def test_flagged_stamps_and_nan_pixels_are_left_out():
    rng = np.random.default_rng(5)
    pixels = 3.0 * rng.standard_normal((400, 400))
    pixels[100:120] = np.nan
    xy = np.concatenate([rng.uniform(30, 370, (200, 2)), [[0.0, 0.0], [-5.0, 5.0]]])
    noise = measure_border_noise(position_stamps(pixels, xy, 40))
    assert noise.variance == pytest.approx(9.0, rel=0.05)
