"""Shape methods by name, for what runs several of them side by side: ring tests, figures."""

from __future__ import annotations

from functools import partial
from typing import Final, Protocol

from fdnt_xp.arrays import Array
from fdnt_xp.errors import FdntValueError
from fdnt_xp.fourier.psf import Psf
from fdnt_xp.shapes.measure import Transform, measure_shapes
from fdnt_xp.shapes.results import ShapeResult


class ShapeMethod(Protocol):
    """What every method can be called with; see `measure_shapes` for what it means."""

    def __call__(
        self,
        stamps: Array,
        psf: Psf,
        *,
        noise_variance: float | Array | None = None,
        ivar: Array | None = None,
        size: float | None = None,
        padding: int = 1,
        chunk_size: int | None = None,
    ) -> ShapeResult:
        """Measure the galaxy on each stamp."""


_TRANSFORMS: Final[dict[str, Transform]] = {
    "fdnt-ft": "ft",
    "fdnt-gl": "gl",
    "fdnt-hybrid": "hybrid",
}
"""What they are of `measure_shapes`."""
NULL_TEST_METHODS: Final = tuple(_TRANSFORMS)
"""Methods that take a `jacobian` and a `noise_power`, as `measure_shapes` does."""

SHAPE_METHODS: dict[str, ShapeMethod] = {
    "fdnt-ft": measure_shapes,
    "fdnt-gl": partial(measure_shapes, transform="gl"),
    "fdnt-hybrid": partial(measure_shapes, transform="hybrid"),
}
"""By name; `register_shape_method` adds to it."""


def method_in_noise(name: str, power: Array) -> ShapeMethod | None:
    """Return the method of a name for noise of a power spectrum; None if it knows white noise only.

    Parameters
    ----------
    name : str
    power : array, shape (ny, nx)
        As `measure_shapes` takes it; no other noise may be given with the call.
    """
    if name not in _TRANSFORMS:
        return None
    return partial(measure_shapes, transform=_TRANSFORMS[name], noise_power=power)


def register_shape_method(name: str, method: ShapeMethod) -> None:
    """Give a method a name.

    Parameters
    ----------
    name : str
        Lower case, as it is to be typed: "fdnt-gl".
    method : callable
        Called as `measure_shapes` is, and returns a `ShapeResult`. Its `eg` may be zero
        throughout where the method knows no ellipticity gradient.

    Raises
    ------
    FdntValueError
        If the name is taken by another method.
    """
    if SHAPE_METHODS.get(name, method) is not method:
        raise FdntValueError(f"the name {name!r} belongs to another shape method already")
    SHAPE_METHODS[name] = method


def shape_method(name: str) -> ShapeMethod:
    """Return the method of a name.

    Raises
    ------
    FdntValueError
        If there is none; the message lists those that are there.

    Examples
    --------
    >>> from fdnt_xp.shapes.methods import shape_method
    >>> shape_method("fdnt-ft").__name__
    'measure_shapes'
    """
    if name not in SHAPE_METHODS:
        raise FdntValueError(f"no shape method {name!r}; known are {', '.join(SHAPE_METHODS)}")
    return SHAPE_METHODS[name]
