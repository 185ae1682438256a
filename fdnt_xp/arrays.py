"""The door for arrays: which library they belong to, and that they agree.

This is the only module that imports `array_api_compat` or `array_api_extra`. A public
function calls `array_namespace` once, at its boundary, and hands `xp` down; kernels
never learn which library they run on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, is_dataclass, replace
from types import ModuleType
from typing import Any, Final, TypeAlias, TypeVar, cast

import array_api_compat
import numpy as np

from fdnt_xp.errors import FdntTypeError, NamespaceError

Array: TypeAlias = Any
"""An array of any library that follows the Array API standard."""
Rows: TypeAlias = "slice | Array"
_Part = TypeVar("_Part")
"""Some of the rows of an array: a range, or an integer array."""
Device: TypeAlias = Any
DType: TypeAlias = Any

_NUMBERS_IN_CACHE: Final = 2**16
"""Of an array that is used again before it is pushed out, together with a few others."""
_CALLS_COST: Final = 4
"""How much larger blocks are where a call takes longer than one of NumPy's."""

_FEW_ROWS: Final = 4
"""Of a block where the work on one fills the cache."""

_NAMESPACES: Final[dict[type, ModuleType]] = {}


def array_namespace(**arrays: Array | None) -> ModuleType:
    """Return the Array API namespace that all the named arrays share.

    Parameters
    ----------
    **arrays : array or None
        The arguments by name; None is passed over.

    Raises
    ------
    FdntTypeError
        If an argument is not an array.
    NamespaceError
        If two arguments belong to different libraries or devices; both are named.
    """
    first: tuple[str, ModuleType, Array] | None = None
    for name, array in arrays.items():
        if array is None:
            continue
        xp = _NAMESPACES.get(type(array)) or _namespace_of(name, array)
        if first is None:
            first = (name, xp, array)
        elif xp is not first[1]:
            raise NamespaceError(
                f"{name} is a {_library(xp)} array but {first[0]} is a {_library(first[1])} "
                "array; convert one of them, nothing is moved silently"
            )
        elif (where := device_of(array)) != (expected := device_of(first[2])):
            raise NamespaceError(
                f"{name} is on device {where} but {first[0]} is on {expected}; move one of them"
            )
    if first is None:
        raise FdntTypeError("at least one array is needed to choose the library")
    return first[1]


def _namespace_of(name: str, array: Array) -> ModuleType:
    """Find out about a type of arrays, once: small kernels ask thousands of times a second."""
    if not is_array(array):
        raise FdntTypeError(
            f"{name} must be an array (numpy, torch, jax, cupy, ...), not {type(array).__name__}"
        )
    xp: ModuleType = array_api_compat.array_namespace(array)
    _NAMESPACES[type(array)] = xp
    return xp


def is_array(value: object) -> bool:
    """Return whether something is an array of a library that is understood."""
    return bool(array_api_compat.is_array_api_obj(value))


def require_dtype(dtype: DType, **arrays: Array | None) -> None:
    """Raise `NamespaceError` if one of the named arrays is not of `dtype`."""
    for name, array in arrays.items():
        if array is not None and array.dtype != dtype:
            raise NamespaceError(
                f"{name} has dtype {array.dtype}, expected {dtype}; cast one of them"
            )


def has_any(flags: Array, bits: int) -> Array:
    """Return where integers hold at least one of some bits; bool, of the shape of `flags`."""
    xp = array_namespace(flags=flags)
    return xp.bitwise_and(flags, xp.full_like(flags, bits)) != 0


def count_true(where: Array) -> int:
    """Return how many elements are true, on the host."""
    xp = array_namespace(where=where)
    return int(xp.sum(xp.astype(where, xp.int64)))


def rows_of(array: Array, rows: Rows) -> Array:
    """Return some rows of an array; a range of them is a view where the library has views."""
    if isinstance(rows, slice):
        return array[rows, ...]
    return array_namespace(rows=rows).take(array, rows, axis=0)


def joined(parts: Sequence[_Part]) -> _Part:
    """Return the rows of all parts, at least one: arrays, or records of arrays field by field."""
    first: Any = parts[0]
    if len(parts) == 1:
        return parts[0]
    if is_dataclass(first) and not isinstance(first, type):
        names = [field.name for field in fields(first)]
        columns = {name: joined([getattr(part, name) for part in parts]) for name in names}
        return cast("_Part", replace(first, **columns))
    return cast("_Part", array_namespace(first=first).concat(list(parts), axis=0))


def works_in_blocks(array: Array) -> bool:
    """Return whether many rows are faster a few at a time: on a CPU, for its cache.

    Not where each length of a batch is compiled anew.
    """
    on_cpu = "cpu" in str(device_of(array)).lower()
    return on_cpu and not compiles_every_shape(array_namespace(array=array))


def blocks_in_cache(array: Array, more: int = 1) -> list[slice]:
    """Return ranges of the rows of an (n, m) array to be worked at one at a time.

    There is always one, be it empty. With `more` the work on a row needs so many times its
    length: blocks then have at least a few rows, which share what a call costs.
    """
    n, m = (int(length) for length in array.shape)
    least = 1 if more == 1 else _FEW_ROWS
    numbers = _NUMBERS_IN_CACHE * (1 if isinstance(array, np.ndarray) else _CALLS_COST)
    rows = max(least, numbers // max(m * more, 1))
    rows = rows if works_in_blocks(array) else max(n, 1)
    return [slice(first, min(first + rows, n)) for first in range(0, max(n, 1), rows)]


def as_floating(xp: ModuleType, array: Array, name: str) -> Array:
    """Return `array` as real floating point, in native byte order and positive strides.

    Integer and boolean arrays become the library's float64. NumPy arrays of foreign byte
    order, as FITS readers give them, are swapped. Complex input is refused, and so are masked
    elements.
    """
    if isinstance(array, np.ma.MaskedArray) and np.ma.is_masked(array):
        raise FdntTypeError(
            f"{name} is a masked array, and its mask would be lost: fill it, and say what is "
            "missing by an ivar of 0, or by mask"
        )
    if isinstance(array, np.ndarray):
        array = np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("="))
    if xp.isdtype(array.dtype, "complex floating"):
        raise FdntTypeError(f"{name} must be real, but has dtype {array.dtype}")
    if not xp.isdtype(array.dtype, "real floating"):
        array = xp.astype(array, xp.float64)
    elif array.dtype not in (xp.float32, xp.float64):
        wider = xp.finfo(array.dtype).bits > 64
        array = xp.astype(array, xp.float64 if wider else xp.float32)
    return array


def device_of(array: Array) -> Device:
    """Return the device on which an array lives."""
    return array_api_compat.device(array)


def compiles_every_shape(xp: ModuleType) -> bool:
    """Return whether each operation is compiled anew for each shape of its arguments (JAX)."""
    return _library(xp) == "jax"


def to_numpy(array: Array) -> np.ndarray[Any, Any]:
    """Copy an array to the host. For results and reports, never inside a kernel."""
    if array_api_compat.is_torch_array(array):
        return np.array(array.numpy(force=True))
    if array_api_compat.is_cupy_array(array):
        return np.array(array.get())
    try:
        return np.array(array)
    except (TypeError, RuntimeError, ValueError):
        # array_api_strict refuses to export from its pretended devices: go through its CPU.
        xp = array_api_compat.array_namespace(array)
        return np.array(xp.asarray(array, device=xp.Device("CPU_DEVICE")))


def _library(xp: ModuleType) -> str:
    return xp.__name__.removeprefix("array_api_compat.").split(".")[0]
