"""The population null: the shear is the counter-shear under which the mean shape vanishes.

No responsivity enters, no ellipticity gradient, no calibration. Counter-shearing is exact
in Fourier space; at the true shear the galaxies are isotropic again, and any spin-2
quantity of them has zero mean (docs, "The population null"). With noise that is made round
in the same frame that holds at any S/N (docs, "Noise made round").
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, replace
from typing import Final

from fdnt_xp.arrays import Array, array_namespace, count_true, device_of, has_any, to_numpy
from fdnt_xp.errors import FdntValueError, FdntWarning, RangeError
from fdnt_xp.flags import Flag
from fdnt_xp.fourier.psf import Psf
from fdnt_xp.shear import reduced_shear_from_eta
from fdnt_xp.shears.cuts import CutLike, Selection
from fdnt_xp.shears.estimate import ShearEstimate
from fdnt_xp.shears.frames import FrameSample, Gamma, SampleValues
from fdnt_xp.shears.masks import Masked
from fdnt_xp.shears.null_search import OutOfReachError, find_null
from fdnt_xp.shears.ratio import errors_by_noise, over_response, ratio_errors
from fdnt_xp.shears.sample import LARGEST_SHEAR, NoiseOptions, StatisticName, make_sample
from fdnt_xp.shears.weights import ShapeWeight

STEP: Final = 0.02
"""Step in gamma of numerical responses: far above the solver's noise, and its error, of
second order in the step, changes the speed of the search, not its root."""
_TOLERANCE: Final = 1e-9
_TOLERANCE_FLOAT32: Final = 2e-5
"""Smallest step in gamma worth taking: above the rounding of each galaxy's solution."""
_TOLERANCE_NOISY: Final = 0.1
"""The same in noisy data, in standard errors. The last step is taken, and what it leaves is
smaller by the error of the response, of 1e-2."""
_SLOPE_SEEN: Final = 1e-3
"""Least step in gamma from which a slope is learnt, where cuts or noise make the mean rough."""
_DEFAULT_SHEAR: Final = 0.1
_PILOT: Final = 20_000
"""Galaxies that find a first shear for a sample of four times as many or more."""
_LEAST_SNR_ETA: Final = 50.0
"""Median S/N below which solved shapes fail too often, and jump from root to root."""
_POWER_STEP: Final = 0.1
"""Relative change of the noise power that shows how the shear depends on it."""


