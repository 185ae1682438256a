"""Exposures from what other codes hold: GalSim images, and observations as ngmix has them.

Neither library is imported: what has the attributes will do.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from fdnt_xp.data.exposures import Exposure, ExposureBatch
from fdnt_xp.errors import FdntTypeError, FdntValueError, ShapeMismatchError

_SAME_PIXELS: Final = 0.01
"""Relative difference of the Jacobians of an image and of its star that is let pass."""


def exposure_from_galsim(
    image: Any,
    star: Any,
    *,
    position: Any = None,
    weight: Any = None,
    mask: Any = None,
    noise_variance: float | None = None,
    oversampling: float = 1.0,
    band: int = 0,
) -> Exposure:
    """Take a `galsim.Image` with its WCS, and the image of its PSF.

    Parameters
    ----------
    image : galsim.Image
        Its `wcs`, of any kind, is what it is at `position`; without one the Jacobian is 1.
    star : galsim.Image or array
        Drawn with pixels as those of the image are there; if it has a `wcs`, that is checked.
    position : galsim.PositionD or (float, float), optional
        Of the object, in the coordinates of `image` (GalSim's first pixel is 1, 1 unless told
        otherwise); `image.true_center` without it.
    weight : galsim.Image or array, optional
        Inverse variance of each pixel, 0 where it is missing.
    mask : galsim.Image or array, optional
        A pixel is missing where this is not 0.
    noise_variance : float, optional
        Of every pixel, in place of `weight`.
    oversampling : float
        Pixels of `star` per pixel of `image`, along one axis.
    band : int

    Raises
    ------
    FdntTypeError
        If `image` is no image of GalSim.
    FdntValueError
        If the star has other pixels, or a mask comes without the noise of other pixels.
    ShapeMismatchError
        If `weight` or `mask` has another shape than the image.
    """
    if not (hasattr(image, "array") and hasattr(image, "true_center")):
        raise FdntTypeError(f"image must be a galsim.Image, not {type(image).__name__}")
    place = image.true_center if position is None else _position(image, position)
    jacobian = _jacobian_of_wcs(getattr(image, "wcs", None), place)
    if getattr(star, "wcs", None) is not None:
        _check_pixels(jacobian, _jacobian_of_wcs(star.wcs, star.true_center), oversampling)
    return Exposure(
        image=image.array,
        star=_array(star),
        jacobian=jacobian,
        origin=(place.x - image.bounds.xmin, place.y - image.bounds.ymin),
        band=band,
        **_noise(image.array.shape, weight, mask, noise_variance),
    )


def exposures_from_observations(
    observations: Any, *, bad_bits: int | None = None
) -> list[Exposure]:
    """Take the observations of one object, as ngmix has them.

    Parameters
    ----------
    observations : Observation, or list of them, or list of such lists
        With the attributes `image`, `weight` (inverse variance), `jacobian` (`row0`, `col0`,
        `dudrow`, `dudcol`, `dvdrow`, `dvdcol`), `psf` (with an `image`, and a `jacobian` that
        is checked), and perhaps `bmask`. Of lists of lists, as a `MultiBandObsList` is, each
        is a band.
    bad_bits : int, optional
        Bits of `bmask` that make a pixel missing; every bit without it.

    Returns
    -------
    list of Exposure
        None for an empty list.

    Raises
    ------
    FdntTypeError
        If an observation lacks one of the attributes.
    FdntValueError
        If its star has other pixels than its image.
    ShapeMismatchError
        If one of its arrays has another shape than the image.
    """
    return [_of_observation(one, band, bad_bits) for band, one in _flat(observations)]


def batch_from_observations(
    objects: Iterable[Any], ids: Sequence[Any] | None = None, *, bad_bits: int | None = None
) -> ExposureBatch:
    """Gather the observations of many objects; see `exposures_from_observations`.

    Parameters
    ----------
    objects : iterable
        Of the observations of each object; an empty list is an object without exposures.
    ids : sequence, optional
        Names or numbers of the objects; row numbers without it.
    bad_bits : int, optional
        Bits of `bmask` that make a pixel missing; every bit without it.

    Raises
    ------
    FdntTypeError, FdntValueError, ShapeMismatchError
        As that function; the message says which object.
    """
    gathered = []
    for number, one in enumerate(objects):
        try:
            gathered.append(exposures_from_observations(one, bad_bits=bad_bits))
        except (FdntTypeError, FdntValueError) as error:
            raise type(error)(f"object {number}: {error}") from error
    return ExposureBatch.of(gathered, ids)


def _flat(observations: Any) -> Iterator[tuple[int, Any]]:
    """Yield the number of the band and the observation, of lists of any depth up to two."""
    if not isinstance(observations, list | tuple):
        yield 0, observations
        return
    for number, one in enumerate(observations):
        if isinstance(one, list | tuple):
            yield from ((number, observation) for observation in one)
        else:
            yield 0, one


def _of_observation(one: Any, band: int, bad_bits: int | None) -> Exposure:
    lacking = [name for name in ("image", "weight", "jacobian", "psf") if not hasattr(one, name)]
    if lacking:
        raise FdntTypeError(f"an observation ({type(one).__name__}) has no {', '.join(lacking)}")
    jacobian = _jacobian_of_rows(one.jacobian)
    if getattr(one.psf, "jacobian", None) is not None:
        _check_pixels(jacobian, _jacobian_of_rows(one.psf.jacobian), 1.0)
    bits = getattr(one, "bmask", None)
    if bits is not None and bad_bits is not None:
        bits = np.asarray(bits).astype(np.int64) & bad_bits
    image = np.asarray(one.image)
    return Exposure(
        image=image,
        star=np.asarray(one.psf.image),
        jacobian=jacobian,
        origin=(float(one.jacobian.col0), float(one.jacobian.row0)),
        band=band,
        **_noise(image.shape, one.weight, bits, None),
    )


def _noise(
    shape: tuple[int, ...], weight: Any, mask: Any, noise_variance: float | None
) -> dict[str, Any]:
    """Return the noise of an exposure: of a map, of a number, or of a mask and one of them."""
    if weight is not None and noise_variance is not None:
        raise FdntValueError("weight and noise_variance cannot both be given")
    if mask is None and weight is None:
        return {"noise_variance": noise_variance}
    if weight is None and noise_variance is None:
        raise FdntValueError(
            "a mask alone does not say how noisy the other pixels are: give weight or "
            "noise_variance"
        )
    for name, plane in (("weight", weight), ("mask", mask)):
        if plane is not None and _array(plane).shape != shape:
            raise ShapeMismatchError(
                f"the {name} must have the shape of the image, {shape}, not {_array(plane).shape}"
            )
    ivar = np.full(shape, 1.0 / (noise_variance or 1.0)) if weight is None else _array(weight)
    return {"ivar": ivar if mask is None else np.where(_array(mask) != 0, 0, ivar)}


def _array(image: Any) -> NDArray[Any]:
    return np.asarray(getattr(image, "array", image))


def _position(image: Any, position: Any) -> Any:
    """Return a position of the class that GalSim has for it."""
    return position if hasattr(position, "x") else type(image.true_center)(*position)


def _jacobian_of_wcs(wcs: Any, place: Any) -> NDArray[np.float64]:
    if wcs is None:
        return np.eye(2)
    local = wcs.jacobian(image_pos=place)
    return np.array([[local.dudx, local.dudy], [local.dvdx, local.dvdy]], dtype=np.float64)


def _jacobian_of_rows(jacobian: Any) -> NDArray[np.float64]:
    """Return d(u, v)/d(x, y) of an object with slopes along rows (y) and columns (x)."""
    slopes = [[f"d{axis}d{step}" for step in ("col", "row")] for axis in "uv"]
    try:
        return np.array([[float(getattr(jacobian, one)) for one in row] for row in slopes])
    except AttributeError as error:
        raise FdntTypeError(
            f"a jacobian ({type(jacobian).__name__}) lacks slopes: {error}"
        ) from error


def _check_pixels(
    image: NDArray[np.float64], star: NDArray[np.float64], oversampling: float
) -> None:
    """Refuse a star that was drawn with other pixels than its image."""
    if not np.max(np.abs(star * oversampling - image)) <= _SAME_PIXELS * np.max(np.abs(image)):
        raise FdntValueError(
            f"the star has pixels with the Jacobian {star.tolist()}, but the image of the "
            f"object has {image.tolist()}; draw the PSF with the pixels of the image"
        )
