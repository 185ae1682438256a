"""The PSF in Fourier space: its transfer function, and the circular weight made from it.

The image of a star, pixel response included, is all that is needed. Its transform `T(k)` is
evaluated by direct trigonometric sums, exact at any k: the star may sit anywhere in its
array, of any size, finer sampled than the galaxies if `oversampling` says so.

`𝒯(k) = <|T|^-2>_θ^-1` (B10, eq. 21, with the exponent corrected; docs, "Weight of the
PSF") is the part of the null tests' weight that knows the PSF. It ends at `kmax`, where it
falls below a floor or the grid ends, and it ends smoothly: a hard edge costs 1e-4 in e.

Where shapes are those on the sky, so are the circles, and all of this is a function of the
wave number there (`Psf.through`): the same for one PSF behind any pixels.
"""

from __future__ import annotations

import numbers
from dataclasses import dataclass, replace
from types import ModuleType

import numpy as np

from fdnt_xp.arrays import (
    Array,
    array_namespace,
    as_floating,
    blocks_in_cache,
    device_of,
    to_numpy,
)
from fdnt_xp.errors import FdntTypeError, FdntValueError, RangeError, ShapeMismatchError
from fdnt_xp.fourier.circles import circle_tables, ended_at, pixels_from_middle
from fdnt_xp.fourier.grid import KGrid
from fdnt_xp.fourier.interpolation import CubicTable
from fdnt_xp.fourier.jacobian import longest_stretch, unit_jacobian, wave_frame
from fdnt_xp.fourier.star_transform import transform_on_modes
from fdnt_xp.fourier.transform import mode_phase

_UNIT_STEPS = 8192.0
"""Of an entry of a unit Jacobian, to one: pixels that differ by less share tables."""
_FINE_STEPS, _FEW_TABLES = 1048576.0, 64
"""The same where so few tables are enough for all."""
_COMMON_STEPS = 2048.0
"""The same where many Jacobians have a unit of length in common: a mean shear does not ask for
weights that are more alike, and its error by a table is as random as the rounding."""


