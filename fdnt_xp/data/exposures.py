"""Many stamps of each object, gathered for `measure_exposures`.

An `Exposure` is one stamp with all that is known of it, an `ExposureBatch` the stamps of many
objects in one array. Stamps of several sizes become equal by missing pixels, of inverse
variance 0, above and to the right, so that the coordinates on each stay what they are.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fdnt_xp.arrays import Array, array_namespace, device_of
from fdnt_xp.errors import FdntTypeError, FdntValueError, ShapeMismatchError
from fdnt_xp.fourier.psf import Psf


@dataclass(frozen=True, kw_only=True)
class Exposure:
    """One stamp of an object.

    Parameters
    ----------
    image : array, shape (ny, nx)
        Background taken off.
    star : array, shape (py, px)
        Its PSF at this place, pixel response included, of any normalisation. Exposures with
        the same pixels here share its tables.
    jacobian : array, shape (2, 2), optional
        `d(u, v)/d(x, y)`; the unit matrix without it.
    origin : (float, float), optional
        (x, y) on the stamp of where the object is said to be, 0-based, integer at pixel
        centres; the middle of the stamp without it.
    ivar : array, shape (ny, nx), optional
        Inverse variance of each pixel, 0 where it is missing.
    noise_variance : float, optional
        In place of `ivar`: that of every pixel.
    band : int
        Number of the filter, from 0.

    Raises
    ------
    ShapeMismatchError
        If `image` or `star` is no image, or `ivar` or `jacobian` has another shape than it
        must have.
    FdntTypeError
        If `image`, `star` or `ivar` does not hold real numbers.
    FdntValueError
        If both `ivar` and `noise_variance` are given, or the latter is not positive.
    """

    image: NDArray[Any]
    star: NDArray[Any]
    jacobian: NDArray[Any] | None = None
    origin: tuple[float, float] | None = None
    ivar: NDArray[Any] | None = None
    noise_variance: float | None = None
    band: int = 0

    def __post_init__(self) -> None:
        for name in ("image", "star", "ivar"):
            if (given := getattr(self, name)) is not None:
                object.__setattr__(self, name, _numbers(given, name))
        for name, pixels in (("image", self.image), ("star", self.star)):
            if pixels.ndim != 2 or 0 in pixels.shape:
                raise ShapeMismatchError(f"{name} must have the shape (ny, nx), not {pixels.shape}")
        if self.ivar is not None and self.ivar.shape != self.image.shape:
            raise ShapeMismatchError(
                f"ivar must have the shape of the image, {self.image.shape}, not {self.ivar.shape}"
            )
        if self.jacobian is not None and np.shape(self.jacobian) != (2, 2):
            raise ShapeMismatchError(
                f"jacobian must have the shape (2, 2), not {np.shape(self.jacobian)}"
            )
        if self.noise_variance is not None and self.ivar is not None:
            raise FdntValueError("ivar and noise_variance cannot both be given for a stamp")
        if self.noise_variance is not None and not 0 < self.noise_variance < np.inf:
            raise FdntValueError(f"noise_variance must be positive, not {self.noise_variance}")


@dataclass(frozen=True, kw_only=True)
class ExposureBatch:
    """Stamps of several objects, as `measure_exposures` takes them; NumPy arrays all.

    Parameters
    ----------
    ids : array, shape (n_objects,)
        Names or numbers of the objects, those without a stamp included.
    object_index : array, shape (n_stamp,), int64
        Whose stamp each is, a row of `ids`.
    stamps : array, shape (n_stamp, ny, nx), floating
    stars : array, shape (n_psf, py, px), floating
        The different PSFs.
    psf_index : array, shape (n_stamp,), int64
        Which of them each stamp has.
    origin : array, shape (n_stamp, 2)
        (x, y) on each stamp of where its object is said to be.
    jacobian : array, shape (n_stamp, 2, 2)
        `d(u, v)/d(x, y)` of each.
    ivar : array, shape (n_stamp, ny, nx), optional
        Inverse variance, 0 where a pixel is missing.
    noise_variance : array, shape (n_stamp,), optional
        In place of `ivar`.
    band : array, shape (n_stamp,), int64, optional
        Number of the filter; without it all are of one.

    Raises
    ------
    ShapeMismatchError
        If one of them does not fit the others.
    """

    ids: NDArray[Any]
    object_index: NDArray[np.int64]
    stamps: NDArray[np.floating[Any]]
    stars: NDArray[np.floating[Any]]
    psf_index: NDArray[np.int64]
    origin: NDArray[np.floating[Any]]
    jacobian: NDArray[np.floating[Any]]
    ivar: NDArray[np.floating[Any]] | None = None
    noise_variance: NDArray[np.floating[Any]] | None = None
    band: NDArray[np.int64] | None = None

    def __post_init__(self) -> None:
        n = len(self.stamps)
        expected = {
            "object_index": (n,),
            "psf_index": (n,),
            "origin": (n, 2),
            "jacobian": (n, 2, 2),
            "ivar": self.stamps.shape,
            "noise_variance": (n,),
            "band": (n,),
        }
        for name, shape in expected.items():
            array = getattr(self, name)
            if array is not None and array.shape != shape:
                raise ShapeMismatchError(
                    f"{name} must have the shape {shape} for stamps of the shape "
                    f"{self.stamps.shape}, not {array.shape}"
                )

    @property
    def n_objects(self) -> int:
        """Number of objects, those without a stamp included."""
        return len(self.ids)

    @property
    def n_stamps(self) -> int:
        """Number of stamps."""
        return len(self.stamps)

    @classmethod
    def of(
        cls, objects: Sequence[Sequence[Exposure]], ids: Sequence[Any] | None = None
    ) -> ExposureBatch:
        """Gather the exposures of objects: a list for each, of any length.

        Parameters
        ----------
        objects : sequence of sequences of Exposure
            An object without exposures keeps its row.
        ids : sequence, shape (n_objects,), optional
            Row numbers without it.

        Raises
        ------
        FdntValueError
            If the noise of only some stamps is known, or of none and stamps of several sizes
            are to be made equal by missing pixels.
        ShapeMismatchError
            If there is another number of `ids`.

        Notes
        -----
        Stamps are float32 if all images are, else float64.
        """
        names = np.arange(len(objects)) if ids is None else np.asarray(ids)
        if names.shape != (len(objects),):
            raise ShapeMismatchError(f"there are {names.size} ids but {len(objects)} objects")
        flat = [one for exposures in objects for one in exposures]
        single = bool(flat) and all(one.image.dtype.name == "float32" for one in flat)
        dtype = np.dtype("float32" if single else "float64")
        padded = pad_to_one_shape([one.star for one in flat] or [np.ones((1, 1))], dtype)
        stars, psf_index = distinct_stars(padded)
        batch = cls(
            ids=names,
            object_index=np.repeat(np.arange(len(objects)), [len(one) for one in objects]),
            stamps=pad_to_one_shape([one.image for one in flat], dtype),
            stars=stars,
            psf_index=psf_index[: len(flat)],
            origin=np.array([_origin(one) for one in flat], dtype=dtype).reshape(-1, 2),
            jacobian=np.array([_jacobian(one) for one in flat], dtype=dtype).reshape(-1, 2, 2),
            band=_bands(flat),
        )
        return replace(batch, **_noise(flat, dtype))

    def arguments(
        self, convert: Callable[[NDArray[Any]], Array] = np.asarray, *, oversampling: float = 1.0
    ) -> dict[str, Any]:
        """Return the arguments of `measure_exposures`.

        Parameters
        ----------
        convert : callable
            Takes a NumPy array to the library, dtype and device to compute with.
        oversampling : float
            Pixels of `stars` per pixel of the stamps, along one axis.

        Examples
        --------
        `fx.measure_exposures(**batch.arguments(torch.from_numpy))`
        """
        stamps = convert(self.stamps)
        xp, device = array_namespace(stamps=stamps), device_of(stamps)

        def numbers(array: NDArray[np.int64]) -> Array:
            return xp.asarray(array, dtype=xp.int64, device=device)

        floating = {name: getattr(self, name) for name in ("origin", "jacobian", *_NOISE)}
        given = {name: convert(a) for name, a in floating.items() if a is not None}
        if self.band is not None:
            given["band"] = numbers(self.band)
        return {
            "stamps": stamps,
            "psf": Psf.from_image(
                convert(self.stars), psf_index=numbers(self.psf_index), oversampling=oversampling
            ),
            "object_index": numbers(self.object_index),
            "n_objects": self.n_objects,
            **given,
        }


_NOISE = ("ivar", "noise_variance")


def pad_to_one_shape(
    images: Sequence[NDArray[Any]], dtype: np.dtype[Any]
) -> NDArray[np.floating[Any]]:
    """Return images of several shapes as one array, with zeros above and to the right.

    Parameters
    ----------
    images : sequence of arrays, shapes (ny, nx)
    dtype : numpy.dtype

    Returns
    -------
    array, shape (n, largest ny, largest nx)
        Of one pixel each if there are none.
    """
    ny, nx = np.max([image.shape for image in images], axis=0) if images else (1, 1)
    padded = np.zeros((len(images), ny, nx), dtype=dtype)
    for place, image in zip(padded, images, strict=True):
        place[: image.shape[0], : image.shape[1]] = image
    return padded


def distinct_stars(
    stars: NDArray[np.floating[Any]],
) -> tuple[NDArray[np.floating[Any]], NDArray[np.int64]]:
    """Return the different stars of a stack, and which of them each is.

    Parameters
    ----------
    stars : array, shape (n, py, px)

    Returns
    -------
    stars : array, shape (n_psf, py, px)
    psf_index : array, shape (n,), int64

    Notes
    -----
    To compare the pixels costs next to nothing beside the tables that `Psf` makes of a star.
    """
    numbers: dict[bytes, int] = {}
    index = [numbers.setdefault(star.tobytes(), len(numbers)) for star in stars]
    _, first = np.unique(index, return_index=True)
    return stars[first], np.array(index, dtype=np.int64)


def _numbers(pixels: Any, name: str) -> NDArray[Any]:
    array = np.asarray(pixels)
    if array.dtype.kind not in "biuf":
        raise FdntTypeError(f"{name} must hold real numbers, but has dtype {array.dtype}")
    return array


def _origin(one: Exposure) -> tuple[float, float]:
    ny, nx = one.image.shape
    return ((nx - 1) / 2, (ny - 1) / 2) if one.origin is None else one.origin


def _jacobian(one: Exposure) -> NDArray[Any]:
    return np.eye(2) if one.jacobian is None else np.asarray(one.jacobian)


def _bands(flat: Sequence[Exposure]) -> NDArray[np.int64] | None:
    """Return the band of each stamp, or None if there is but the first."""
    bands = np.array([one.band for one in flat], dtype=np.int64)
    return bands if np.any(bands) else None


def _noise(flat: Sequence[Exposure], dtype: np.dtype[Any]) -> dict[str, NDArray[Any]]:
    """Return the inverse variances of all stamps, or their variances, or nothing."""
    known = [one.ivar is not None or one.noise_variance is not None for one in flat]
    uneven = len({one.image.shape for one in flat}) > 1
    check_known(known, uneven)
    if not any(known):
        return {}
    if not uneven and all(one.ivar is None for one in flat):
        return {"noise_variance": np.array([one.noise_variance for one in flat], dtype=dtype)}
    maps = [
        np.full(one.image.shape, 1.0 / (one.noise_variance or 1.0))
        if one.ivar is None
        else one.ivar
        for one in flat
    ]
    return {"ivar": pad_to_one_shape(maps, dtype)}


def check_known(known: Sequence[bool], uneven: bool) -> None:
    """Refuse noise that is known of some alone, or not known where it is needed."""
    if not any(known) and uneven:
        raise FdntValueError(
            "stamps of several sizes are made equal by missing pixels, which needs the noise "
            "of the others: give ivar or noise_variance"
        )
    if any(known) and not all(known):
        raise FdntValueError(
            f"{known.count(False)} of {len(known)} have neither ivar nor noise_variance; give it "
            "for all or for none"
        )
