"""`ShapeResult`: one row for each galaxy, in the library it was asked in."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from array_api_extra.testing import assert_close, assert_equal

import fdnt_xp as fx
from fdnt_xp.arrays import device_of
from fdnt_xp.flags import FAILED, INFORMATION, Flag
from fdnt_xp.nulltests.dogleg import Status
from fdnt_xp.shapes.results import COLUMNS
from tolerances import tolerance

ETA = np.array([[0.0, 0.0], [0.6, -0.3], [np.nan, np.nan]])


@pytest.fixture
def shapes(to_xp, dtype):
    def column(values):
        return to_xp(np.array(values, dtype=float), dtype)

    def code(values):
        return to_xp(np.array(values), "int32")

    return fx.ShapeResult(
        eta=column(ETA),
        eta_cov=column(np.arange(12.0).reshape(3, 2, 2)),
        eg=column([0.0, 0.1, np.nan]),
        centroid=column([[1.0, 2.0], [3.0, 4.0], [np.nan, np.nan]]),
        size=column([1.5, 2.5, np.nan]),
        flux=column([10.0, 20.0, np.nan]),
        snr=column([100.0, 200.0, np.nan]),
        flags=code([0, int(Flag.SIZE_AT_BOUND), int(Flag.NO_SIGNAL)]),
        n_iter=code([4, 5, 6]),
        status=code([0, 0, 4]),
        masked_fraction=column([0.0, 0.25, 1.0]),
    )


def test_views_of_eta(shapes, xp, dtype, to_xp):
    norm = np.hypot(0.6, 0.3)
    for view, function in ((shapes.e, np.tanh(norm)), (shapes.g, np.tanh(norm / 2.0))):
        expected = np.array([[0.0, 0.0], function * ETA[1] / norm, [np.nan, np.nan]])
        assert_close(view, to_xp(expected, dtype), **tolerance("algebra", dtype), xp=xp)


def test_measured_is_what_no_failure_flag_denies(shapes, to_np):
    assert to_np(shapes.measured).tolist() == [True, True, False]
    assert int(Flag.SIZE_AT_BOUND) & int(FAILED) == 0


def test_rows_are_taken_in_the_order_asked_for(shapes, xp, to_xp):
    taken = shapes.take(to_xp(np.array([1, 0, 1])))
    assert taken.n_gal == 3
    for name in shapes.columns():
        whole, part = getattr(shapes, name), getattr(taken, name)
        for i, row in enumerate((1, 0, 1)):
            assert_equal(part[i, ...], whole[row, ...], xp=xp)


def test_joining_the_parts_gives_the_whole(shapes, xp, to_xp):
    parts = [shapes.take(to_xp(np.array(rows))) for rows in ([0], [1, 2])]
    joined = fx.ShapeResult.concat(parts)
    for name in shapes.columns():
        assert_equal(getattr(joined, name), getattr(shapes, name), xp=xp)


def test_nothing_is_measured_until_it_is(xp, dtype, device, to_xp, to_np):
    nothing = fx.ShapeResult.unmeasured(to_xp(np.zeros((2, 5, 7)), dtype))
    for name in nothing.columns():
        values = getattr(nothing, name)
        assert values.shape[0] == 2
        if xp.isdtype(values.dtype, "real floating"):
            assert values.dtype == dtype
            assert bool(xp.all(xp.isnan(values)))
    assert to_np(nothing.flags).tolist() == [int(Flag.NO_ATTEMPT)] * 2
    assert not np.any(to_np(nothing.measured))


def test_the_copy_on_the_host(shapes, to_np):
    host = shapes.to_numpy()
    for name in shapes.columns():
        assert type(getattr(host, name)) is np.ndarray
        np.testing.assert_array_equal(getattr(host, name), to_np(getattr(shapes, name)))


def test_the_table_has_a_unit_or_a_description_for_every_column(shapes, to_np):
    table = shapes.to_table()
    assert table.colnames == list(COLUMNS)
    for name in table.colnames:
        assert table[name].description
    assert {name for name in table.colnames if table[name].unit is not None} == {"x", "y", "size"}
    assert str(table["size"].unit) == "pix"
    np.testing.assert_array_equal(table["eta2"], to_np(shapes.eta)[:, 1])
    np.testing.assert_array_equal(table["eta12_cov"], to_np(shapes.eta_cov)[:, 0, 1])
    np.testing.assert_array_equal(table["e1"], to_np(shapes.e)[:, 0])
    np.testing.assert_array_equal(table["y"], to_np(shapes.centroid)[:, 1])


def test_nothing_is_missing_unless_said(shapes, xp):
    given = {name: getattr(shapes, name) for name in shapes.columns() if name != "masked_fraction"}
    whole = fx.ShapeResult(**given)
    assert_equal(whole.masked_fraction, xp.zeros_like(shapes.masked_fraction), xp=xp)


# --- no rows, every column, every flag -----------------------------------------------


def test_no_rows_are_a_result_too(shapes, xp, to_xp):
    nothing = shapes.take(to_xp(np.empty(0, dtype=np.int64)))
    assert nothing.n_gal == 0
    assert nothing.e.shape == nothing.g.shape == (0, 2)
    assert nothing.to_table().colnames == list(COLUMNS)
    whole = fx.ShapeResult.concat([nothing, shapes, nothing])
    for name in shapes.columns():
        assert_equal(getattr(whole, name), getattr(shapes, name), xp=xp)
        assert getattr(nothing, name).dtype == getattr(shapes, name).dtype


@pytest.mark.parametrize("n_gal", [0, 2])
def test_what_is_unmeasured_fits_what_is_measured(n_gal, shapes, xp, dtype, device, to_xp, to_np):
    nothing = fx.ShapeResult.unmeasured(to_xp(np.zeros((n_gal, 5, 7)), dtype))
    for name in nothing.columns():
        ours, theirs = getattr(nothing, name), getattr(shapes, name)
        assert ours.shape == (n_gal, *theirs.shape[1:])
        assert ours.dtype == theirs.dtype
        assert device_of(ours) == device
    assert to_np(nothing.status).tolist() == [int(Status.RUNNING)] * n_gal
    assert to_np(nothing.n_iter).tolist() == [0] * n_gal
    assert fx.ShapeResult.concat([shapes, nothing]).n_gal == 3 + n_gal


def test_each_flag_either_fails_or_informs(to_xp, to_np):
    empty = fx.ShapeResult.unmeasured(to_xp(np.zeros((len(Flag), 2, 2))))
    bits = np.array([int(flag) for flag in Flag], dtype=np.int32)
    informs = [bool(flag & INFORMATION) for flag in Flag]
    assert to_np(replace(empty, flags=to_xp(bits)).measured).tolist() == informs
    # Information does not make up for a failure.
    both = to_xp(bits | np.int32(INFORMATION))
    assert to_np(replace(empty, flags=both).measured).tolist() == informs


def test_the_copy_on_the_host_is_a_copy(shapes, to_np):
    shapes.to_numpy().size[0] = -1.0
    assert to_np(shapes.size)[0] == 1.5


def test_every_column_of_the_table_is_its_own(shapes, to_np):
    table = shapes.to_table()
    given = {name: to_np(column) for name, column in shapes.columns().items()}
    e, g = to_np(shapes.e), to_np(shapes.g)
    expected = {
        "x": given["centroid"][:, 0],
        "y": given["centroid"][:, 1],
        "eta1": given["eta"][:, 0],
        "eta2": given["eta"][:, 1],
        "eta1_var": given["eta_cov"][:, 0, 0],
        "eta2_var": given["eta_cov"][:, 1, 1],
        "eta12_cov": given["eta_cov"][:, 0, 1],
        "e1": e[:, 0],
        "e2": e[:, 1],
        "g1": g[:, 0],
        "g2": g[:, 1],
    } | {name: column for name, column in given.items() if column.ndim == 1}
    assert set(expected) == set(COLUMNS)
    for name, column in expected.items():
        # The views are computed again, on the host.
        np.testing.assert_allclose(table[name], column, rtol=1e-6, atol=0.0, err_msg=name)
        assert table[name].dtype == column.dtype
