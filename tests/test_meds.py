"""MEDS files: what comes out of them is what others put in, and no object stops a run."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from astropy.io import fits

import fdnt_xp as fx
from fdnt_xp.data.meds import MedsOptions, open_meds
from fdnt_xp.data.meds_index import chunk_ranges, equal_boxes
from fdnt_xp.errors import CatalogError, FdntValueError, FdntWarning, RangeError
from meds_files import (
    LARGE,
    SCALE,
    SIGMA,
    SMALL,
    WCS,
    G,
    MedsObject,
    cutout,
    draw,
    drawn_cutouts,
    objects_of,
    write_meds,
)

galsim = pytest.importorskip("galsim")


@pytest.fixture(scope="module")
def cutouts():
    return drawn_cutouts()


@pytest.fixture
def file(cutouts, tmp_path):
    return write_meds(tmp_path / "tile.fits", objects_of(cutouts))


def read(path, rows=range(4), **options):
    with open_meds(path, MedsOptions(**options)) as meds:
        return meds.read(np.array(rows, dtype=np.int64))


def test_stamps_are_those_written(file, cutouts):
    batch = read(file, [3, 2, 0])
    assert batch.ids.tolist() == [103, 102, 100]
    assert batch.object_index.tolist() == [0, 0, 0, 2, 2, 2]
    assert batch.n_objects == 3
    for number, one in enumerate(cutouts[3] + cutouts[0]):
        np.testing.assert_array_equal(batch.stamps[number], one.image)
        np.testing.assert_array_equal(batch.ivar[number], one.weight)
        ny, nx = one.psf.shape
        star = batch.stars[batch.psf_index[number]]
        np.testing.assert_array_equal(star[:ny, :nx], one.psf)
        assert np.sum(np.abs(star)) == pytest.approx(np.sum(np.abs(one.psf)))
        assert batch.origin[number].tolist() == [one.col, one.row]


def test_shapes_are_true_on_the_sky(file):
    batch = read(file, [1, 2, 3])
    assert batch.n_stamps == 5
    arguments = batch.arguments()
    shapes = fx.measure_shapes(
        arguments["stamps"],
        arguments["psf"],
        jacobian=arguments["jacobian"],
        noise_variance=SIGMA**2,
    )
    np.testing.assert_allclose(shapes.g, G[1 + batch.object_index], atol=2e-5)
    np.testing.assert_allclose(shapes.centroid, batch.origin, atol=1e-4)


def test_a_file_that_galsim_wrote(tmp_path):
    from galsim.des import MultiExposureObject, WriteMEDS

    objects = []
    for row in (1, 3):
        parts = [cutout(row, epoch, 48) for epoch in (1, 2)]
        wcs = [galsim.AffineTransform(w.dudx, w.dudy, w.dvdx, w.dvdy) for w in WCS[1:]]
        objects.append(
            MultiExposureObject(
                images=[galsim.Image(p.image, xmin=0, ymin=0) for p in parts],
                weight=[galsim.Image(p.weight, xmin=0, ymin=0) for p in parts],
                psf=[galsim.Image(draw_star(epoch), xmin=0, ymin=0) for epoch in (1, 2)],
                wcs=wcs,
                id=10 + row,
                cutout_row=[p.row for p in parts],
                cutout_col=[p.col for p in parts],
            )
        )
    WriteMEDS(objects, str(tmp_path / "galsim.fits"))
    with pytest.raises(CatalogError, match="does not have the numbers of the objects"):
        read(tmp_path / "galsim.fits", [0, 1])  # where all have the number 1
    batch = read(tmp_path / "galsim.fits", [0, 1], segments="ignore")
    assert batch.ids.tolist() == [11, 13]
    arguments = batch.arguments()
    shapes = fx.measure_shapes(
        arguments["stamps"], arguments["psf"], jacobian=arguments["jacobian"]
    )
    np.testing.assert_allclose(shapes.g, G[[1, 1, 3, 3]], atol=2e-5)
    np.testing.assert_allclose(shapes.centroid, batch.origin, atol=1e-4)


def draw_star(epoch):
    psf = galsim.Gaussian(sigma=1.7 * SCALE).shear(g1=0.05 * epoch, g2=-0.03)
    return draw(psf, WCS[epoch], 48)


def test_what_is_missing(cutouts, tmp_path):
    one = cutout(0, 0)
    one.weight[1, 2] = 0.0
    one.bmask[3, 4], one.bmask[5, 6] = 2, 5
    one.seg[7, 8], one.seg[9, 10] = 1, 4
    path = write_meds(tmp_path / "m.fits", [MedsObject(id=5, number=1, cutouts=[one])])

    def missing(**options):
        ivar = read(path, [0], **options).ivar
        assert set(np.unique(ivar)) == {0.0, SIGMA**-2}
        return np.argwhere(ivar[0] == 0).tolist()

    assert missing() == [[1, 2], [3, 4], [5, 6], [9, 10]]
    assert missing(bad_bits=4) == [[1, 2], [5, 6], [9, 10]]
    assert missing(bad_bits=0, segments="ignore") == [[1, 2]]
    # By the id where there is no number.
    unnumbered = write_meds(tmp_path / "u.fits", [MedsObject(id=4, cutouts=[one])], number=None)
    assert np.argwhere(read(unnumbered, [0]).ivar[0] == 0).tolist()[-1] == [7, 8]


@pytest.mark.parametrize(
    ("chosen", "expected"),
    [("all", [3, 2, 0, 3]), ("epochs", [2, 1, 0, 2]), ("first", [1, 1, 0, 1])],
)
def test_which_cutouts(chosen, expected, file, cutouts):
    batch = read(file, cutouts=chosen)
    assert np.bincount(batch.object_index, minlength=4).tolist() == expected
    first = cutouts[3][1 if chosen == "epochs" else 0]
    place = np.flatnonzero(batch.object_index == 3)[0]
    np.testing.assert_array_equal(batch.stamps[place, :SMALL, :SMALL], first.image)


def test_smaller_stamps_are_made_larger_by_missing_pixels(file):
    batch = read(file)
    assert batch.stamps.shape == (8, LARGE, LARGE)
    small = batch.object_index != 1
    assert np.all(batch.ivar[small, SMALL:] == 0)
    assert np.all(batch.ivar[small, :, SMALL:] == 0)
    assert np.all(batch.ivar[small, :SMALL, :SMALL] > 0)
    assert np.all(batch.ivar[~small] > 0)


def test_chunks_are_bounded_and_groups_have_one_size(file):
    with open_meds(file) as meds:
        pixels, boxes = meds.index.pixels_per_object, meds.index.largest_box

        def ranges(objects, most):
            parts = chunk_ranges(pixels, most_objects=objects, most_pixels=most)
            return [(part.start, part.stop) for part in parts]

        assert ranges(3, 10**9) == [(0, 3), (3, 4)]
        assert ranges(9, 2 * LARGE**2) == [(0, 1), (1, 3), (3, 4)]
        assert ranges(9, 1) == [(0, 1), (1, 2), (2, 3), (3, 4)]  # one object is never divided
        assert [rows.tolist() for rows in equal_boxes(boxes, slice(0, 4))] == [[0, 2, 3], [1]]
        assert [rows.tolist() for rows in equal_boxes(boxes, slice(2, 3))] == [[2]]
        assert [rows.tolist() for rows in equal_boxes(boxes, slice(0, 0))] == [[]]
        alone = meds.read(np.array([2]))
    assert (alone.n_objects, alone.n_stamps) == (1, 0)


def test_broken_rows_lose_their_cutouts_alone(file, cutouts, tmp_path):
    with fits.open(file) as hdus:
        data = hdus["object_data"].data
        data["start_row"][0, 1] = 10**9
        data["start_row"][1] = -5
        data["psf_start_row"][3, 0] = 10**9
        data["psf_col_size"][3, 1] = 0
        data["ncutout"][2] = 10**6
        hdus.writeto(tmp_path / "broken.fits")
    with pytest.warns(FdntWarning, match=r"cutouts that object_data of .* promises lie outside"):
        batch = read(tmp_path / "broken.fits")
    assert np.bincount(batch.object_index, minlength=4).tolist() == [2, 0, 0, 1]
    np.testing.assert_array_equal(batch.stamps[-1], cutouts[3][2].image)


def test_a_box_of_any_size_is_no_catastrophe(file, tmp_path):
    with fits.open(file) as hdus:
        hdus["object_data"].data["box_size"] = [2**62, -3, 0, SMALL]
        hdus.writeto(tmp_path / "broken.fits")
    with pytest.warns(FdntWarning, match="5 cutouts"):
        batch = read(tmp_path / "broken.fits")
    assert batch.object_index.tolist() == [3, 3, 3]


def test_no_weights(cutouts, tmp_path):
    plain = [replace(c, weight=None, bmask=None, seg=None) for c in cutouts[0]]
    path = write_meds(tmp_path / "plain.fits", [MedsObject(id=1, cutouts=plain)])
    assert read(path, [0]).ivar is None
    batch = read(path, [0], noise_variance=4.0)
    assert batch.noise_variance.tolist() == [4.0] * 3
    masked = [replace(c, weight=None) for c in cutouts[0]]
    path = write_meds(tmp_path / "masked.fits", [MedsObject(id=1, cutouts=masked)])
    with pytest.raises(FdntValueError, match="has no weight_cutouts, and a mask alone"):
        read(path, [0])
    masked[1].bmask[2, 3] = 1
    write_meds(path, [MedsObject(id=1, cutouts=masked)])
    ivar = read(path, [0], noise_variance=4.0).ivar
    masked[1].bmask[2, 3] = 0
    assert np.argwhere(ivar != 0.25).tolist() == [[1, 2, 3]]


def test_psfs_that_are_shared_or_given(cutouts, file, tmp_path):
    with fits.open(file) as hdus:
        data = hdus["object_data"].data
        for name in ("psf_start_row", "psf_row_size", "psf_col_size"):
            data[name][3, :3] = data[name][0, 0]
        hdus.writeto(tmp_path / "shared.fits")
    batch = read(tmp_path / "shared.fits", [0, 3])
    assert batch.psf_index[[0, 3, 4, 5]].tolist() == [batch.psf_index[0]] * 4
    assert len(batch.stars) == 3
    # Equal ones at different places are one star too.
    same = [replace(c, psf=cutouts[0][0].psf) for c in cutouts[0]]
    equal = write_meds(tmp_path / "equal.fits", [MedsObject(id=1, number=1, cutouts=same)])
    assert len(read(equal, [0]).stars) == 1
    star = np.ones((5, 7))
    given = read(file, star=star)
    np.testing.assert_array_equal(given.stars, star[None])
    assert not np.any(given.psf_index)
    boxed = write_meds(
        tmp_path / "box.fits",
        [MedsObject(id=1, number=1, cutouts=cutouts[0][:1])],
        psf_row_size=None,
        psf_col_size=None,
        psf_box_size=np.array([25]),
    )
    np.testing.assert_array_equal(read(boxed, [0]).stars[0], cutouts[0][0].psf)


def test_packed_files_and_single_precision(file, tmp_path):
    expected = read(file)
    with fits.open(file) as hdus:
        for hdu in hdus[2:]:
            single = hdu.data.astype("f4") if hdu.data.dtype.kind == "f" else hdu.data
            hdu.data = single
        hdus.writeto(tmp_path / "single.fits")
    with fits.open(tmp_path / "single.fits") as hdus:
        packed = [
            fits.CompImageHDU(
                hdu.data,
                name=hdu.name,
                compression_type="GZIP_1",
                tile_shape=(1000,),
                quantize_level=0,
            )
            for hdu in hdus[2:]
        ]
        fits.HDUList([*hdus[:2], *packed]).writeto(tmp_path / "single.fits.fz")
    for name in ("single.fits", "single.fits.fz"):
        batch = read(tmp_path / name)
        assert batch.stamps.dtype == batch.ivar.dtype == batch.stars.dtype == np.float32
        assert batch.stamps.dtype.isnative
        np.testing.assert_array_equal(batch.stamps, expected.stamps.astype("f4"))
        np.testing.assert_array_equal(batch.ivar, expected.ivar.astype("f4"))


@pytest.mark.parametrize(
    ("extension", "message"),
    [
        ("object_data", "is no MEDS file: it has no extension object_data"),
        ("image_cutouts", "is no MEDS file: it has no extension image_cutouts"),
        ("psf", "has no extension psf, and no PSF was given"),
    ],
)
def test_an_extension_that_is_lacking(extension, message, file, tmp_path):
    with fits.open(file) as hdus:
        del hdus[extension]
        hdus.writeto(tmp_path / "less.fits")
    with pytest.raises(CatalogError, match=message):
        read(tmp_path / "less.fits")


@pytest.mark.parametrize("column", ["dudcol", "cutout_row", "psf_start_row", "ncutout"])
def test_a_column_that_is_lacking(column, cutouts, tmp_path):
    path = write_meds(tmp_path / "less.fits", objects_of(cutouts), **{column: None})
    with pytest.raises(CatalogError, match=rf"object_data of .*less.fits lacks {column}"):
        read(path)


def test_files_that_are_none(file, tmp_path):
    with pytest.raises(CatalogError, match=r"cannot read the MEDS file: .*no\.fits does not exist"):
        read(tmp_path / "no.fits")
    (tmp_path / "text.fits").write_text("not FITS\n" * 400)
    content = file.read_bytes()
    (tmp_path / "half.fits").write_bytes(content[: len(content) // 2])
    for name in ("text.fits", "half.fits"):
        with pytest.raises(CatalogError, match=rf"cannot read the MEDS file .*{name}: "):
            read(tmp_path / name)
    with fits.open(file) as hdus:
        hdus["weight_cutouts"].data = hdus["weight_cutouts"].data[:-1]
        hdus.writeto(tmp_path / "short.fits")
    with pytest.raises(CatalogError, match=r"weight_cutouts of .* has the shape"):
        read(tmp_path / "short.fits")


@pytest.mark.parametrize(
    ("options", "error"),
    [
        ({"cutouts": "some"}, FdntValueError),
        ({"segments": "uberseg"}, FdntValueError),
        ({"noise_variance": 0.0}, RangeError),
        ({"bad_bits": -1}, RangeError),
    ],
)
def test_options_that_are_none(options, error):
    with pytest.raises(error):
        MedsOptions(**options)


def test_a_variance_for_a_file_with_weights(file):
    with pytest.raises(FdntValueError, match="give no noise variance"):
        read(file, noise_variance=1.0)