def population_null(
    stamps: Array,
    psf: Psf,
    *,
    statistic: StatisticName = "frozen",
    noise_variance: float | Array | None = None,
    noise_power: Array | None = None,
    noise_error: float | None = None,
    isotropise: bool | None = None,
    cut: CutLike | None = None,
    seed: int = 0,
    identifiers: Array | None = None,
    noise_symmetry: Array | None = None,
    mask: Array | None = None,
    masked: Masked = "drop",
    weight: ShapeWeight | None = None,
    size: float | None = None,
    softening: float = 1.0,
    bound: float = 0.0,
    max_shear: float | None = None,
    jacobian: Array | None = None,
    padding: int = 1,
    chunk_size: int | None = None,
) -> ShearEstimate:
    """Estimate the shear of a population by the counter-shear that nulls its mean shape.

    Parameters
    ----------
    stamps : array, shape (n_gal, ny, nx)
        Images of one galaxy each, as for `measure_shapes`. Where the noise is given, the
        search for a galaxy begins at the middle of its stamp: it should lie within two or
        three pixels of it.
    psf : Psf
        One for all stamps, or one for each.
    statistic : {"frozen", "eta"}
        "frozen": the normalised quadrupole of each galaxy under one fixed round weight in
        the counter-sheared frame; only the centroid is solved. "eta": the shape of each
        galaxy, solved anew in every frame; for S/N above 50.
    noise_variance : float or array, shape (n_gal,), optional
        Variance of a pixel, in (unit of the image)².
    noise_power : array, shape (ny, nx) or (n_gal, ny, nx), optional
        Instead: power spectrum of noise that is correlated between pixels but stationary,
        `E|FFT(noise)|²/(ny nx)` in the order of the FFT. Its mean is the variance.
    noise_error : float, optional
        Relative standard error of that variance or power. The error of the shear that
        follows is `ShearEstimate.g_err_noise_power`.
    isotropise : bool, optional
        Whether to add the noise that makes the noise round in the counter-sheared frame; by
        default where the noise is given. Without it noise biases the result by about
        `4/(S/N)²` (relative).
    cut : Cut, sequence of Cut, dict of (low, high), or callable, optional
        Which galaxies count, by what is measured in the same frame: see `fdnt_xp.Cut`. A
        callable takes `FrameQuantities` and returns what each galaxy counts, (n_gal,).
    seed : int
        Of the synthetic noise.
    identifiers : array of integers, shape (n_gal,), optional
        Names of the galaxies: the synthetic noise of a galaxy depends on its name and the
        seed alone. Row numbers by default.
    noise_symmetry : array of integers, shape (n_gal,), optional
        For tests of bias in which one galaxy is drawn several times with the same noise: by
        how many quarter turns, counter-clockwise, the synthetic noise of each is turned,
        plus 4 where its sign is changed. Square stamps only.
    mask : array, shape (n_gal, ny, nx), bool, optional
        True where a pixel is missing, whatever it holds.
    masked : {"drop", "fill"}
        What becomes of stamps with missing pixels. "drop": they are left out, which is
        unbiased. "fill": where the holes are small, under a tenth of the weight and no row
        or column, they are filled from the other pixels (`fdnt_xp.fourier.missing`); the
        other stamps are left out. For holes in random places the bias is below 1e-3.
    weight : ShapeWeight, optional
        `w(|eta|)` that bounds the influence of elongated galaxies; for "eta" alone. Uniform
        by default; where the noise is given, `ShapeWeight.bisquare(1.5)`.
    size : float, optional
        sigma of the Gaussian part of the weight, pixels; one for the whole sample. Where the
        noise is given it is by default that of a typical galaxy of the sample: see
        `fdnt_xp.shears.sample.default_size`. Without noise it is that of the PSF for "frozen",
        and matched to each galaxy for "eta".
    softening : float
        Of "frozen": see `FrozenQuadrupole`. 8 weighs a sample of many fluxes better and is
        more sensitive to an error of the noise power.
    bound : float
        Of "frozen": see `FrozenQuadrupole`. 3 takes 1 to 2 % off the error of the shear at
        S/N 10 to 15, and up to 4 % at 50, where shapes scatter as those of galaxies do.
    max_shear : float, optional
        Largest `|g|` in reach. The weight's disc is smaller than the PSF's by
        `sqrt((1 + max_shear)/(1 - max_shear))`, which costs resolution. By default 0.1, and
        0.3, the most that can be, where the shear turns out to be larger.
    jacobian : array, shape (2, 2) or (n_gal, 2, 2), optional
        `d(u, v)/d(x, y)` of the pixels, for all stamps or for each, as for `measure_shapes`: shear,
        weight and noise made round are then those on the sky, `size` and sizes in its unit.
    padding, chunk_size : int
        As for `measure_shapes`.

    Returns
    -------
    ShearEstimate
        With `g_err` from the influence function and `g_err_jackknife` from leaving out 50
        groups of neighbouring rows in turn; with "frozen" and known noise also `g_err_noise`,
        the part of it that is due to the noise of the pixels and to the synthetic noise, at
        fixed weights of a cut. Galaxies for which the statistic fails count
        as zero, which is a spin-2 quantity too, and are reported in `n_excluded`, as are
        those that a cut removes and those in `n_masked`.

    Warns
    -----
    FdntWarning
        If "eta" is used below a median S/N of 50.

    Raises
    ------
    FdntValueError
        If fewer than two galaxies can be used or pass the cut, no null lies within
        `max_shear`, or noise is to be made round that is not given or 0.
    RangeError
        If a number is out of range; `max_shear` may be at most 0.3.
    FdntTypeError, NamespaceError, ShapeMismatchError
        As for `measure_shapes`.

    Notes
    -----
    Newton's method in the two components, with a response by differences at the start that
    each step improves (Broyden). The sample is read three or four times, a large one twice:
    the search then begins with a part of it.
    """
    selection = Selection.of(cut)
    noise = NoiseOptions(
        noise_variance=noise_variance,
        noise_power=noise_power,
        isotropise=isotropise,
        seed=seed,
        identifiers=identifiers,
        symmetry=noise_symmetry,
    )
    if noise_error is not None and not (math.isfinite(noise_error) and noise_error >= 0):
        raise RangeError("noise_error", noise_error, 0.0, None)

    def estimate(largest: float) -> ShearEstimate:
        sample = make_sample(
            stamps,
            psf,
            statistic=statistic,
            weight=weight,
            size=size,
            softening=softening,
            bound=bound,
            max_shear=largest,
            padding=padding,
            chunk_size=chunk_size,
            noise=noise,
            mask=mask,
            masked=masked,
            jacobian=jacobian,
        )
        if sample.n_gal < 2:
            raise FdntValueError(f"stamps holds {sample.n_gal} galaxies; a null needs two")
        if sample.noise is None and selection.needs_noise:
            raise FdntValueError("a cut on snr needs noise_variance or noise_power")
        null = _Null(sample=sample, selection=selection, largest=2.0 * math.atanh(largest))
        return null.estimate(f"population null, {statistic}", noise_error)

    if max_shear is not None:
        return estimate(max_shear)
    try:
        return estimate(_DEFAULT_SHEAR)
    except OutOfReachError:
        return estimate(LARGEST_SHEAR)


