"""Cuts that do not bias: made in the counter-sheared frame, on what is measured there.

A cut on what is seen on the sky prefers galaxies by how the shear has changed them, and by
the orientation of the PSF; so it selects shapes, and biases the shear by per cents. In the
frame from which the true shear is taken off, noise made round, a cut on quantities that do
not turn with the image cannot know a direction.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, TypeAlias

from fdnt_xp.arrays import Array, array_namespace, is_array
from fdnt_xp.errors import FdntTypeError, FdntValueError, RangeError, ShapeMismatchError


@dataclass(frozen=True, kw_only=True)
class FrameQuantities:
    """What a cut may be made on: quantities of each galaxy in one frame that do not turn.

    Parameters
    ----------
    flux : array, shape (n_gal,)
        That of a point under the weight, in units of the image.
    snr : array, shape (n_gal,)
        `flux` over its error, synthetic noise included; NaN where the noise is unknown.
    size : array, shape (n_gal,)
        sigma of the Gaussian galaxy, before the PSF, that has the same mean square wave
        number under the weight; pixels, 0 for what is smaller than a point.
    """

    flux: Array
    snr: Array
    size: Array


QUANTITIES: Final = ("snr", "flux", "size")
"""Names of the quantities, in the order in which catalogs have them."""


@dataclass(frozen=True, kw_only=True)
class Cut:
    """A range of one quantity; what a galaxy in it counts.

    Parameters
    ----------
    quantity : {"snr", "flux", "size"}
    low, high : float, optional
        The range; open where absent.
    width : float
        0 for a hard cut. Otherwise the weight rises from 0 to 1 around each end as
        `1/(1 + exp(-(q - low)/width))`, which makes the response to shear less noisy.
    """

    quantity: str
    low: float | None = None
    high: float | None = None
    width: float = 0.0

    def __post_init__(self) -> None:
        """Refuse what is no range."""
        if self.quantity not in QUANTITIES:
            raise FdntValueError(
                f"no quantity {self.quantity!r} to cut on; known are {', '.join(QUANTITIES)}"
            )
        ends = [end for end in (self.low, self.high) if end is not None]
        if not ends:
            raise FdntValueError(f"a cut on {self.quantity} needs low, high or both")
        if any(math.isnan(end) for end in ends) or (len(ends) == 2 and ends[0] >= ends[1]):
            raise FdntValueError(
                f"the cut on {self.quantity} keeps nothing: low = {self.low}, high = {self.high}"
            )
        if not (math.isfinite(self.width) and self.width >= 0.0):
            raise RangeError("width", self.width, 0.0, None)

    def __call__(self, quantities: FrameQuantities) -> Array:
        """Return what each galaxy counts, between 0 and 1; shape (n_gal,)."""
        value = getattr(quantities, self.quantity)
        xp = array_namespace(value=value)
        weight = xp.ones_like(value)
        for end, sign in ((self.low, 1.0), (self.high, -1.0)):
            if end is None:
                continue
            excess = sign * (value - end)
            if self.width == 0.0:
                weight = xp.where(excess >= 0, weight, xp.zeros_like(weight))
            else:
                # tanh neither overflows nor underflows.
                weight = weight * (0.5 + 0.5 * xp.tanh(0.5 * excess / self.width))
        return weight


CutFunction: TypeAlias = Callable[[FrameQuantities], Array]
CutLike: TypeAlias = (
    Cut | Sequence[Cut] | Mapping[str, tuple[float | None, float | None]] | CutFunction
)
"""A cut, several that must all be passed, ranges by name of the quantity, or a function."""


@dataclass(frozen=True, kw_only=True)
class Selection:
    """Cuts that must all be passed, in one form.

    Parameters
    ----------
    cuts : tuple of callables
    hard : bool
        Whether a galaxy may be in or out by a hair: the mean is then no smooth function of
        the shear. Nothing is known of a caller's function, which is taken for hard.
    """

    cuts: tuple[CutFunction, ...]
    hard: bool

    @classmethod
    def of(cls, cut: CutLike | None) -> Selection:
        """Return the cuts that a caller means.

        Raises
        ------
        FdntTypeError, FdntValueError
            If it is none of `CutLike`, or keeps nothing.
        """
        if cut is None:
            return cls(cuts=(), hard=False)
        if isinstance(cut, Cut):
            return cls(cuts=(cut,), hard=cut.width == 0.0)
        if isinstance(cut, Mapping):
            ranges = []
            for name, ends in cut.items():
                if not (isinstance(ends, tuple | list) and len(ends) == 2):
                    raise FdntTypeError(f"the cut on {name} must be (low, high), not {ends!r}")
                ranges.append(Cut(quantity=name, low=ends[0], high=ends[1]))
            return cls(cuts=tuple(ranges), hard=True)
        if callable(cut):
            return cls(cuts=(cut,), hard=True)
        if isinstance(cut, Sequence) and all(isinstance(one, Cut) for one in cut):
            return cls(cuts=tuple(cut), hard=any(one.width == 0.0 for one in cut))
        raise FdntTypeError(
            "cut must be a Cut, a list of them, a dict of (low, high) by quantity, or a "
            f"function of FrameQuantities, not {type(cut).__name__}"
        )

    @property
    def needs_noise(self) -> bool:
        """Whether S/N is cut on by name."""
        return any(isinstance(cut, Cut) and cut.quantity == "snr" for cut in self.cuts)

    def weight(self, quantities: FrameQuantities) -> Array:
        """Return what each galaxy counts, shape (n_gal,); 0 where a quantity is NaN."""
        xp = array_namespace(flux=quantities.flux)
        weight = xp.ones_like(quantities.flux)
        for cut in self.cuts:
            one = cut(quantities)
            if not is_array(one) or one.shape != weight.shape:
                raise ShapeMismatchError(
                    f"cut must return an array of the shape {tuple(weight.shape)}, not "
                    f"{tuple(one.shape) if is_array(one) else type(one).__name__}"
                )
            weight = weight * xp.astype(one, weight.dtype)
        return xp.where(xp.isfinite(weight), weight, xp.zeros_like(weight))
