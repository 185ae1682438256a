"""Inverse variances, cut where the stamps are: maps, masks, and the noise beside masks."""

from __future__ import annotations

import numpy as np
import pytest

from fdnt_xp.data.ivar import IvarSource
from fdnt_xp.data.noise import measure_border_noise
from fdnt_xp.data.stamps import cube_stamps, grid_stamps, position_stamps
from fdnt_xp.errors import FdntValueError, ShapeMismatchError

MASK_TYPES = ["u1", "i4", ">i2", "f4", "bool"]


@pytest.fixture
def image():
    return np.random.default_rng(1).normal(size=(60, 80))


def test_maps_are_cut_as_the_image_is(image):
    y, x = np.indices(image.shape)
    numbers = (1000.0 * y + x).astype(">f4")
    for source in (
        grid_stamps(image, 20),
        position_stamps(image, np.array([[30.2, 30.9], [44.0, 21.5]]), 16),
    ):
        for row, (corner_x, corner_y) in enumerate(source.corners):
            ivar = IvarSource(weight=source.beside(numbers, "weight map"))
            (cut,) = ivar.read(source.read(row, row + 1))
            assert cut[0, 0] == 1000.0 * corner_y + corner_x
            assert cut[3, 2] - cut[0, 0] == 3002.0


@pytest.mark.parametrize("dtype", MASK_TYPES)
def test_what_is_not_zero_is_missing(dtype, image):
    mask = np.zeros(image.shape, dtype=dtype)
    mask[3, 5] = 1
    mask[4, 6] = 1 if dtype == "bool" else 64
    source = grid_stamps(image, 20)
    ivar = IvarSource(mask=source.beside(mask, "mask"), variance=4.0)
    stamps = ivar.read(source.read(0, 12))
    assert np.argwhere(stamps == 0.0).tolist() == [[0, 3, 5], [0, 4, 6]]
    assert np.unique(stamps).tolist() == [0.0, 0.25]


def test_a_mask_and_a_map_go_together(image):
    source = grid_stamps(image, 20)
    weight = np.full(image.shape, 9.0)
    weight[1, 1] = 0.0
    mask = np.zeros(image.shape)
    mask[2, 2] = np.nan
    ivar = IvarSource(mask=source.beside(mask, "mask"), weight=source.beside(weight, "map"))
    assert np.argwhere(ivar.read(source.read(0, 1))[0] != 9.0).tolist() == [[1, 1], [2, 2]]


def test_cubes_have_a_plane_for_each(image):
    cube = np.stack([image, image])
    mask = np.zeros(cube.shape, dtype="i2")
    mask[1, 0, 0] = 1
    source = cube_stamps(cube.astype("f4"))
    stamps = IvarSource(mask=source.beside(mask, "mask"), variance=1.0).read(source.read(0, 2))
    assert stamps.dtype == np.float32
    assert np.argwhere(stamps == 0.0).tolist() == [[1, 0, 0]]


def test_galaxies_without_a_stamp_are_not_called_masked(image):
    source = position_stamps(image, np.array([[40.0, 30.0], [2.0, 2.0], [-50.0, 0.0]]), 16)
    weight = source.beside(np.full(image.shape, 2.0), "weight map")
    stamps = IvarSource(weight=weight).read(source.read(0, 3))
    assert [np.unique(stamp).tolist() for stamp in stamps] == [[2.0], [1.0], [1.0]]


def test_maps_of_another_shape_are_refused(image):
    source = grid_stamps(image, 20)
    with pytest.raises(ShapeMismatchError, match=r"the mask has the shape \(60, 60\); it must"):
        source.beside(np.zeros((60, 60)), "mask")


def test_a_mask_does_not_say_what_the_noise_is(image):
    source = grid_stamps(image, 20)
    with pytest.raises(FdntValueError, match="give --noise-variance or --weight"):
        IvarSource(mask=source.beside(np.zeros(image.shape), "mask"))


def test_masked_pixels_are_no_noise(image):
    # A third of the borders is bad: enough to raise a median by half.
    mask = np.random.default_rng(2).random(image.shape) < 0.33
    source = grid_stamps(np.where(mask, 100.0, image), 20)
    beside = source.beside(mask, "mask")
    measured = measure_border_noise(source, beside)
    assert measured.variance == pytest.approx(1.0, abs=4.0 * measured.variance_err)
    assert measure_border_noise(source).variance > 1.5