@dataclass(frozen=True, kw_only=True)
class _Null:
    """The search for the null of a sample, and what it is worth."""

    sample: FrameSample
    selection: Selection
    largest: float

    def estimate(self, method: str, noise_error: float | None) -> ShearEstimate:
        """Find the null and its errors."""
        sample = self.sample
        xp = array_namespace(stamps=sample.stamps)
        origin = (0.0, 0.0)
        if sample.n_gal >= 4 * _PILOT:
            pilot = replace(self, sample=sample.take(slice(0, _PILOT)))
            origin, _, _ = pilot.find(origin)
        gamma, v, response = self.find(origin)
        counted, total = v.counted, v.values.shape[0]
        errors = ratio_errors(v.values, response)
        like = {"dtype": sample.stamps.dtype, "device": device_of(sample.stamps)}
        # dg/dgamma = 1/2 to first order; the exact factor along gamma differs by |g|² at most.
        return ShearEstimate(
            g=reduced_shear_from_eta(xp.asarray(gamma, **like)),
            g_err=0.5 * errors[0],
            n_used=counted,
            method=method,
            n_excluded=int(total) - counted,
            n_masked=v.masked,
            n_filled=v.filled,
            g_err_noise=None if v.variance is None else 0.5 * errors_by_noise(v.variance, response),
            g_err_jackknife=0.5 * errors[1],
            g_err_noise_power=None
            if noise_error is None or sample.noise is None
            else 0.5 * noise_error * self._by_noise_power(gamma, response),
        )

    def find(self, origin: Gamma) -> tuple[Gamma, _Weighed, Array]:
        """Return the null, the values there, and the response of each, (n_gal, 2, 2)."""
        xp = array_namespace(stamps=self.sample.stamps)
        frames = (origin, (origin[0] + STEP, origin[1]), (origin[0], origin[1] + STEP))
        v, *others = self._look(frames)
        v.refuse_too_few()
        self._warn_of_eta(v)
        response = xp.stack([(other.values - v.values) / STEP for other in others], axis=-1)

        def mean(gamma: Gamma) -> Gamma:
            nonlocal v
            (v,) = self._look((gamma,))
            return _pair(xp.mean(v.values, axis=0))

        slope = xp.mean(response, axis=0)
        gamma = find_null(
            mean,
            _pair(xp.mean(v.values, axis=0)),
            [_pair(slope[0, :]), _pair(slope[1, :])],
            start=origin,
            largest=self.largest,
            tolerance=self._tolerance(v, response),
            least_secant=_SLOPE_SEEN if self.selection.hard or self.sample.noise else 0.0,
        )
        return gamma, v, response

    def _look(self, frames: tuple[Gamma, ...]) -> list[_Weighed]:
        return [_Weighed.of(values, self.selection) for values in self.sample.evaluate(frames)]

    def _tolerance(self, v: _Weighed, response: Array) -> float:
        """Return the smallest step in gamma worth taking."""
        xp = array_namespace(v=v.values)
        least = _TOLERANCE if v.values.dtype == xp.float64 else _TOLERANCE_FLOAT32
        if self.sample.noise is None and not self.selection.hard:
            return least
        error = min(_pair(ratio_errors(v.values, response)[0]))
        if self.selection.hard:
            # A step of the mean is one galaxy, and moves the null by an error over sqrt(n).
            return max(least, (_TOLERANCE_NOISY + 1.0 / math.sqrt(v.counted)) * error)
        return max(least, _TOLERANCE_NOISY * error)

    def _by_noise_power(self, gamma: Gamma, response: Array) -> Array:
        """Return by how much gamma moves for a relative change of the noise power by 1."""
        xp = array_namespace(response=response)
        more = replace(self, sample=self.sample.told_of_noise(1.0 + _POWER_STEP))
        # Both are looked at there: the search ends a step away from where it looked last.
        (now,), (changed,) = self._look((gamma,)), more._look((gamma,))
        moved = over_response(
            xp.mean(response, axis=0)[None, :, :],
            xp.mean(changed.values - now.values, axis=0)[None, :],
        )
        return xp.abs(moved[0, :]) / _POWER_STEP

    def _warn_of_eta(self, v: _Weighed) -> None:
        if self.sample.noise is None or self.sample.statistic.n_unknown == 2:
            return
        snr = to_numpy(v.snr)
        measured = snr[snr == snr]
        median = float(sorted(measured)[len(measured) // 2]) if len(measured) else 0.0
        if median < _LEAST_SNR_ETA:
            warnings.warn(
                f'statistic="eta" is biased by per cents and noisy below an S/N of '
                f'{_LEAST_SNR_ETA:g}; the median is {median:.3g} here. Use "frozen"',
                FdntWarning,
                stacklevel=6,
            )


@dataclass(frozen=True, kw_only=True)
class _Weighed:
    """The statistic of each galaxy times what it counts, how many count, and their S/N.

    `variance` is that of the values by the noise of the pixels.
    """

    values: Array
    variance: Array | None
    counted: int
    found: int
    masked: int
    filled: int
    snr: Array

    @classmethod
    def of(cls, frame: SampleValues, selection: Selection) -> _Weighed:
        weight = selection.weight(frame.quantities) if selection.cuts else None
        kept = frame.found if weight is None else frame.found & (weight > 0)
        values = frame.v if weight is None else frame.v * weight[:, None]
        variance = frame.v_variance
        if variance is not None and weight is not None:
            variance = variance * weight[:, None] ** 2
        return cls(
            values=values,
            variance=variance,
            counted=count_true(kept),
            found=count_true(frame.found),
            masked=count_true(has_any(frame.flags, int(Flag.MASKED))),
            filled=count_true(has_any(frame.flags, int(Flag.FILLED))),
            snr=frame.quantities.snr,
        )

    def refuse_too_few(self) -> None:
        n_gal = int(self.values.shape[0])
        if self.found < 2:
            raise FdntValueError(
                f"only {self.found} of {n_gal} galaxies can be used; a null needs two"
            )
        if self.counted < 2:
            raise FdntValueError(
                f"the cut keeps {self.counted} of {self.found} galaxies; a null needs two"
            )


def _pair(vector: Array) -> tuple[float, float]:
    return float(vector[0]), float(vector[1])
