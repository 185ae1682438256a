"""Shapes on the sky: the same galaxy through any pixels, and pixels that no galaxy can have.

Gaussians sampled at pixel centres: through `u = J x` a covariance C on the sky is one of
`J⁻¹ C J⁻ᵀ` on the image, of the galaxy and of the PSF alike.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from array_api_extra.testing import assert_close, assert_equal

import fdnt_xp as fx
from fdnt_xp.arrays import to_numpy
from fdnt_xp.errors import FdntTypeError, FdntValueError, NamespaceError, ShapeMismatchError
from fdnt_xp.flags import FAILED, Flag, flag_names
from fdnt_xp.fourier import psf as psf_module
from fdnt_xp.fourier.jacobian import (
    is_regular,
    longest_stretch,
    pixel_scale,
    unit_jacobian,
    wave_frame,
)
from fdnt_xp.nulltests.forms import sheared_forms
from images import gaussian_covariance, gaussian_image
from tolerances import tolerance

SCALE = 0.25
PSF = gaussian_covariance((0.1, -0.06), 1.8 * SCALE)


def turn(degrees):
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, -s], [s, c]])


MIRROR = np.diag([-1.0, 1.0])
JACOBIANS = SCALE * np.stack(
    [
        np.eye(2),
        MIRROR,
        turn(40.0),
        np.array([[1.04, 0.07], [0.05, 0.97]]),
        np.diag([1.1, 0.9]),
        turn(-70.0) @ MIRROR @ np.array([[1.05, 0.1], [0.0, 0.94]]),
        1.1 * np.eye(2),
    ]
)
"""The pixels as they are, mirrored, turned, sheared, not square, all of it, larger."""
E = (0.3, -0.2)
OFFSET = np.array([0.12, -0.07])


def image(covariance, jacobian, offset=(0.0, 0.0), shape=(56, 56)):
    """Return a Gaussian on the sky as pixels see it."""
    inverse = np.linalg.inv(jacobian)
    return gaussian_image(inverse @ covariance @ inverse.T, shape, centre=tuple(inverse @ offset))


@pytest.fixture(scope="module")
def drawn():
    """Return one galaxy through each of the Jacobians, and the stars."""
    galaxy = gaussian_covariance(E, 2.2 * SCALE) + PSF
    stamps = np.stack([image(galaxy, j, OFFSET) for j in JACOBIANS])
    return stamps, np.stack([image(PSF, j) for j in JACOBIANS])


# --- the sky, whatever the pixels ----------------------------------------------------


def test_shape_offset_and_size_are_those_on_the_sky(drawn, xp, dtype, to_xp):
    stamps, stars = (to_xp(one, dtype) for one in drawn)
    j = to_xp(JACOBIANS, dtype)
    shapes = fx.measure_shapes(stamps, fx.Psf.from_image(stars), jacobian=j)
    n = len(JACOBIANS)
    assert_close(shapes.e, to_xp(np.tile(E, (n, 1)), dtype), **tolerance("shapes", dtype), xp=xp)
    offset = to_xp(np.tile(OFFSET, (n, 1)), dtype)
    assert_close(shapes.sky_offset, offset, **tolerance("centroids", dtype), xp=xp)
    pixels = 27.5 + np.linalg.solve(JACOBIANS, np.tile(OFFSET, (n, 1))[:, :, None])[:, :, 0]
    assert_close(shapes.centroid, to_xp(pixels, dtype), **tolerance("centroids", dtype), xp=xp)
    size = 2.2 * SCALE * (1.0 - np.sum(np.square(E))) ** 0.25
    assert_close(shapes.size, to_xp(np.full(n, size), dtype), **tolerance("sizes", dtype), xp=xp)


def jacobian_table():
    """Return the rows of the table of docs/conventions.md: Jacobian, and eta on the sky."""
    page = (Path(__file__).parents[1] / "docs" / "conventions.md").read_text(encoding="utf-8")
    table = page.partition(":name: jacobian-table")[2].partition("```")[0]
    rows = [line.strip("|").split("|") for line in table.splitlines() if line.startswith("|")]
    return [([float(c) for c in row[:4]], [float(c) for c in row[5:]]) for row in rows[2:]]


def test_the_table_has_its_rows():
    assert len(jacobian_table()) == 8


@pytest.mark.parametrize(("matrix", "eta"), jacobian_table())
def test_handedness_by_table(matrix, eta):
    norm = 0.5
    e = np.tanh(norm) * np.array([0.4, 0.3]) / norm
    psf = gaussian_covariance((0.1, -0.06), 1.8)
    stamp = gaussian_image(gaussian_covariance(tuple(e), 2.2) + psf)
    star = fx.Psf.from_image(gaussian_image(psf))
    shapes = fx.measure_shapes(stamp[None], star, jacobian=np.reshape(matrix, (2, 2)))
    np.testing.assert_allclose(shapes.eta[0], eta, rtol=0, atol=5e-6)


@pytest.mark.parametrize("transform", ["ft", "gl"])
def test_errors_are_those_of_the_pure_map(transform):
    # Through a turn and a mirror the weight is the same, and so is the galaxy: the errors of
    # eta are those of the image, moved as eta is. eta1' = -eta1 for u along y, v along x.
    stamp = gaussian_image(gaussian_covariance((0.4, 0.1), 2.2) + PSF / SCALE**2)
    psf = fx.Psf.from_image(gaussian_image(PSF / SCALE**2))
    ivar = np.full_like(stamp, 1e8)
    options = {"ivar": ivar[None], "transform": transform}
    plain = fx.measure_shapes(stamp[None], psf, **options)
    j = np.array([[0.0, 1.0], [1.0, 0.0]])
    sky = fx.measure_shapes(stamp[None], psf, jacobian=j, **options)
    moved = np.diag([-1.0, 1.0])
    np.testing.assert_allclose(sky.eta[0], moved @ plain.eta[0], atol=1e-9)
    np.testing.assert_allclose(sky.eta_cov[0], moved @ plain.eta_cov[0] @ moved, rtol=1e-8)
    np.testing.assert_allclose(sky.snr, plain.snr, rtol=1e-9)


def test_errors_do_not_depend_on_the_pixels_but_for_their_number(drawn):
    # Values per pixel go with its area a, counts with 1/a: Cov goes with 1/a at given noise.
    stamps, stars = drawn
    shapes = fx.measure_shapes(
        stamps, fx.Psf.from_image(stars), jacobian=JACOBIANS, noise_variance=1e-8
    )
    area = np.abs(np.linalg.det(JACOBIANS))
    cov = shapes.eta_cov * area[:, None, None]
    # Gaussians of flux 1 are brighter the larger the pixels, which is the same argument.
    np.testing.assert_allclose(cov, np.broadcast_to(cov[0], cov.shape), rtol=3e-5, atol=1e-9)
    even = fx.measure_shapes(
        stamps, fx.Psf.from_image(stars), jacobian=JACOBIANS, ivar=np.full_like(stamps, 1e8)
    )
    np.testing.assert_allclose(even.eta_cov, shapes.eta_cov, rtol=1e-6, atol=1e-12)


def test_a_fixed_size_is_one_on_the_sky(drawn):
    stamps, stars = drawn
    psf = fx.Psf.from_image(stars)
    shapes = fx.measure_shapes(stamps, psf, jacobian=JACOBIANS, size=2.0 * SCALE)
    np.testing.assert_allclose(shapes.size, 2.0 * SCALE, rtol=1e-12)
    np.testing.assert_allclose(shapes.e, np.tile(E, (len(stamps), 1)), atol=2e-6)


def test_elongation_counts_together_with_that_of_the_pixels():
    # |eta| = 0.87 alone is far below 1.5; pixels 4.8 times as wide as high add to it or not.
    j = np.diag([2.2, 1.0 / 2.2])
    psf = 4.0 * PSF / SCALE**2
    e = np.array([[-0.7, 0.0], [0.7, 0.0]])
    stamps = np.stack(
        [image(gaussian_covariance(tuple(one), 5.0) + psf, j, shape=(192, 64)) for one in e]
    )
    star = fx.Psf.from_image(image(psf, j, shape=(192, 64)))
    shapes = fx.measure_shapes(stamps, star, jacobian=j)
    assert ["FINE_GRID" in flag_names(int(flags)) for flags in shapes.flags] == [True, False]
    np.testing.assert_allclose(shapes.e, e, atol=1e-5)


# --- one for all, one for each, some -------------------------------------------------


def test_the_unit_jacobian_changes_nothing(drawn):
    stamps, stars = drawn
    plain = fx.measure_shapes(stamps, fx.Psf.from_image(stars), noise_variance=1e-8)
    sky = fx.measure_shapes(
        stamps, fx.Psf.from_image(stars), noise_variance=1e-8, jacobian=np.eye(2)
    )
    for name in ("eta", "eta_cov", "eg", "centroid", "size", "flux", "snr"):
        np.testing.assert_allclose(getattr(sky, name), getattr(plain, name), rtol=1e-9, atol=1e-11)
    assert plain.sky_offset is None
    np.testing.assert_allclose(sky.sky_offset, sky.centroid - 27.5, atol=1e-12)


@pytest.mark.parametrize("chunk_size", [None, 3])
def test_galaxies_that_share_psfs_and_jacobians(drawn, chunk_size):
    stamps, stars = drawn
    rows = np.array([2, 0, 2, 5, 0, 2, 1, 1, 5])
    alone = fx.measure_shapes(stamps, fx.Psf.from_image(stars), jacobian=JACOBIANS)
    together = fx.measure_shapes(
        stamps[rows],
        fx.Psf.from_image(stars, psf_index=rows),
        jacobian=JACOBIANS[rows],
        chunk_size=chunk_size,
    )
    np.testing.assert_allclose(together.eta, alone.eta[rows], atol=1e-11)
    np.testing.assert_allclose(together.size, alone.size[rows], rtol=1e-10)


def test_one_psf_behind_two_kinds_of_pixels_has_two_tables(drawn):
    _, stars = drawn
    psf = fx.Psf.from_image(stars[0])
    seen = psf.through(JACOBIANS[[0, 3, 0, 0, 3]])
    assert seen.n_psf == 2
    assert seen.n_gal == 5
    assert psf.through(JACOBIANS[[3, 3, 3]]).n_gal is None
    # Pixels of one form but of another size are no other kind.
    assert psf.through(JACOBIANS[[0, 6]]).n_psf == 1


def test_many_galaxies_taken_by_their_psf(drawn):
    # More than 32 to a PSF: chunks by PSF, put back in order; sizes given, pixels of two sizes.
    stamps, stars = drawn
    rows = np.arange(80) % 3
    j = JACOBIANS[[0, 1, 0]] * np.array([1.0, 1.0, 2.0])[:, None, None]
    shapes = fx.measure_shapes(
        stamps[np.array([0, 1, 0])[rows]],
        fx.Psf.from_image(stars[:2], psf_index=np.array([0, 1, 0])[rows]),
        jacobian=j[rows],
        size=0.5,
    )
    np.testing.assert_allclose(shapes.size, 0.5, rtol=1e-12)
    np.testing.assert_allclose(shapes.e, np.tile(E, (80, 1)), atol=5e-6)


@pytest.mark.parametrize(("n", "most"), [(3, 3), (80, 9)], ids=["few", "many"])
def test_nearly_equal_pixels_share_tables_and_nothing_else(n, most, drawn, monkeypatch):
    # Few may have their own: no shape then depends on how alike the others are.
    _, stars = drawn
    made = []
    tables = psf_module.circle_tables

    def counted(image, *args):
        made.append(int(image.shape[0]))
        return tables(image, *args)

    monkeypatch.setattr(psf_module, "circle_tables", counted)
    j = JACOBIANS[0] * (1.0 + np.array([[0.0, 4e-6], [-2e-6, 2e-6]]) * np.arange(n)[:, None, None])
    seen = fx.Psf.from_image(stars[0]).through(j)
    assert made[0] == 1
    assert 1 <= made[1] <= most
    assert seen.n_psf == n
    np.testing.assert_allclose(seen.unit_jacobian[seen.index], unit_jacobian(j), atol=1e-15)


# --- what no galaxy can have ---------------------------------------------------------


@pytest.mark.parametrize(
    "bad", [np.full((2, 2), np.nan), np.zeros((2, 2)), np.ones((2, 2)), np.diag([np.inf, 1.0])]
)
def test_a_bad_jacobian_is_flagged_and_disturbs_nobody(bad, drawn, xp, dtype, to_xp):
    stamps, stars = (to_xp(one, dtype) for one in drawn)
    psf = fx.Psf.from_image(stars)
    good = fx.measure_shapes(stamps, psf, jacobian=to_xp(JACOBIANS, dtype))
    poisoned = JACOBIANS.copy()
    poisoned[2] = bad
    shapes = fx.measure_shapes(stamps, psf, jacobian=to_xp(poisoned, dtype))
    assert flag_names(int(shapes.flags[2])) == ["BAD_JACOBIAN"]
    for name in ("eta", "eta_cov", "eg", "centroid", "sky_offset", "size", "flux", "snr"):
        assert bool(xp.all(xp.isnan(getattr(shapes, name)[2, ...])))
    others = to_xp(np.array([0, 1, 3, 4, 5, 6]))
    assert_close(shapes.take(others).eta, good.take(others).eta, **tolerance("batch", dtype), xp=xp)
    assert int(Flag.BAD_JACOBIAN) & int(FAILED)


def test_a_bad_galaxy_keeps_its_reason_beside(drawn):
    stamps, stars = drawn
    stamps = stamps.copy()
    stamps[1, 3, 3] = np.nan
    j = JACOBIANS.copy()
    j[1] = np.nan
    shapes = fx.measure_shapes(stamps, fx.Psf.from_image(stars), jacobian=j)
    assert flag_names(int(shapes.flags[1])) == ["NON_FINITE_PIXEL", "BAD_JACOBIAN"]


def test_calls_that_mean_nothing(drawn, to_xp, xp):
    stamps, stars = (to_xp(one) for one in drawn)
    psf = fx.Psf.from_image(stars)
    for shape in ((2,), (3, 2), (len(JACOBIANS) - 1, 2, 2), (1, 2, 2), (len(JACOBIANS), 4)):
        with pytest.raises(ShapeMismatchError, match="jacobian must have the shape"):
            fx.measure_shapes(stamps, psf, jacobian=to_xp(np.ones(shape)))
    with pytest.raises(FdntValueError, match="jacobian must be finite and not singular"):
        fx.measure_shapes(stamps, psf, jacobian=to_xp(np.ones((2, 2))))
    with pytest.raises(NamespaceError, match="jacobian"):
        fx.measure_shapes(stamps, psf, jacobian=to_xp(np.eye(2), "float32"))
    with pytest.raises(FdntTypeError):
        fx.measure_shapes(stamps, psf, jacobian="sky")


def test_no_galaxies(drawn):
    psf = fx.Psf.from_image(drawn[1][0])
    shapes = fx.measure_shapes(drawn[0][:0], psf, jacobian=np.eye(2))
    assert shapes.sky_offset.shape == (0, 2)
    assert fx.measure_shapes(drawn[0][:0], psf, jacobian=np.ones((0, 2, 2))).n_gal == 0


# --- the result ----------------------------------------------------------------------


def test_rows_parts_copies_and_the_table(drawn, xp, to_xp):
    stamps, stars = (to_xp(one) for one in drawn)
    shapes = fx.measure_shapes(stamps, fx.Psf.from_image(stars), jacobian=to_xp(JACOBIANS))
    again = fx.ShapeResult.concat(
        [shapes.take(to_xp(np.array([0, 1]))), shapes.take(to_xp(np.arange(2, len(JACOBIANS))))]
    )
    assert_equal(again.sky_offset, shapes.sky_offset, xp=xp)
    table = shapes.to_table()
    np.testing.assert_array_equal(table["u"], to_numpy(shapes.sky_offset)[:, 0])
    np.testing.assert_array_equal(table["v"], to_numpy(shapes.sky_offset)[:, 1])
    assert table["size"].unit is None
    assert str(table["x"].unit) == "pix"
    assert all(table[name].description for name in table.colnames)


# --- the algebra of Jacobians --------------------------------------------------------


def test_scale_frame_and_stretch(xp, dtype, to_xp):
    given = np.concatenate([JACOBIANS, 1e-6 * JACOBIANS, 1e6 * JACOBIANS])
    j = to_xp(given, dtype)
    close = tolerance("algebra", dtype)
    scale = np.sqrt(np.abs(np.linalg.det(given)))
    unit = given / scale[:, None, None]
    assert_close(pixel_scale(j), to_xp(scale, dtype), rtol=close["rtol"], xp=xp)
    assert_close(unit_jacobian(j), to_xp(unit, dtype), **close, xp=xp)
    frame = np.swapaxes(np.linalg.inv(unit), 1, 2)
    assert_close(wave_frame(to_xp(unit, dtype)), to_xp(frame, dtype), **close, xp=xp)
    stretch = np.linalg.svd(unit, compute_uv=False)[:, 0]
    # A root of 1 - 1 = eps is sqrt(eps) off.
    atol = 4.0 * np.sqrt(np.finfo("float32" if "32" in str(dtype) else "float64").eps)
    assert_close(longest_stretch(to_xp(unit, dtype)), to_xp(stretch, dtype), atol=atol, xp=xp)


def test_what_is_regular(to_xp, to_np):
    cases = [
        (np.eye(2), True),
        (1e-20 * MIRROR, True),
        (np.diag([99.0, 1.0]), True),
        (np.diag([101.0, -1.0]), False),
        (np.array([[1.0, 2.0], [2.0, 4.0]]), False),
        (np.zeros((2, 2)), False),
        (np.diag([np.nan, 1.0]), False),
        (np.array([[1.0, -np.inf], [0.0, 1.0]]), False),
    ]
    matrices = to_xp(np.stack([matrix for matrix, _ in cases]))
    assert to_np(is_regular(matrices)).tolist() == [regular for _, regular in cases]


@pytest.mark.parametrize("jacobian", JACOBIANS[3:6] / SCALE)
def test_forms_are_those_of_the_other_wave_numbers(jacobian, xp, dtype, to_xp, to_np):
    frame = to_xp(np.linalg.inv(jacobian).T[None], dtype)
    eta = to_xp(np.array([[0.3, -0.5], [0.0, 0.0], [-1.2, 0.4]]), dtype)
    k = np.array([[0.3, -1.1], [2.0, 0.7], [-0.4, 0.5]])

    def values(form, at):
        monomials = np.stack([at[:, 0] ** 2, at[:, 0] * at[:, 1], at[:, 1] ** 2])
        return to_np(form).astype(float) @ monomials

    there, here = sheared_forms(eta, frame), sheared_forms(eta)
    k_sky = k @ np.linalg.inv(jacobian)  # of rows: A k
    pairs = [*zip(there.forms, here.forms, strict=True)]
    for j in (0, 1):
        pairs += zip(there.slopes[j], here.slopes[j], strict=True)
    rtol = 1e-4 if "32" in str(dtype) else 1e-12
    for one, other in pairs:
        np.testing.assert_allclose(values(one, k), values(other, k_sky), rtol=rtol, atol=rtol)


def test_the_weight_ends_inside_the_grid_and_is_that_of_the_sky():
    # A PSF that the pixels end, and one that ends itself: the latter has one weight.
    sharp = fx.Psf.from_image(image(PSF / 9.0, JACOBIANS[0]))
    wide = fx.Psf.from_image(np.stack([image(2.0 * PSF, j) for j in JACOBIANS[:6]]))
    seen = wide.through(JACOBIANS[:6])
    np.testing.assert_allclose(
        seen.kmax / pixel_scale(JACOBIANS[:6]), seen.kmax[0] / SCALE, rtol=3e-3
    )
    assert seen.largest_kmax < np.pi
    for j in JACOBIANS[3:6]:
        unit = unit_jacobian(j[None])
        ended = sharp.through(j[None])
        # The tables are those of a Jacobian rounded to 1/8192.
        np.testing.assert_allclose(ended.kmax, np.pi / longest_stretch(unit), rtol=3e-4)
        assert ended.largest_kmax == pytest.approx(np.pi, rel=3e-4)
        assert ended.largest_kmax <= np.pi