@dataclass(frozen=True, kw_only=True)
class Psf:
    """One PSF for all galaxies, one for each, or several that galaxies share.

    Made by `Psf.from_image`.

    Parameters
    ----------
    image : array, shape (n_psf, ny, nx)
        Stars of unit flux.
    centre : array, shape (n_psf, 2)
        Flux centroids (x, y), in pixels of `image` from the middle of the array.
    kmax : array, shape (n_psf,)
        Where the weight ends, rad/pixel of the galaxies.
    usable : array, shape (n_psf,), bool
        False where an image is not finite or has no positive sum.
    weight : CubicTable
        `𝒯` as a function of `k/kmax`, one table per PSF.
    ln_power : array, shape (n_psf, n_circle, n_point)
        `ln |T|²` at `circle_kmax j/(n_circle - 1)`, angles `π (l + ½)/n_point`.
    circle_kmax : array, shape (n_psf,)
        Radius of the outermost circle, rad/pixel: `kmax` as it was made.
    oversampling : float
        Pixels of `image` per pixel of the galaxies, along one axis.
    largest_kmax : float
        Radius of the disc on the pixels' k grid that holds all weights, on the host.
    floor : float
        Where `𝒯` ends; see `from_image`.
    index : array of int64, shape (n_gal,), optional
        Which PSF each galaxy has, where several share one.
    distinct : tuple of Psf and array of int64, shape (n_psf,), optional
        The different ones of these PSFs, and which of those each is: they are transformed once.
    unit_jacobian : array, shape (n_psf, 2, 2), optional
        B of the galaxies' pixels (`fdnt_xp.fourier.jacobian`). With it `kmax`, `weight` and
        `ln_power` are about wave numbers on the sky, in units of pixels as large as theirs, or
        of another length that all have in common (`through`).
    """

    image: Array
    centre: Array
    kmax: Array
    usable: Array
    weight: CubicTable
    ln_power: Array
    circle_kmax: Array
    oversampling: float
    largest_kmax: float
    floor: float = 1e-6
    index: Array | None = None
    distinct: tuple[Psf, Array] | None = None
    unit_jacobian: Array | None = None

    @classmethod
    def from_image(
        cls,
        image: Array,
        *,
        psf_index: Array | None = None,
        oversampling: float = 1.0,
        floor: float = 1e-6,
    ) -> Psf:
        """Take the PSF from the image of a star, or from a stack of such images.

        Parameters
        ----------
        image : array, shape (ny, nx), (n_gal, ny, nx) or (n_psf, ny, nx)
            One star for all galaxies, one for each, or as many as `psf_index` chooses
            from; pixel response included. Any normalisation with a positive sum, centred
            anywhere: centroids of galaxies are counted from the flux centroid of the star.
            The result has its library, dtype and device; integers become float64.
        psf_index : array of integers, shape (n_gal,), optional
            Which star each galaxy has, from 0. Tables are made once for each star, and
            galaxies that share one are measured together. A hundred of them for each star take
            1.2 to 1.7 times as long as with one PSF for all.
        oversampling : float
            Pixels of `image` per pixel of the galaxies, along one axis. The pixel response
            in the image must be that of the galaxies' pixels.
        floor : float
            The weight ends where `𝒯` first falls below this, in units of `𝒯(0) = 1`.

        Raises
        ------
        ShapeMismatchError
            If `image` has another rank, or an axis of length 0.
        RangeError
            If `oversampling` or `floor` is out of range.
        FdntTypeError, NamespaceError
            If `psf_index` does not hold whole numbers, or is of another library or device.
        FdntValueError
            If `psf_index` names a star that there is not, or a single image is not finite or
            has no positive sum. In a stack such an image is marked instead, and its galaxies
            flagged `BAD_PSF`.
        """
        xp = array_namespace(image=image)
        image = as_floating(xp, image, "image")
        if image.ndim not in (2, 3) or 0 in image.shape[-2:]:
            raise ShapeMismatchError(
                f"image must have the shape (ny, nx) or (n_gal, ny, nx), not {image.shape}"
            )
        for name, value in (("floor", floor), ("oversampling", oversampling)):
            if not isinstance(value, numbers.Real):
                raise FdntTypeError(f"{name} must be a number, not {value!r}")
        if not 0.0 < floor < 1.0:
            raise RangeError("floor", floor, 0.0, 1.0)
        if not (np.isfinite(oversampling) and oversampling > 0.0):
            raise RangeError("oversampling", oversampling, 0.0, None)
        single = image.ndim == 2
        image = image[None, ...] if single else image
        index = None if psf_index is None else _checked_index(xp, image, psf_index)
        image, usable = _normalised(image)
        if single and not bool(xp.all(usable)):
            raise FdntValueError("image must be finite, with a positive sum, to serve as the PSF")
        kmax, weight, ln_power = circle_tables(image, float(oversampling), floor)
        return cls(
            image=image,
            centre=_flux_centroid(image) / oversampling,
            kmax=kmax,
            usable=usable,
            weight=weight,
            ln_power=ln_power,
            circle_kmax=kmax,
            oversampling=float(oversampling),
            largest_kmax=_largest(kmax),
            floor=floor,
            index=index,
        )

    @property
    def n_psf(self) -> int:
        """Number of different PSFs."""
        return int(self.image.shape[0])

    @property
    def n_gal(self) -> int | None:
        """Number of galaxies that it is for; None if it is one PSF for any number."""
        if self.index is not None:
            return int(self.index.shape[0])
        return None if self.n_psf == 1 else self.n_psf

    @property
    def frame(self) -> Array | None:
        """A, which takes k of the image to that of the sky, shape (n_psf, 2, 2); see `through`."""
        return None if self.unit_jacobian is None else wave_frame(self.unit_jacobian)

    def numbers_of(self, rows: Array) -> Array:
        """Return which PSF each of the given galaxies (integer array) has."""
        xp = array_namespace(image=self.image, rows=rows)
        return rows if self.index is None else xp.take(self.index, rows, axis=0)

    def take(self, rows: Array) -> Psf:
        """Return the PSFs of the given galaxies (integer array), one for each."""
        numbers = self.numbers_of(rows)
        return replace(self._numbered(numbers), distinct=self._distinct(numbers))

    def _numbered(self, numbers: Array) -> Psf:
        """Return the PSFs with the given numbers."""
        xp = array_namespace(image=self.image, numbers=numbers)
        moved: tuple[str, ...]
        moved = ("image", "centre", "kmax", "usable", "ln_power", "circle_kmax")
        if self.unit_jacobian is not None:
            moved += ("unit_jacobian",)
        taken = {name: xp.take(getattr(self, name), numbers, axis=0) for name in moved}
        weight = self.weight.take(numbers)
        return replace(self, **taken, weight=weight, index=None, distinct=None)

    def _distinct(self, numbers: Array) -> tuple[Psf, Array] | None:
        """Return the different ones among the PSFs with these numbers, and which each is.

        None where galaxies do not share PSFs, as far as is known, or none of these do.
        """
        if self.index is None and self.distinct is None:
            return None
        xp = array_namespace(numbers=numbers)
        psf, which = (self, numbers)
        if self.distinct is not None:
            psf, which = self.distinct[0], xp.take(self.distinct[1], numbers, axis=0)
        # A host read: how many there are decides the size of their transforms.
        found, place = np.unique(to_numpy(which), return_inverse=True)
        if len(found) == int(numbers.shape[0]):
            return None
        like = {"dtype": xp.int64, "device": device_of(numbers)}
        return psf._numbered(xp.asarray(found, **like)), xp.asarray(place, **like)

    def with_index(self, psf_index: Array) -> Psf:
        """Return the same PSFs for other galaxies: see `from_image`."""
        xp = array_namespace(image=self.image)
        return replace(self, index=_checked_index(xp, self.image, psf_index))

    def through(self, jacobian: Array, unit_length: float | None = None) -> Psf:
        """Return the PSFs with weights that are round on the sky.

        The tables are made once for each different pair of a PSF and a unit Jacobian. Where
        these are more than 64, entries are rounded to 1/8192 (1/2048 for many, with a
        `unit_length`): the weight needs to be the same for the same galaxy, and smooth, not round
        to more than that. It changes sizes by 2e-6, eta by 2e-7. All else has the Jacobian as it
        is.

        Parameters
        ----------
        jacobian : array, shape (1, 2, 2) or (n_gal, 2, 2)
            Of the galaxies' pixels; regular.
        unit_length : float, optional
            On the sky: wave numbers there are in rad over this length. That of each galaxy's
            own pixels by default.
        """
        xp = array_namespace(image=self.image, jacobian=jacobian)
        unit = unit_jacobian(jacobian) if unit_length is None else jacobian / unit_length
        seen, index = self, self.index
        numbers = xp.arange(self.n_psf, dtype=xp.int64, device=device_of(unit))
        if int(unit.shape[0]) == 1:
            unit = xp.broadcast_to(unit, (self.n_psf, 2, 2))
        else:
            rows, index = self.pairs(unit)
            unit = xp.take(unit, rows, axis=0)
            numbers = xp.zeros_like(rows) if self.n_gal is None else self.numbers_of(rows)
            seen = replace(self, index=None).take(numbers)
        many = unit_length is not None and int(jacobian.shape[0]) > 1
        for steps in (_COMMON_STEPS,) if many else (_FINE_STEPS, _UNIT_STEPS):
            rounded = xp.round(unit * steps) / steps
            rounded = unit_jacobian(rounded) if unit_length is None else rounded
            rows, table = _different(numbers, rounded)
            if int(rows.shape[0]) <= _FEW_TABLES:
                break
        kmax, weight, ln_power = circle_tables(
            xp.take(seen.image, rows, axis=0),
            self.oversampling,
            self.floor,
            xp.take(rounded, rows, axis=0),
        )
        kmax = xp.take(kmax, table, axis=0)
        return replace(
            seen,
            kmax=kmax,
            weight=weight.take(table),
            ln_power=xp.take(ln_power, table, axis=0),
            circle_kmax=kmax,
            largest_kmax=_largest(kmax, unit),
            index=index,
            unit_jacobian=unit,
        )

    def pairs(self, unit: Array) -> tuple[Array, Array | None]:
        """Return a galaxy with each different pair of a PSF and a Jacobian, and whose is which.

        A host read: how many there are decides the size of the tables.

        Parameters
        ----------
        unit : array, shape (n_gal, 2, 2)
            B of each galaxy.

        Returns
        -------
        rows : array of int64, shape (n_pair,)
            Number of a galaxy with each pair.
        index : array of int64, shape (n_gal,), optional
            Which pair each galaxy has; None if there is only one.
        """
        xp = array_namespace(unit=unit)
        galaxies = xp.arange(int(unit.shape[0]), dtype=xp.int64, device=device_of(unit))
        numbers = xp.zeros_like(galaxies) if self.n_gal is None else self.numbers_of(galaxies)
        rows, index = _different(numbers, unit)
        return rows, None if int(rows.shape[0]) == 1 else index

    def restricted(self, least_kmax: float) -> Psf:
        """Return the PSFs with those marked unusable whose weight ends before `least_kmax`.

        On the sky it ends in an ellipse on the k grid, whose narrow side counts.
        """
        reach = self.kmax
        if self.unit_jacobian is not None:
            reach = reach / longest_stretch(self.unit_jacobian)
        return replace(self, usable=self.usable & (reach >= least_kmax))

    def ending_at(self, floor: float) -> Psf:
        """Return the PSFs with weights that end where `𝒯` falls below a higher floor.

        Where noise is, the modes beyond carry none of the signal, and leaving them out
        saves their time. A weight that ends before stays as it is.
        """
        kmax, weight = ended_at(self.kmax, self.weight, floor)
        return replace(
            self,
            kmax=kmax,
            weight=weight,
            largest_kmax=_largest(kmax, self.unit_jacobian),
            floor=max(floor, self.floor),
            distinct=None,
        )

    def transfer(self, grid: KGrid, rows: slice = slice(None)) -> Array:
        """Return `T(k)` of a range of the PSFs about the flux centroid on a grid; T(0) = 1.

        Returns
        -------
        array, shape (n_psf, n_k), complex
        """
        transform = transform_on_modes(self.image[rows, :, :], grid, self.oversampling)
        return transform * mode_phase(grid, self.centre[rows, :])

    def inverse_transfer(self, grid: KGrid) -> Array:
        """Return `1/T(k)` inside each PSF's own disc `|k| < kmax` (on the sky), zero outside.

        Returns
        -------
        array, shape (n_psf, n_k), complex
        """
        xp = array_namespace(image=self.image)
        if self.distinct is not None:
            psf, which = self.distinct
            return xp.take(psf.inverse_transfer(grid), which, axis=0)
        flat = xp.reshape(self.image, (self.n_psf, -1)) if self.n_psf else self.image[:, 0, :]
        return xp.concat([self._inverse_of(rows, grid) for rows in blocks_in_cache(flat)])

    def _inverse_of(self, rows: slice, grid: KGrid) -> Array:
        """Return `1/T(k)` of few PSFs."""
        xp = array_namespace(image=self.image)
        transfer = self.transfer(grid, rows)
        kx, ky = grid.kx[None, :], grid.ky[None, :]
        if self.unit_jacobian is not None:
            frame = wave_frame(self.unit_jacobian[rows, :, :])
            kx, ky = (frame[:, i, 0:1] * kx + frame[:, i, 1:2] * ky for i in (0, 1))
        inside = (xp.sqrt(kx**2 + ky**2) < self.kmax[rows, None]) & (xp.abs(transfer) > 0)
        one = xp.ones_like(transfer)
        return xp.where(inside, one / xp.where(inside, transfer, one), xp.zeros_like(transfer))


