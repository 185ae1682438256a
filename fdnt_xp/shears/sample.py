"""From a caller's stamps, PSF and noise to a sample that can be looked at in any frame."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Final, Literal, TypeAlias

from fdnt_xp.arrays import Array, array_namespace, count_true, device_of
from fdnt_xp.errors import FdntTypeError, FdntValueError, RangeError, ShapeMismatchError
from fdnt_xp.fourier.noise import PixelNoise
from fdnt_xp.fourier.psf import Psf
from fdnt_xp.shapes.job import check_count, check_options, check_stamps, galaxies_at_once, prepare
from fdnt_xp.shapes.pixels import noise_column, power_noise
from fdnt_xp.shears.counter_shear import FrozenQuadrupole, SolvedEta
from fdnt_xp.shears.frames import FrameSample, SampleNoise
from fdnt_xp.shears.masks import Masked, SampleMask
from fdnt_xp.shears.sky import SampleSky
from fdnt_xp.shears.weights import ShapeWeight

StatisticName: TypeAlias = Literal["frozen", "eta"]

_PER_PSF: Final = 1.5
"""Size of the frozen weight, where the galaxies are not looked at, in lengths of about the
size of the PSF."""
_MORE_FIELDS: Final = 6
"""Arrays of the size of the transforms that a frame holds besides: noise, and galaxies with it."""
_PER_GALAXY: Final = 1.15
"""The same in sizes of a typical galaxy, as seen under that weight. The error of the shear is
within 1 % of its least for exponential and de Vaucouleurs galaxies from half to one and a half
times as large as the PSF."""
_LEAST: Final = 1.0
"""Of it, in lengths of about the size of the PSF: an even narrower one gathers noise."""
_MOST: Final = 1.0 / 16.0
"""Of it, in sides of a stamp: a wider one reaches around."""
_LOOKED_AT: Final = 400
"""Galaxies whose sizes are looked at: at S/N 15 their median is good to 2 %."""
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

    noise_variance: float | Array | None = None
    noise_power: Array | None = None
    isotropise: bool | None = None
    seed: int = 0
    identifiers: Array | None = None
    symmetry: Array | None = None


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
    jacobian: Array | None = None,
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
    sky = None if jacobian is None else SampleSky.of(xp, stamps, psf, jacobian)
    unit_length = 1.0 if sky is None else sky.unit_length
    psf = psf if sky is None else sky.psf
    size = None if size is None else size / unit_length
    seen_by = psf.ending_at(_NOISY_FLOOR) if noisy else psf
    job = prepare(xp, stamps, seen_by, padding=padding, matched=statistic == "eta" and not noisy)

    def under(frozen: float) -> FrameSample:
        """Return the sample under a frozen weight of the given size."""
        return FrameSample(
            stamps=stamps,
            job=job,
            statistic=FrozenQuadrupole(
                size=frozen,
                length=job.length,
                softening=softening,
                bound=bound,
                farthest=0.5 * min(int(n) for n in stamps.shape[1:]),
            ),
            reach=math.sqrt((1.0 + max_shear) / (1.0 - max_shear)),
            chunk_size=chunk_size
            or galaxies_at_once(job.coarse, stamps, _MORE_FIELDS * job.coarse.n_k, only_tests=True),
            noise=sample_noise,
            # On the image the weight is convolved with something as wide as the PSF.
            mask=SampleMask.of(xp, stamps, mask, masked, math.hypot(frozen, job.length)),
            regular=None if sky is None else sky.regular,
            unit_length=unit_length,
        )

    frozen_size = _PER_PSF * 3.0 / _widest(psf) if size is None else size
    if noisy and size is None:
        frozen_size = _size_for(under(frozen_size), frozen_size)
    sample = under(frozen_size)
    if statistic == "frozen":
        return sample
    bounded = ShapeWeight.bisquare(_BOUNDED) if noisy else ShapeWeight.uniform()
    solved = SolvedEta(
        weight=weight or bounded,
        length=job.length,
        # A size that is free is as noisy as the shape itself.
        size=frozen_size if noisy else size,
        window_size=frozen_size,
    )
    return replace(sample, statistic=solved)


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


def _widest(psf: Psf) -> float:
    """Return where the weight that reaches farthest ends, on the sky if there is one, rad/pixel."""
    if psf.unit_jacobian is None or psf.n_psf == 0:
        return psf.largest_kmax
    return float(array_namespace(kmax=psf.kmax).max(psf.kmax))


def default_size(
    stamps: Array,
    psf: Psf,
    *,
    noise_variance: float | Array | None = None,
    noise_power: Array | None = None,
    max_shear: float = 0.1,
    padding: int = 1,
    jacobian: Array | None = None,
) -> float:
    """Return the size of the frozen weight that `population_null` takes by default.

    In pixels, or with a Jacobian in the unit of the sky.

    1.15 times the median size, before the PSF, of some 400 galaxies all over the sample, but
    no less than about the size of the PSF and no more than a sixteenth of the stamp. Any size
    is unbiased, this one has small errors. Without noise it is 1.5 times that of the PSF.

    A sample that is measured in parts is measured as one if all parts are given one `size`:
    that of the whole, or of a part that is like the others.

    Parameters
    ----------
    stamps, psf, noise_variance, noise_power, max_shear, padding, jacobian
        As for `population_null`; for `measure_responses` `max_shear` is its step.

    Raises
    ------
    FdntValueError, RangeError, FdntTypeError, NamespaceError, ShapeMismatchError
        As `population_null`.
    """
    sample = make_sample(
        stamps,
        psf,
        statistic="frozen",
        weight=None,
        size=None,
        softening=1.0,
        max_shear=max_shear,
        padding=padding,
        chunk_size=None,
        noise=NoiseOptions(noise_variance=noise_variance, noise_power=noise_power),
        jacobian=jacobian,
    )
    assert isinstance(sample.statistic, FrozenQuadrupole)
    return sample.statistic.size * sample.unit_length


def rows_for_size(n_gal: int) -> slice:
    """Return which galaxies of a sample `default_size` looks at."""
    return slice(0, n_gal, max(1, n_gal // _LOOKED_AT))


def _size_for(sample: FrameSample, psf_size: float) -> float:
    """Return the size of the weight that suits the galaxies, seen under one that suits the PSF."""
    if sample.n_gal == 0 or sample.noise is None:
        return psf_size
    xp = array_namespace(stamps=sample.stamps)
    rows = rows_for_size(sample.n_gal)
    every = {"dtype": xp.int64, "device": device_of(sample.stamps)}
    as_it_is = replace(sample, noise=replace(sample.noise, isotropise=False))
    some = as_it_is.take(xp.arange(rows.start, rows.stop, rows.step, **every))
    (seen,) = some.evaluate(((0.0, 0.0),))
    sizes = seen.quantities.size / sample.unit_length
    known = xp.isfinite(sizes)
    n_known = count_true(known)
    if n_known == 0:
        return psf_size
    ordered = xp.sort(xp.where(known, sizes, xp.full_like(sizes, math.inf)))
    least = psf_size * _LEAST / _PER_PSF
    most = _MOST * min(int(n) for n in sample.stamps.shape[1:])
    # A host read: the size is a number for the whole sample.
    typical = float(ordered[(n_known - 1) // 2])
    return max(least, min(_PER_GALAXY * typical, most))


def _sample_noise(xp: ModuleType, stamps: Array, options: NoiseOptions) -> SampleNoise | None:
    """Return what is known of the noise, or None."""
    n_gal = int(stamps.shape[0])
    if options.noise_variance is not None and options.noise_power is not None:
        raise FdntValueError("give noise_variance or noise_power, not both")
    if options.noise_power is not None:
        pixels = power_noise(xp, stamps, options.noise_power).without_window()
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
