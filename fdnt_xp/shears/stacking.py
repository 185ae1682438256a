"""The shear of a population from its stack: the null test of the mean galaxy.

B10 §5.3: before lensing the mean of isotropic galaxies is round at every isophote, so
after lensing it is a perfect ellipse, of shape `eta = 2 atanh|g|`, whatever the galaxies
look like. It has no ellipticity gradient, and no noise bias but its own, because the stack
is linear in the images. What it needs is centroids that follow the shear.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from functools import reduce
from types import ModuleType
from typing import Final

from fdnt_xp.arrays import (
    Array,
    Rows,
    array_namespace,
    as_floating,
    count_true,
    device_of,
    require_dtype,
)
from fdnt_xp.errors import FdntValueError, FdntWarning, ShapeMismatchError
from fdnt_xp.flags import flag_names
from fdnt_xp.fourier.psf import Psf
from fdnt_xp.fourier.transform import DeconvolvedStamps
from fdnt_xp.nulltests.tests import NullTests
from fdnt_xp.nulltests.weights import Weight
from fdnt_xp.shapes.centroid import wide_weight
from fdnt_xp.shapes.job import (
    Job,
    check_count,
    check_options,
    check_stamps,
    galaxies_at_once,
    prepare,
)
from fdnt_xp.shapes.results import ShapeResult
from fdnt_xp.shapes.search import first_guess, search
from fdnt_xp.shapes.sky import sky_frame
from fdnt_xp.shapes.solution import describe
from fdnt_xp.shear import reduced_shear_from_eta
from fdnt_xp.shears.estimate import ShearEstimate
from fdnt_xp.shears.sky import SampleSky
from fdnt_xp.shears.sky_stack import stack_on_sky
from fdnt_xp.shears.stack_sample import StackSample, StackShapes, common_weight, refuse_too_few
from fdnt_xp.shears.weights import galaxy_weights

_MAX_ITER: Final = 50
_PASSES: Final = 8
"""At most; each gains a factor of 50 or more, and one is enough for symmetric galaxies."""
_MOVED_LEAST: Final = {False: 1e-9, True: 1e-5}
"""Change of eta that ends the passes, in float64 and (True) in float32."""


def shear_from_stack(
    stamps: Array,
    psf: Psf,
    *,
    centroids: Array | None = None,
    galaxy_weight: Array | None = None,
    normalise: bool = False,
    n_groups: int = 20,
    jacobian: Array | None = None,
    padding: int = 1,
    chunk_size: int | None = None,
) -> ShearEstimate:
    """Estimate the reduced shear of a population from the mean of its galaxies.

    Each stamp is divided by its PSF and moved to its centroid in Fourier space, where
    neither step resamples anything; the mean is measured as one galaxy.

    Parameters
    ----------
    stamps : array, shape (n_gal, ny, nx)
        Images of one galaxy each, background taken off, as for `measure_shapes`.
    psf : Psf
        One for all stamps, or one for each: then the weight ends where the widest PSF ends.
    centroids : array, shape (n_gal, 2), optional
        (x, y) in pixels of the stamp, 0-based, as `ShapeResult.centroid`. They must follow
        the shear, as those of `measure_shapes` do for galaxies that look the same upside
        down, and do not for others (see Notes). By default found here, by the null of the
        dipole under a wide weight that is round once the shear is taken off.
    galaxy_weight : array, shape (n_gal,), optional
        What each image counts, for instance the inverse of a flux from elsewhere. It must
        not depend on the observed shape.
    normalise : bool
        Whether to divide each image by the sum of its pixels, which lensing by a shear does
        not change (a flux under a weight it does). Without it bright galaxies count more, and
        where fluxes depend on how a galaxy looks, as in simulations at one S/N as seen, the
        stack is biased: by 3 % in GREAT08.
    n_groups : int
        Groups of the jackknife: consecutive stamps, so that pairs stay together.
    jacobian : array, shape (2, 2) or (n_gal, 2, 2), optional
        `d(u, v)/d(x, y)` of the pixels, as for `measure_shapes`: the shear is then that on the
        sky. Where each galaxy has its own it is their null tests that are summed, which have
        the sky in common, not their images.
    padding : int
        Makes the k grid finer by this factor.
    chunk_size : int, optional
        Galaxies that are in work together. By default what fits 128 MB.

    Returns
    -------
    ShearEstimate
        `method` is "stack"; `g_err` is that of the jackknife. `n_excluded` counts stamps
        that are blank or not finite, have no usable PSF, no centroid, or, where it is asked
        for, no positive flux.

    Warns
    -----
    FdntWarning
        If stamps were left out; if a group's stack has no shape, then `g_err` is NaN.

    Raises
    ------
    FdntTypeError, NamespaceError, ShapeMismatchError
        If an argument is of the wrong type, library, dtype or shape.
    FdntValueError, RangeError
        If a number is out of range, a weight is negative or not finite, fewer than two
        stamps or groups are usable, or the stack has no shape.

    Notes
    -----
    *Measured* for a bulge off the centre of its disc (SPEC galaxy 3), PSF of half-light
    radius 2 pixels: m = 6e-2 with the centroids of `measure_shapes`, -2e-2 with those of a
    weight that is round on the image, below 1e-6 with those found here. The shear and the
    centroids depend on each other: stack and measurement are repeated until the shear stays.

    References
    ----------
    .. [1] Bernstein 2010, MNRAS 406, 2793, §5.3.
    """
    xp, stamps = check_stamps(stamps, psf)
    n_gal = int(stamps.shape[0])
    check_count("n_groups", n_groups, 2)
    check_options(size=None, padding=padding, chunk_size=chunk_size)
    if n_gal < 2:
        raise FdntValueError(f"stamps holds {n_gal} galaxies; a mean with an error needs two")
    everyone = xp.ones(n_gal, dtype=xp.bool, device=device_of(stamps))
    weights = xp.astype(galaxy_weights(everyone, galaxy_weight), stamps.dtype)
    centres = _from_the_middle(xp, stamps, centroids)
    regular = None
    single = jacobian is None or getattr(jacobian, "ndim", 2) == 2
    if jacobian is not None and single:
        psf = sky_frame(xp, stamps, n_gal, jacobian).seen_by(psf)
    elif jacobian is not None:
        sky = SampleSky.of(xp, stamps, psf, jacobian)
        psf, regular = sky.psf, sky.regular
    job = prepare(xp, stamps, psf, padding=padding, max_iter=_MAX_ITER)
    sample = StackSample(
        stamps=stamps,
        weights=weights,
        centres=centres,
        normalise=normalise,
        n_groups=min(n_groups, n_gal),
        chunks=job.chunks(n_gal, chunk_size or galaxies_at_once(job.coarse, stamps)),
        regular=regular,
    )
    shapes = _solved(job, sample) if single else stack_on_sky(job, sample)
    if shapes.n_excluded:
        warnings.warn(
            f"{shapes.n_excluded} of {n_gal} stamps left out of the stack: blank, not finite, or "
            "without a PSF, Jacobian, centroid or flux to use",
            FdntWarning,
            stacklevel=2,
        )
    return _estimate(shapes)


@dataclass(frozen=True, kw_only=True)
class _Stack:
    """Weighted sums over the galaxies of each group.

    `re`, `im` are (n_groups, n_k), `weight` is (n_groups,).
    """

    re: Array
    im: Array
    weight: Array
    n_used: int
    n_excluded: int

    def plus(self, other: _Stack) -> _Stack:
        """Return the sums over both."""
        return _Stack(
            re=self.re + other.re,
            im=self.im + other.im,
            weight=self.weight + other.weight,
            n_used=self.n_used + other.n_used,
            n_excluded=self.n_excluded + other.n_excluded,
        )


def _solved(job: Job, sample: StackSample) -> StackShapes:
    """Stack and measure until the centroids are those of the shear that is found.

    The null of a dipole under a weight that is round on the image does not follow the
    shear (docs, "Stacking"). Under one that is round with the shear taken off it does: so
    the shear found is put into the weight, and everything done again.
    """
    xp = array_namespace(stamps=sample.stamps)
    enough = _MOVED_LEAST[sample.stamps.dtype == xp.float32]
    weight = common_weight(job)
    shear = xp.zeros_like(sample.weights[:2])
    for _ in range(_PASSES):
        stack = reduce(
            _Stack.plus,
            (_stacked(job.of(part), weight, sample, part.rows, shear) for part in sample.chunks),
        )
        refuse_too_few(stack.weight, stack.n_used, stack.n_excluded)
        ny, nx = sample.stamps.shape[1:]
        shapes = _measure_means(job, weight, stack, (int(ny), int(nx)))
        if not bool(shapes.measured[0]):
            reasons = ", ".join(flag_names(int(shapes.flags[0])))
            raise FdntValueError(f"the stack has no shape: {reasons}")
        moved = float(xp.max(xp.abs(shapes.eta[0, :] - shear)))
        shear = shapes.eta[0, :]
        if sample.centres is not None or moved <= enough:
            break
    return StackShapes(
        eta=shapes.eta,
        measured=shapes.measured,
        weight=stack.weight,
        n_used=stack.n_used,
        n_excluded=stack.n_excluded,
    )


def _stacked(job: Job, weight: Weight, sample: StackSample, rows: Rows, shear: Array) -> _Stack:
    """Sum a chunk of galaxies, each moved to its centroid, by groups."""
    xp = array_namespace(shear=shear)
    grid, wide = job.coarse, None
    if sample.centres is None:
        wide = wide_weight(weight, grid, min(sample.stamps.shape[1:]), shear)
    seen = sample.centred(job, rows, wide)
    re, im = seen.galaxies.shifted(grid, seen.centres)
    counted = sample.members(rows) * seen.weights[None, :]
    return _Stack(
        re=xp.matmul(counted, re),
        im=xp.matmul(counted, im),
        weight=xp.sum(counted, axis=1),
        n_used=count_true(seen.weights > 0),
        n_excluded=count_true(~seen.usable),
    )


def _estimate(shapes: StackShapes) -> ShearEstimate:
    """Return the shear of the whole stack, row 0, with the jackknife's error from the rest."""
    xp = array_namespace(eta=shapes.eta)
    filled = shapes.weight > 0
    n_filled = count_true(filled)
    g = reduced_shear_from_eta(shapes.eta)
    # A group without weight leaves the stack as it is: it is no sample.
    inside = filled[:, None]
    without = g[1:, :]
    deviation = xp.where(inside, without - g[:1, :], xp.zeros_like(without))
    deviation = xp.where(inside, deviation - xp.sum(deviation, axis=0) / n_filled, deviation)
    variance = xp.sum(deviation**2, axis=0) * ((n_filled - 1.0) / n_filled)
    if not bool(xp.all(shapes.measured[1:])):
        warnings.warn("the stack without one of its groups has no shape", FdntWarning, stacklevel=3)
    return ShearEstimate(
        g=g[0, :],
        g_err=xp.sqrt(variance),
        n_used=shapes.n_used,
        method="stack",
        n_excluded=shapes.n_excluded,
    )


