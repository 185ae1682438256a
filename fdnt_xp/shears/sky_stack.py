"""The stack of galaxies whose pixels are not alike on the sky: the sum of their null tests.

Images on different pixels have no common grid on which to be added. Their null tests have one
frame, the sky: a test is linear in the image, so that the sum of the tests of all galaxies, each
at its own wave numbers `A k` and moved to its centroid, is the test of their mean.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import reduce
from typing import Final

from fdnt_xp.arrays import Array, array_namespace, count_true, device_of
from fdnt_xp.errors import FdntValueError
from fdnt_xp.nulltests.scaled import scaled_tests
from fdnt_xp.nulltests.small_systems import newton_step
from fdnt_xp.nulltests.tests import NullTests
from fdnt_xp.nulltests.values import MatchedWidth, TestValues, inverse_mean_square
from fdnt_xp.nulltests.weights import Weight
from fdnt_xp.shapes.centroid import wide_weight
from fdnt_xp.shapes.job import Chunk, Job
from fdnt_xp.shears.stack_sample import (
    StackSample,
    StackShapes,
    common_weight,
    refuse_too_few,
)

_PASSES: Final = 30
"""At most: Newton's steps, quadratic but for centroids that follow the shear."""
_MOVED_LEAST: Final = {False: 1e-9, True: 1e-5}
"""Step of eta that ends them, in float64 and (True) in float32."""
_LONGEST: Final = 0.5
"""Of a step in eta, that no step jumps to another root."""


@dataclass(frozen=True, kw_only=True)
class _Sums:
    """Sums over the galaxies of each group, row by row; on the sky, in its unit of length.

    `n_used` and `n_excluded` are those of all groups.
    """

    values: Array
    by_parameter: Array
    by_ln_shrink: Array
    flux: Array
    square: Array
    weight: Array
    n_used: int
    n_excluded: int

    def plus(self, other: _Sums) -> _Sums:
        """Return the sums over both."""
        return _Sums(
            values=self.values + other.values,
            by_parameter=self.by_parameter + other.by_parameter,
            by_ln_shrink=self.by_ln_shrink + other.by_ln_shrink,
            flux=self.flux + other.flux,
            square=self.square + other.square,
            weight=self.weight + other.weight,
            n_used=self.n_used + other.n_used,
            n_excluded=self.n_excluded + other.n_excluded,
        )


def stack_on_sky(job: Job, sample: StackSample) -> StackShapes:
    """Solve the summed null tests, with centroids that follow the shear found.

    Parameters
    ----------
    job : Job
        With a PSF through the Jacobian of each galaxy, wave numbers of all in one unit.
    sample : StackSample

    Raises
    ------
    FdntValueError
        If fewer than two galaxies or groups can be used, or there is no root.
    """
    xp = array_namespace(stamps=sample.stamps)
    enough = _MOVED_LEAST[sample.stamps.dtype == xp.float32]
    weight = replace(common_weight(job), frame=None)
    like = {"dtype": sample.stamps.dtype, "device": device_of(sample.stamps)}
    x, width = xp.zeros((1, 4), **like), xp.full((1,), job.length**2, **like)
    for _ in range(_PASSES):
        parts = (_of_chunk(job, part, weight, sample, x, width) for part in sample.chunks)
        sums = reduce(_Sums.plus, parts)
        refuse_too_few(sums.weight, sums.n_used, sums.n_excluded)
        steps, regular = _newton_steps(job, sums, x)
        moved = float(xp.max(xp.abs(steps[0, :2])))
        if not bool(regular[0]):
            break
        if moved <= enough:
            return StackShapes(
                eta=(x + steps)[:, :2],
                measured=regular,
                weight=sums.weight,
                n_used=sums.n_used,
                n_excluded=sums.n_excluded,
            )
        x = x + steps[:1, :] * min(1.0, _LONGEST / moved)
        width = _matched_width(weight, sums, x)
    raise FdntValueError("the stack has no shape: its null tests have no root near a round galaxy")


