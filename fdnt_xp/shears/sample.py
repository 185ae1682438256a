"""From a caller's stamps, PSF and noise to a sample that can be looked at in any frame."""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import ModuleType
from typing import Final, Literal, TypeAlias

from fdnt_xp.arrays import Array, array_namespace, device_of
from fdnt_xp.errors import FdntTypeError, FdntValueError, RangeError, ShapeMismatchError
from fdnt_xp.fourier.noise import PixelNoise
from fdnt_xp.fourier.psf import Psf
from fdnt_xp.shapes.job import check_count, check_options, check_stamps, galaxies_at_once, prepare
from fdnt_xp.shapes.pixels import noise_column, power_noise
from fdnt_xp.shears.counter_shear import FrozenQuadrupole, SolvedEta, Statistic
from fdnt_xp.shears.frames import FrameSample, SampleNoise
from fdnt_xp.shears.masks import Masked, SampleMask
from fdnt_xp.shears.weights import ShapeWeight

StatisticName: TypeAlias = Literal["frozen", "eta"]

_FROZEN_SIZE: Final = 1.5
"""Default size of the frozen weight in lengths of about the size of the PSF. The error of
the shear is flat around it: 2 % more at 0.7 and 2 times the best."""
_NOISY_FLOOR: Final = 3e-4
"""Where 𝒯 ends in noisy data: the error of the shear is the same from 1e-2 to 1e-4. The sharper
end of a higher floor reaches around stamps of 48 pixels: 1e-3 leaves m = -3e-4."""
_BOUNDED: Final = 1.5
"""`|eta|` at which the influence of noisy shapes has fallen to nothing: beyond, the squeezed
weight covers too few cells of the k grid to be the same in all directions."""
LARGEST_SHEAR: Final = 0.3
"""`|g|` beyond which the weight's disc would have to shrink to less than three quarters."""


@dataclass(frozen=True, kw_only=True)
class NoiseOptions:
    """What a caller says of the noise; see `population_null`."""

    noise_variance: float | Array | None
    noise_power: Array | None
    isotropise: bool | None
    seed: int
    identifiers: Array | None
    symmetry: Array | None


def make_sample(
    stamps: Array,
    psf: Psf,
    *,
    statistic: StatisticName,
    weight: ShapeWeight | None,
    size: float | None,
    softening: float,
    bound: float = 0.0,
    max_shear: float,
    padding: int,
    chunk_size: int | None,
    noise: NoiseOptions,
    mask: Array | None = None,
    masked: Masked = "drop",
) -> FrameSample:
    """Check everything, and choose weight, statistic and chunks.

    Raises
    ------
    FdntValueError, RangeError, FdntTypeError, NamespaceError, ShapeMismatchError
        As `population_null`.
    """
    xp, stamps = check_stamps(stamps, psf)
    check_options(size=size, padding=padding, chunk_size=chunk_size)
    if not 0.0 < max_shear <= LARGEST_SHEAR:
        raise RangeError("max_shear", max_shear, 0.0, LARGEST_SHEAR)
    _check_statistic(statistic, weight, softening=softening, bound=bound)
    sample_noise = _sample_noise(xp, stamps, noise)
    noisy = sample_noise is not None
    seen_by = psf.ending_at(_NOISY_FLOOR) if noisy else psf
    job = prepare(xp, stamps, seen_by, padding=padding, matched=statistic == "eta" and not noisy)
    frozen_size = default_size(psf) if size is None else size
    chosen: Statistic
    if statistic == "frozen":
        chosen = FrozenQuadrupole(
            size=frozen_size,
            length=job.length,
            softening=softening,
            bound=bound,
            farthest=0.5 * min(int(n) for n in stamps.shape[1:]),
        )
    else:
        bounded = ShapeWeight.bisquare(_BOUNDED) if noisy else ShapeWeight.uniform()
        chosen = SolvedEta(
            weight=weight or bounded,
            length=job.length,
            # A size that is free is as noisy as the shape itself.
            size=frozen_size if noisy else size,
            window_size=frozen_size,
        )
    return FrameSample(
        stamps=stamps,
        job=job,
        statistic=chosen,
        reach=math.sqrt((1.0 + max_shear) / (1.0 - max_shear)),
        chunk_size=chunk_size or galaxies_at_once(job.coarse, stamps),
        noise=sample_noise,
        # On the image the weight is convolved with something as wide as the PSF.
        mask=SampleMask.of(xp, stamps, mask, masked, math.hypot(frozen_size, job.length)),
    )