def _measure_means(
    job: Job, weight: Weight, stack: _Stack, stamp_shape: tuple[int, int]
) -> ShapeResult:
    """Return the shape of the whole stack, row 0, and without each group in turn."""
    xp = array_namespace(re=stack.re)
    count = xp.sum(stack.weight)

    def means(sums: Array) -> Array:
        whole = xp.sum(sums, axis=0)
        rest = (whole[None, :] - sums) / (count - stack.weight)[:, None]
        return xp.concat([whole[None, :] / count, rest], axis=0)

    galaxies = DeconvolvedStamps(re=means(stack.re), im=means(stack.im))
    tests = NullTests(grid=job.coarse, galaxies=galaxies, weight=weight, length=job.length)
    guess = first_guess(replace(job, weight=weight), tests, min(stamp_shape))
    root = search(tests, guess, max_iter=job.max_iter)
    unknown = xp.full_like(galaxies.re[:, 0], float("nan"))
    return describe(
        tests,
        root,
        inverse_power=xp.ones_like(galaxies.re[:1, :]),
        noise_per_mode=unknown,  # the error is that of the jackknife
        stamp_shape=stamp_shape,
        flags=xp.zeros_like(unknown, dtype=xp.int32),
    )


def _from_the_middle(xp: ModuleType, stamps: Array, centroids: Array | None) -> Array | None:
    """Return the caller's centroids in pixels from the middle of the stamp."""
    if centroids is None:
        return None
    array_namespace(stamps=stamps, centroids=centroids)
    centroids = as_floating(xp, centroids, "centroids")
    require_dtype(stamps.dtype, centroids=centroids)
    n_gal, ny, nx = (int(n) for n in stamps.shape)
    if centroids.shape != (n_gal, 2):
        raise ShapeMismatchError(
            f"centroids must have the shape ({n_gal}, 2), not {tuple(centroids.shape)}"
        )
    middle = xp.asarray(
        [0.5 * (nx - 1), 0.5 * (ny - 1)], dtype=stamps.dtype, device=device_of(stamps)
    )
    return centroids - middle
