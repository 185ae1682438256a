"""Exposures gathered from lists, GalSim images and observations as ngmix has them."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

import fdnt_xp as fx
from conftest import selected_backends
from fdnt_xp.data.adapters import (
    batch_from_observations,
    exposure_from_galsim,
    exposures_from_observations,
)
from fdnt_xp.data.bands import join_bands
from fdnt_xp.data.exposures import Exposure, ExposureBatch
from fdnt_xp.errors import FdntTypeError, FdntValueError, ShapeMismatchError

galsim = pytest.importorskip("galsim")

SCALE = 0.2
G = (0.15, -0.1)
PSF = galsim.Gaussian(sigma=1.7 * SCALE).shear(g1=0.05, g2=0.02)
GALAXY = galsim.Convolve(galsim.Gaussian(sigma=2.0 * SCALE).shear(g1=G[0], g2=G[1]), PSF)
JACOBIAN = galsim.JacobianWCS(-0.02, 0.2, -0.21, -0.01)
CELESTIAL = galsim.TanWCS(
    galsim.AffineTransform(-0.2, 0.01, 0.02, 0.19, origin=galsim.PositionD(500, 700)),
    galsim.CelestialCoord(40 * galsim.degrees, -30 * galsim.degrees),
)


def draw(profile, wcs, bounds, centre):
    image = galsim.ImageD(bounds, wcs=wcs)
    return profile.drawImage(image, center=galsim.PositionD(*centre), method="no_pixel")


def measure(exposures):
    """Return the shapes of single stamps, on the sky, and where their origins are."""
    batch = ExposureBatch.of([[one] for one in exposures])
    arguments = batch.arguments()
    shapes = fx.measure_shapes(
        arguments["stamps"], arguments["psf"], jacobian=arguments["jacobian"]
    )
    return shapes, batch


def images(wcs, *, first=1, size=(46, 44), centre=(3.3, -1.2)):
    """Return an image of the galaxy at `centre` from the middle, its position and its star."""
    nx, ny = size
    bounds = galsim.BoundsI(first, first + nx - 1, first, first + ny - 1)
    place = (bounds.true_center.x + centre[0], bounds.true_center.y + centre[1])
    image = draw(GALAXY, wcs, bounds, place)
    local = wcs.jacobian(image_pos=galsim.PositionD(*place))
    star = PSF.drawImage(nx=40, ny=40, wcs=local, method="no_pixel", dtype=float)
    return image, place, star


@pytest.mark.parametrize(
    ("wcs", "first"),
    [(galsim.PixelScale(SCALE), 1), (JACOBIAN, 0), (CELESTIAL, 600)],
    ids=["scale", "jacobian", "celestial"],
)
def test_a_galsim_image_with_its_wcs(wcs, first):
    image, place, star = images(wcs, first=first)
    shapes, batch = measure([exposure_from_galsim(image, star, position=place)])
    np.testing.assert_allclose(shapes.g[0], G, atol=3e-5)
    np.testing.assert_allclose(batch.origin[0], [22.5 + 3.3, 21.5 - 1.2])
    np.testing.assert_allclose(shapes.centroid[0], batch.origin[0], atol=1e-4)


def test_what_a_galsim_image_may_lack():
    image, place, star = images(JACOBIAN)
    middle = exposure_from_galsim(image, star.array)
    assert middle.origin == (22.5, 21.5)
    named = exposure_from_galsim(image, star, position=galsim.PositionD(*place), band=2)
    assert named.origin == pytest.approx((25.8, 20.3))
    assert named.band == 2
    plain = exposure_from_galsim(galsim.Image(image.array), star.array)
    np.testing.assert_array_equal(plain.jacobian, np.eye(2))


def test_missing_pixels_of_a_galsim_image():
    image, _, star = images(JACOBIAN)
    weight = galsim.Image(np.full(image.array.shape, 4.0))
    mask = np.zeros(image.array.shape, dtype=int)
    weight.array[1, 2], mask[3, 4] = 0.0, 8
    one = exposure_from_galsim(image, star, weight=weight, mask=mask)
    assert np.argwhere(one.ivar == 0).tolist() == [[1, 2], [3, 4]]
    by_number = exposure_from_galsim(image, star, mask=mask, noise_variance=0.25)
    assert set(np.unique(by_number.ivar)) == {0.0, 4.0}
    assert exposure_from_galsim(image, star, noise_variance=2.0).noise_variance == 2.0
    for wrong, error in (
        ({"mask": mask}, FdntValueError),
        ({"weight": weight, "noise_variance": 1.0}, FdntValueError),
        ({"weight": weight.array[1:]}, ShapeMismatchError),
        ({"weight": weight, "mask": mask[1:]}, ShapeMismatchError),
    ):
        with pytest.raises(error):
            exposure_from_galsim(image, star, **wrong)


def test_a_star_of_other_pixels_is_refused():
    image, _, _ = images(JACOBIAN)
    star = PSF.drawImage(nx=40, ny=40, scale=SCALE, method="no_pixel")
    with pytest.raises(FdntValueError, match="draw the PSF with the pixels of the image"):
        exposure_from_galsim(image, star)
    fine = galsim.JacobianWCS(-0.01, 0.1, -0.105, -0.005)
    star = PSF.drawImage(nx=80, ny=80, wcs=fine, method="no_pixel")
    assert exposure_from_galsim(image, star, oversampling=2).star.shape == (80, 80)
    with pytest.raises(FdntTypeError, match=r"must be a galsim\.Image, not ndarray"):
        exposure_from_galsim(image.array, star)


# --- observations as ngmix has them ---------------------------------------------------------


def jacobian_of(wcs, col, row):
    slopes = {"dudrow": wcs.dudy, "dudcol": wcs.dudx, "dvdrow": wcs.dvdy, "dvdcol": wcs.dvdx}
    return SimpleNamespace(row0=row, col0=col, **slopes)


def observation(wcs, *, size=(46, 44), **more):
    image, place, star = images(wcs, size=size)
    psf = SimpleNamespace(image=star.array, jacobian=jacobian_of(wcs, 19.5, 19.5))
    fields = {"weight": np.full(image.array.shape, 25.0), "psf": psf, **more}
    return SimpleNamespace(
        image=image.array, jacobian=jacobian_of(wcs, place[0] - 1, place[1] - 1), **fields
    )


def test_observations_are_true_on_the_sky():
    one, other = observation(JACOBIAN), observation(galsim.JacobianWCS(SCALE, 0, 0.01, SCALE))
    exposures = exposures_from_observations([one, other])
    shapes, batch = measure(exposures)
    np.testing.assert_allclose(shapes.g, [G, G], atol=3e-5)
    np.testing.assert_allclose(shapes.centroid, batch.origin, atol=1e-4)
    assert np.all(exposures[0].ivar == 25.0)


def test_one_list_of_them_and_lists_by_band():
    one = observation(JACOBIAN)
    for given, bands in (
        (one, [0]),
        ([one, one], [0, 0]),
        ([[one], [one, one], []], [0, 1, 1]),
        ([], []),
    ):
        assert [e.band for e in exposures_from_observations(given)] == bands
    batch = batch_from_observations([[one, one], [], [[one], [one]]], ids=["a", "b", "c"])
    assert batch.ids.tolist() == ["a", "b", "c"]
    assert batch.object_index.tolist() == [0, 0, 2, 2]
    assert batch.band.tolist() == [0, 0, 0, 1]


def test_bits_of_a_mask():
    bits = np.zeros((44, 46), dtype="i4")
    bits[1, 2], bits[3, 4] = 1, 4
    one = observation(JACOBIAN, bmask=bits)
    missing = [
        np.argwhere(exposures_from_observations(one, bad_bits=bad)[0].ivar == 0).tolist()
        for bad in (None, 4, 2)
    ]
    assert missing == [[[1, 2], [3, 4]], [[3, 4]], []]


def test_observations_that_are_none():
    one = observation(JACOBIAN)
    del one.psf
    with pytest.raises(FdntTypeError, match=r"object 1: an observation .* has no psf"):
        batch_from_observations([[], one])
    turned = observation(JACOBIAN)
    turned.psf.jacobian = jacobian_of(galsim.JacobianWCS(SCALE, 0, 0, SCALE), 19.5, 19.5)
    with pytest.raises(FdntValueError, match="draw the PSF with the pixels of the image"):
        exposures_from_observations(turned)
    ragged = observation(JACOBIAN, bmask=np.zeros((3, 3), dtype=int))
    with pytest.raises(ShapeMismatchError, match="the mask must have the shape of the image"):
        exposures_from_observations(ragged)
    slopeless = observation(JACOBIAN)
    del slopeless.jacobian.dudrow
    with pytest.raises(FdntTypeError, match="lacks slopes"):
        exposures_from_observations(slopeless)


# --- batches --------------------------------------------------------------------------------


def flat(shape=(4, 5), *, star=1.0, **more):
    return Exposure(image=np.ones(shape), star=np.full((3, 3), star), **more)


def test_ragged_lists_become_one_batch():
    star = np.ones((3, 3))
    objects = [
        [Exposure(image=np.full((4, 5), 1.0), star=star, noise_variance=0.5, origin=(1.0, 2.0))],
        [],
        [
            Exposure(image=np.full((6, 3), 2.0), star=star, ivar=np.full((6, 3), 3.0)),
            Exposure(
                image=np.ones((2, 2)),
                star=np.eye(2),
                ivar=np.zeros((2, 2)),
                jacobian=[[1, 2], [3, 4]],
                band=1,
            ),
        ],
    ]
    batch = ExposureBatch.of(objects)
    assert batch.stamps.shape == batch.ivar.shape == (3, 6, 5)
    assert batch.object_index.tolist() == [0, 2, 2]
    assert batch.psf_index.tolist() == [0, 0, 1]  # the same pixels are the same star
    np.testing.assert_array_equal(batch.origin, [[1.0, 2.0], [1.0, 2.5], [0.5, 0.5]])
    np.testing.assert_array_equal(batch.jacobian[2], [[1, 2], [3, 4]])
    np.testing.assert_array_equal(np.sum(batch.ivar, axis=(1, 2)), [40.0, 54.0, 0.0])
    np.testing.assert_array_equal(batch.stamps[0, :4, :5], 1.0)
    assert np.all(batch.ivar[0, 4:] == 0)
    assert batch.band.tolist() == [0, 0, 1]


def test_equal_stamps_stay_as_they_are():
    batch = ExposureBatch.of([[flat(noise_variance=2.0)], [flat(noise_variance=3.0)]])
    assert batch.ivar is None
    assert batch.noise_variance.tolist() == [2.0, 3.0]
    assert ExposureBatch.of([[flat()]]).noise_variance is None
    assert ExposureBatch.of([]).n_objects == 0
    empty = ExposureBatch.of([[], []])
    assert (empty.n_objects, empty.n_stamps) == (2, 0)
    single = Exposure(image=np.ones((4, 4), ">f4"), star=np.ones((3, 3)), noise_variance=1.0)
    assert ExposureBatch.of([[single]]).stamps.dtype == np.dtype("float32")
    assert ExposureBatch.of([[single, flat((4, 4), noise_variance=1)]]).stamps.dtype == "float64"


@pytest.mark.parametrize(
    ("wrong", "error"),
    [
        ({"ivar": np.ones((5, 4))}, ShapeMismatchError),
        ({"jacobian": np.ones(4)}, ShapeMismatchError),
        ({"image": np.ones((2, 4, 5))}, ShapeMismatchError),
        ({"image": np.ones((4, 5), dtype=complex)}, FdntTypeError),
        ({"star": np.array([["a"]])}, FdntTypeError),
        ({"noise_variance": -1.0}, FdntValueError),
        ({"noise_variance": 1.0, "ivar": np.ones((4, 5))}, FdntValueError),
    ],
)
def test_exposures_that_are_none(wrong, error):
    with pytest.raises(error):
        Exposure(**{"image": np.ones((4, 5)), "star": np.ones((3, 3)), **wrong})


def test_batches_that_are_none():
    with pytest.raises(FdntValueError, match="stamps of several sizes"):
        ExposureBatch.of([[flat((4, 5)), flat((5, 5))]])
    with pytest.raises(FdntValueError, match="1 of 2 have neither"):
        ExposureBatch.of([[flat(noise_variance=1.0), flat()]])
    with pytest.raises(ShapeMismatchError, match="3 ids but 1 objects"):
        ExposureBatch.of([[flat()]], ids=[1, 2, 3])
    batch = ExposureBatch.of([[flat(), flat()]])
    with pytest.raises(ShapeMismatchError, match=r"origin must have the shape \(2, 2\)"):
        ExposureBatch(**{**vars(batch), "origin": np.zeros((3, 2))})


def test_bands_of_the_same_objects():
    g = ExposureBatch.of([[flat(noise_variance=2.0)], [], [flat(noise_variance=4.0, star=2.0)]])
    r = ExposureBatch.of([[flat((6, 4), ivar=np.full((6, 4), 3.0), star=3.0)] * 2, [], []])
    joined = join_bands([g, r])
    assert joined.object_index.tolist() == [0, 0, 0, 2]
    assert joined.band.tolist() == [0, 1, 1, 0]
    assert joined.stamps.shape == (4, 6, 5)
    np.testing.assert_array_equal(np.sum(joined.ivar, axis=(1, 2)), [10.0, 72.0, 72.0, 5.0])
    assert joined.stars[joined.psf_index, 0, 0].tolist() == [1.0, 3.0, 3.0, 2.0]
    assert len(joined.stars) == 3
    same = join_bands([g, g])
    assert same.ivar is None
    assert same.noise_variance.tolist() == [2.0, 2.0, 4.0, 4.0]
    other = ExposureBatch.of([[], [], []], ids=[7, 8, 9])
    with pytest.raises(ShapeMismatchError, match="band 1 is of other objects"):
        join_bands([g, other])


def test_arguments_on_any_library(to_xp, xp):
    batch = ExposureBatch.of([[flat((8, 8), noise_variance=1.0)], [flat((6, 8), noise_variance=2)]])
    arguments = batch.arguments(lambda host: to_xp(host, "float32"))
    for name in ("stamps", "ivar", "origin", "jacobian"):
        assert arguments[name].dtype == xp.float32
    assert arguments["object_index"].dtype == xp.int64
    assert "band" not in arguments  # where there is but one
    assert arguments["psf"].n_gal == 2
    assert arguments["n_objects"] == 2
    assert "noise_variance" not in arguments


@pytest.mark.skipif(
    all(backend.library != "torch" for backend in selected_backends()), reason="torch not tested"
)
def test_torch_tensors_are_images_too():
    import torch

    one = Exposure(image=torch.ones((4, 5)), star=torch.ones((3, 3)), ivar=torch.ones((4, 5)))
    assert ExposureBatch.of([[one]]).stamps.dtype == np.float32