def _check_statistic(
    statistic: str, weight: ShapeWeight | None, *, softening: float, bound: float
) -> None:
    """Refuse a statistic that there is not, and options that are out of range or another's."""
    if statistic not in ("frozen", "eta"):
        raise FdntValueError(f'statistic must be "frozen" or "eta", not {statistic!r}')
    if weight is not None and statistic == "frozen":
        raise FdntValueError('weight goes with statistic="eta"; "frozen" is bounded by itself')
    for name, value in (("softening", softening), ("bound", bound)):
        if not (math.isfinite(value) and value >= 0.0):
            raise RangeError(name, value, 0.0, None)
    if bound > 0.0 and statistic != "frozen":
        raise FdntValueError('bound goes with statistic="frozen"; "eta" takes a weight')


def default_size(psf: Psf) -> float:
    """Return the default size of the frozen weight for galaxies with these PSFs, pixels.

    Parts of a sample that are measured apart, with PSFs of their own, are one sample only
    if they are given one `size`.
    """
    return _FROZEN_SIZE * 3.0 / psf.largest_kmax


def _sample_noise(xp: ModuleType, stamps: Array, options: NoiseOptions) -> SampleNoise | None:
    """Return what is known of the noise, or None."""
    n_gal = int(stamps.shape[0])
    if options.noise_variance is not None and options.noise_power is not None:
        raise FdntValueError("give noise_variance or noise_power, not both")
    if options.noise_power is not None:
        pixels = power_noise(xp, stamps, options.noise_power)
    elif options.noise_variance is None:
        if options.isotropise:
            raise FdntValueError("isotropise needs noise_variance or noise_power")
        return None
    else:
        variance = _variances(xp, stamps, options.noise_variance)
        if variance is None:
            if options.isotropise:
                raise FdntValueError(
                    "noise_variance is 0: there is no noise to make round; leave isotropise out"
                )
            return None
        pixels = PixelNoise(variance=variance)
    symmetry = _whole_numbers(xp, stamps, "noise_symmetry", options.symmetry)
    if symmetry is not None and stamps.shape[1] != stamps.shape[2]:
        raise FdntValueError("noise_symmetry needs square stamps")
    identifiers = _whole_numbers(xp, stamps, "identifiers", options.identifiers)
    if identifiers is None:
        identifiers = xp.arange(n_gal, dtype=xp.int64, device=device_of(stamps))
    check_count("seed", abs(options.seed), 0)
    return SampleNoise(
        pixels=pixels,
        isotropise=options.isotropise is not False,
        identifiers=identifiers,
        seed=int(options.seed),
        symmetry=symmetry,
    )


def _variances(xp: ModuleType, stamps: Array, given: float | Array) -> Array | None:
    """Return the variance of each galaxy's pixels, or None where all are 0."""
    variance = noise_column(xp, given, stamps)
    if not bool(xp.all(xp.isfinite(variance) & (variance >= 0))):
        raise FdntValueError("noise_variance must be finite and not negative, for each galaxy")
    return variance if bool(xp.any(variance > 0)) else None


def _whole_numbers(xp: ModuleType, stamps: Array, name: str, given: Array | None) -> Array | None:
    """Return an integer of each galaxy as int64, or None."""
    if given is None:
        return None
    array_namespace(**{"stamps": stamps, name: given})
    if not xp.isdtype(given.dtype, "integral"):
        raise FdntTypeError(f"{name} must hold whole numbers, but has dtype {given.dtype}")
    if given.shape != (int(stamps.shape[0]),):
        raise ShapeMismatchError(
            f"{name} must have the shape ({stamps.shape[0]},), not {tuple(given.shape)}"
        )
    return xp.astype(given, xp.int64)