def _checked_index(xp: ModuleType, image: Array, psf_index: Array) -> Array:
    """Return which star each galaxy has as int64; refuse what is no such thing."""
    array_namespace(image=image, psf_index=psf_index)
    if not xp.isdtype(psf_index.dtype, "integral"):
        raise FdntTypeError(f"psf_index must hold whole numbers, but has dtype {psf_index.dtype}")
    if psf_index.ndim != 1:
        raise ShapeMismatchError(
            f"psf_index must have the shape (n_gal,), not {tuple(psf_index.shape)}"
        )
    n_psf = int(image.shape[0])
    index = xp.astype(psf_index, xp.int64)
    if int(index.shape[0]) and not bool(xp.all((index >= 0) & (index < n_psf))):
        raise FdntValueError(
            f"psf_index must be from 0 to {n_psf - 1}, for there are {n_psf} stars; it goes "
            f"from {int(xp.min(index))} to {int(xp.max(index))}"
        )
    return index


def _normalised(image: Array) -> tuple[Array, Array]:
    """Return the stars at unit flux and which are usable; the others become a point."""
    xp = array_namespace(image=image)
    ny, nx = image.shape[1:]
    finite = xp.all(xp.all(xp.isfinite(image), axis=-1), axis=-1)
    image = xp.where(finite[:, None, None], image, xp.zeros_like(image))
    total = xp.sum(xp.sum(image, axis=-1), axis=-1)
    usable = finite & xp.isfinite(total) & (total > 0)
    safe = xp.where(usable, total, xp.ones_like(total))
    pixel = xp.arange(ny * nx, dtype=xp.int64, device=device_of(image))
    middle = xp.reshape(pixel == (ny // 2) * nx + nx // 2, (1, ny, nx))
    point = xp.broadcast_to(xp.astype(middle, image.dtype), image.shape)
    return xp.where(usable[:, None, None], image / safe[:, None, None], point), usable


def _flux_centroid(image: Array) -> Array:
    """Return (x, y) from the middle of the array, shape (n_psf, 2), for stars of unit flux."""
    xp = array_namespace(image=image)
    ny, nx = image.shape[1:]
    x = xp.sum(xp.sum(image, axis=1) * pixels_from_middle(nx, image), axis=-1)
    y = xp.sum(xp.sum(image, axis=2) * pixels_from_middle(ny, image), axis=-1)
    return xp.stack([x, y], axis=-1)


def _different(numbers: Array, matrices: Array) -> tuple[Array, Array]:
    """Return a row with each different number and matrix, and which of those each row has."""
    xp = array_namespace(matrices=matrices)
    both = [to_numpy(numbers)[:, None], to_numpy(matrices).reshape(-1, 4)]
    _, first, which = np.unique(
        np.concatenate(both, axis=1), axis=0, return_index=True, return_inverse=True
    )
    like = {"dtype": xp.int64, "device": device_of(matrices)}
    return xp.asarray(first, **like), xp.asarray(which.reshape(-1), **like)


def _largest(kmax: Array, unit: Array | None = None) -> float:
    """Return the largest radius on the k grid, on the host; all of it where there is none."""
    xp = array_namespace(kmax=kmax)
    kmax = kmax if unit is None else kmax * longest_stretch(unit)
    # In float32 pi is rounded up, past the Nyquist modes.
    return min(float(xp.max(kmax)), np.pi) if int(kmax.shape[0]) else np.pi
