"""Batches of the same objects in several bands, joined to one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fdnt_xp.data.exposures import ExposureBatch, check_known
from fdnt_xp.errors import ShapeMismatchError


def join_bands(batches: Sequence[ExposureBatch]) -> ExposureBatch:
    """Return the stamps of the same objects in several bands as one batch.

    Parameters
    ----------
    batches : sequence of ExposureBatch
        At least one; the band of each is its place in the sequence.

    Raises
    ------
    ShapeMismatchError
        If they are of different objects.
    FdntValueError
        If the noise of only some is known, or of none where stamps of several sizes are to be
        made equal by missing pixels.
    """
    first = batches[0]
    for number, one in enumerate(batches):
        if not np.array_equal(one.ids, first.ids):
            raise ShapeMismatchError(f"band {number} is of other objects than band 0")
    dtype = np.result_type(*(one.stamps for one in batches))
    order = np.argsort(np.concatenate([one.object_index for one in batches]), kind="stable")

    def joined(parts: Sequence[NDArray[Any]]) -> NDArray[Any]:
        return np.concatenate(parts)[order]

    n_before = np.cumsum([0, *(len(one.stars) for one in batches)])
    bands = zip(batches, n_before, strict=False)
    batch = ExposureBatch(
        ids=first.ids,
        object_index=joined([one.object_index for one in batches]),
        stamps=joined(_padded([one.stamps for one in batches], dtype)),
        stars=np.concatenate(_padded([one.stars for one in batches], dtype)),
        psf_index=joined([one.psf_index + before for one, before in bands]),
        origin=joined([one.origin for one in batches]),
        jacobian=joined([one.jacobian for one in batches]),
        band=joined([np.full(one.n_stamps, i, dtype=np.int64) for i, one in enumerate(batches)]),
    )
    some = [one for one in batches if one.n_stamps] or [first]
    uneven = len({one.stamps.shape[1:] for one in some}) > 1
    known = [one.ivar is not None or one.noise_variance is not None for one in some]
    check_known(known, uneven)
    if not any(known):
        return batch
    if not uneven and all(one.ivar is None for one in some):
        variances = [np.zeros(0) if v is None else v for v in (o.noise_variance for o in batches)]
        return replace(batch, noise_variance=joined(variances).astype(dtype))
    return replace(batch, ivar=joined(_padded([_inverse(one) for one in batches], dtype)))


def _padded(cubes: Sequence[NDArray[Any]], dtype: np.dtype[Any]) -> list[NDArray[Any]]:
    """Return cubes whose planes have one shape, with zeros above and to the right."""
    ny, nx = np.max([cube.shape[1:] for cube in cubes], axis=0)
    return [
        np.pad(cube.astype(dtype), ((0, 0), (0, ny - cube.shape[1]), (0, nx - cube.shape[2])))
        for cube in cubes
    ]


def _inverse(batch: ExposureBatch) -> NDArray[Any]:
    """Return the inverse variance of each pixel of a batch of which the noise is known."""
    if batch.ivar is not None:
        return batch.ivar
    if batch.noise_variance is None:  # there are no stamps
        return np.zeros(batch.stamps.shape)
    return np.broadcast_to(1.0 / batch.noise_variance[:, None, None], batch.stamps.shape)
