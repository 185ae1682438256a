"""The door for arrays: libraries, devices and dtypes are told apart, nothing moves silently."""

from __future__ import annotations

import array_api_compat.numpy as compat_numpy
import array_api_strict
import numpy as np
import pytest
from array_api_extra.testing import assert_equal

from fdnt_xp.arrays import (
    array_namespace,
    as_floating,
    compiles_every_shape,
    count_true,
    device_of,
    has_any,
    require_dtype,
    to_numpy,
)
from fdnt_xp.errors import FdntTypeError, NamespaceError

# --- array_namespace -----------------------------------------------------------------


def test_namespace_is_that_of_the_arrays(xp, to_xp):
    assert array_namespace(stamps=to_xp([1.0]), psf=None, noise=to_xp([2.0])) is xp


def test_two_libraries_are_refused_by_name():
    with pytest.raises(NamespaceError, match=r"psf is a array_api_strict .* stamps is a numpy"):
        array_namespace(stamps=np.ones(3), psf=array_api_strict.ones(3))


def test_two_devices_are_refused_by_name():
    there = array_api_strict.ones(3, device=array_api_strict.Device("device1"))
    with pytest.raises(NamespaceError, match=r"psf is on device .*device1.* stamps is on .*CPU"):
        array_namespace(stamps=array_api_strict.ones(3), psf=there)


@pytest.mark.parametrize("thing", [3.0, [1.0, 2.0], "array", (), {}])
def test_what_is_no_array_is_refused_by_name(thing):
    with pytest.raises(FdntTypeError, match=f"stamps must be an array.*{type(thing).__name__}"):
        array_namespace(stamps=thing)


def test_no_array_at_all_is_refused():
    with pytest.raises(FdntTypeError, match="at least one array"):
        array_namespace(stamps=None)


# --- require_dtype -------------------------------------------------------------------


def test_equal_dtypes_pass(xp, dtype, to_xp):
    require_dtype(dtype, stamps=to_xp([1.0], dtype), psf=None)


def test_another_dtype_is_refused_by_name(xp, to_xp):
    with pytest.raises(NamespaceError, match=r"psf has dtype .*float32, expected .*float64"):
        require_dtype(xp.float64, stamps=to_xp([1.0]), psf=to_xp([1.0], "float32"))


# --- as_floating ---------------------------------------------------------------------


def test_floats_stay_as_they_are(xp, dtype, to_xp):
    array = to_xp([[1.5, -2.0]], dtype)
    assert_equal(as_floating(xp, array, "stamps"), array, xp=xp)


@pytest.mark.parametrize("kind", ["int16", "int32", "int64", "uint8", "bool"])
def test_integers_become_float64(kind, xp, to_xp):
    actual = as_floating(xp, to_xp([[0, 1], [1, 0]], kind), "stamps")
    assert_equal(actual, to_xp([[0.0, 1.0], [1.0, 0.0]]), xp=xp)


def test_complex_is_refused_by_name(xp, to_xp):
    with pytest.raises(FdntTypeError, match=r"stamps must be real, but has dtype .*complex"):
        as_floating(xp, to_xp([1.0 + 1.0j]), "stamps")


@pytest.mark.parametrize(
    "array",
    [
        np.arange(6.0).astype(">f8"),
        np.arange(6.0)[::-1],
        np.arange(12.0)[::2],
        np.arange(6).astype(">i2"),
        np.arange(6.0).reshape(2, 3).T,
    ],
    ids=["big-endian", "negative stride", "stride", "big-endian integer", "transposed"],
)
def test_numpy_arrays_are_straightened(array):
    actual = as_floating(compat_numpy, array, "stamps")
    assert actual.dtype == np.float64
    assert actual.dtype.isnative
    assert actual.flags.c_contiguous
    np.testing.assert_array_equal(actual, array)


@pytest.mark.parametrize(
    ("given", "expected"),
    [(">f4", np.float32), (np.float16, np.float32), (np.longdouble, np.float64)],
)
def test_unusual_precisions_become_the_nearest_usual(given, expected):
    assert as_floating(compat_numpy, np.ones(3, dtype=given), "stamps").dtype == expected


def test_a_mask_is_not_lost():
    masked = np.ma.masked_greater(np.arange(4.0), 2.5)
    with pytest.raises(FdntTypeError, match="stamps is a masked array"):
        as_floating(compat_numpy, masked, "stamps")
    nothing = as_floating(compat_numpy, np.ma.masked_greater(np.arange(4.0), 9.0), "stamps")
    np.testing.assert_array_equal(nothing, np.arange(4.0))


# --- devices and the way back --------------------------------------------------------


def test_device_is_where_the_array_was_made(device, to_xp):
    assert device_of(to_xp([1.0])) == device


@pytest.mark.parametrize("kind", ["float64", "float32", "int32", "bool", "complex128"])
def test_there_and_back(kind, to_xp):
    host = np.array([[0, 1], [1, 0]]).astype(kind)
    back = to_numpy(to_xp(host))
    assert type(back) is np.ndarray
    assert back.dtype == host.dtype
    np.testing.assert_array_equal(back, host)


def test_the_copy_on_the_host_is_a_copy(xp, to_xp):
    there = to_xp([1.0, 2.0])
    host = to_numpy(there)
    host[0] = 9.0
    assert_equal(there, to_xp([1.0, 2.0]), xp=xp)


# --- what a library is like ----------------------------------------------------------


def test_only_jax_compiles_every_shape(backend, to_xp):
    namespace = array_namespace(stamps=to_xp([1.0]))
    assert compiles_every_shape(namespace) is (backend.library == "jax")


# --- bits and counts -----------------------------------------------------------------


def test_bits_of_flags(xp, to_xp):
    flags = to_xp(np.array([0, 1, 2, 6, 2**23], dtype=np.int32))
    assert_equal(has_any(flags, 2 + 2**23), to_xp([False, False, True, True, True]), xp=xp)
    assert count_true(has_any(flags, 3)) == 3
    assert count_true(has_any(flags, 8)) == 0