def _newton_steps(job: Job, sums: _Sums, x: Array) -> tuple[Array, Array]:
    """Return Newton's step of the whole stack, row 0, and of it without each group; (n, 4).

    The second are from the root of the whole, and so short that one is enough.
    """
    xp = array_namespace(x=x)

    def rows(of_groups: Array) -> Array:
        whole = xp.sum(of_groups, axis=0, keepdims=True)
        return xp.concat([whole, whole - of_groups], axis=0)

    values = rows(sums.values)
    zero = xp.zeros_like(values[:, 0])
    tests = TestValues(
        values=values,
        by_parameter=rows(sums.by_parameter),
        by_ln_shrink=rows(sums.by_ln_shrink),
        by_width=xp.zeros_like(values),
    )
    held = MatchedWidth.held(zero, zero, zero)
    eta = xp.broadcast_to(x[:, :2], (int(zero.shape[0]), 2))
    f, jac = scaled_tests(eta, tests, held, job.length)
    steps, regular = newton_step(xp, f, jac)
    return steps, regular & xp.all(xp.isfinite(steps), axis=-1) & (values[:, 4] > 0)


def _of_chunk(
    job: Job, part: Chunk, weight: Weight, sample: StackSample, x: Array, width: Array
) -> _Sums:
    """Sum the tests of some galaxies, each moved to its centroid, by groups."""
    own = job.of(part)
    xp = array_namespace(x=x)
    members = sample.members(part.rows)
    n_gal = int(members.shape[1])
    weight = _of_each(weight, own.weight, n_gal)
    assert weight.frame is not None
    wide = None
    if sample.centres is None:
        side = min(int(n) for n in sample.stamps.shape[1:])
        wide = wide_weight(weight, job.coarse, side, x[0, :2])
    seen = sample.centred(own, part.rows, wide)
    to_stamp = xp.matrix_transpose(weight.frame)
    offset = xp.sum(to_stamp * (job.length * x[:, None, 2:]), axis=-1)
    tests = NullTests(
        grid=job.coarse,
        galaxies=seen.galaxies,
        weight=weight,
        length=job.length,
        fixed_width=xp.broadcast_to(width, (n_gal,)),
    )
    eta = xp.broadcast_to(x[:, :2], (n_gal, 2))
    found, matched = tests.at(eta, seen.centres + offset)
    # A mode stands for more of the sky's wave numbers the smaller the pixels are.
    a = weight.frame
    area = xp.abs(a[:, 0, 0] * a[:, 1, 1] - a[:, 0, 1] * a[:, 1, 0])
    counted = members * (seen.weights * area)[None, :]

    def summed(values: Array) -> Array:
        flat = xp.reshape(values, (n_gal, -1))
        total = xp.matmul(counted, flat)
        return xp.reshape(total, (sample.n_groups, *(int(n) for n in values.shape[1:])))

    by_sky = xp.matmul(found.by_parameter[:, :, 2:], to_stamp)
    slopes = xp.concat([found.by_parameter[:, :, :2], by_sky], axis=-1)
    return _Sums(
        values=summed(_turned(found.values[:, :, None], a)[:, :, 0]),
        by_parameter=summed(_turned(slopes, a)),
        by_ln_shrink=summed(_turned(found.by_ln_shrink[:, :, None], a)[:, :, 0]),
        flux=summed(matched.flux[:, None]),
        square=summed(matched.square[:, None]),
        weight=xp.sum(members * seen.weights[None, :], axis=1),
        n_used=count_true(seen.weights > 0),
        n_excluded=count_true(~seen.usable),
    )


def _turned(tests: Array, frame: Array) -> Array:
    """Return tests (t1, t2, tx, ty, t0), (n_gal, 5, d), with their dipoles along the sky."""
    xp = array_namespace(tests=tests)
    return xp.concat([tests[:, :2, :], xp.matmul(frame, tests[:, 2:4, :]), tests[:, 4:, :]], axis=1)


def _of_each(weight: Weight, own: Weight, n_gal: int) -> Weight:
    """Return the common weight in the frame of the pixels of each galaxy."""
    xp = array_namespace(kmax=weight.kmax)
    assert own.frame is not None  # `SampleSky` made the PSF
    first = xp.zeros(n_gal, dtype=xp.int64, device=device_of(weight.kmax))
    return Weight(
        psf_part=weight.psf_part,
        kmax=xp.take(weight.kmax, first),
        frame=xp.broadcast_to(own.frame, (n_gal, 2, 2)),
        index=first,
    )


def _matched_width(weight: Weight, sums: _Sums, x: Array) -> Array:
    """Return the width of the weight that matches the stack, shape (1,)."""
    xp = array_namespace(x=x)
    flux, square = xp.sum(sums.flux, axis=0), xp.sum(sums.square, axis=0)
    inverse, _ = inverse_mean_square(flux, square)
    shrink = xp.exp(0.5 * xp.sqrt(xp.sum(x[:, :2] ** 2, axis=-1)))
    width, _, _ = weight.matched_width(inverse, shrink)
    return width
