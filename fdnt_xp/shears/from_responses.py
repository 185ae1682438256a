"""The shear of galaxies from their responses: any rows of a catalog, with any cut.

`g = <R>⁻¹ <v>`. With a cut, `<v>` is that of the galaxies that pass it as they are seen, and
`<R>` contains what the cut does: it is applied in the frame of each counter-shear.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from fdnt_xp.arrays import Array, array_namespace, as_floating, count_true, require_dtype
from fdnt_xp.errors import FdntTypeError, FdntValueError, ShapeMismatchError
from fdnt_xp.shear import reduced_shear_from_eta
from fdnt_xp.shears.cuts import QUANTITIES, CutLike, FrameQuantities, Selection
from fdnt_xp.shears.estimate import ShearEstimate
from fdnt_xp.shears.ratio import over_response, ratio_errors
from fdnt_xp.shears.responses import COLUMNS, FRAMES, ResponseResult

if TYPE_CHECKING:
    from astropy.table import Table


def shear_from_responses(
    responses: ResponseResult | Mapping[str, Any] | Table,
    *,
    cut: CutLike | None = None,
    galaxy_weight: Array | None = None,
) -> ShearEstimate:
    """Estimate the shear of galaxies, or of those that pass a cut, from their responses.

    Parameters
    ----------
    responses : ResponseResult, astropy.table.Table or mapping of arrays
        From `measure_responses`, or the catalog of it: any rows of one.
    cut : Cut, sequence of Cut, dict of (low, high), or callable, optional
        As for `population_null`. It is applied in all five frames, so that its own
        response to shear is included.
    galaxy_weight : array, shape (n_gal,), optional
        Multiplies what each galaxy counts. Not a function of anything that shear changes.

    Returns
    -------
    ShearEstimate
        `responsivity` is half the trace of the mean response.

    Raises
    ------
    FdntValueError
        If fewer than two galaxies are left, or they do not respond to shear.
    FdntTypeError, ShapeMismatchError
        If `responses` lacks a column, or `galaxy_weight` does not fit.

    Notes
    -----
    `g = <R>⁻¹ <v>` is exact to second order in the shear: `m` is of order `g²/10`.
    """
    result = responses if isinstance(responses, ResponseResult) else _from_columns(responses)
    xp = array_namespace(v=result.v)
    selection = Selection.of(cut)
    good = result.measured
    frame_weights = [_frame_weight(result, selection, frame, good) for frame in range(len(FRAMES))]
    if galaxy_weight is not None:
        extra = _galaxy_weight(result, galaxy_weight)
        frame_weights = [weight * extra for weight in frame_weights]
    n_used = count_true(frame_weights[0] > 0)
    if n_used < 2:
        raise FdntValueError(
            f"{n_used} of {result.n_gal} galaxies are measured"
            f"{' and pass the cut' if selection.cuts else ''}; a shear needs two"
        )
    v = xp.where(good[:, None], result.v, xp.zeros_like(result.v))
    slope = xp.where(good[:, None, None], result.response, xp.zeros_like(result.response))
    response = []
    for j in (0, 1):
        plus, minus = frame_weights[1 + 2 * j], frame_weights[2 + 2 * j]
        # The derivative of a product; the mean of plus and minus is v itself, to O(h²).
        of_cut = v * ((plus - minus) / (2.0 * result.step))[:, None]
        response.append(slope[:, :, j] * (0.5 * (plus + minus))[:, None] + of_cut)
    each = xp.stack(response, axis=-1)
    values = v * frame_weights[0][:, None]
    mean_response = xp.mean(each, axis=0)
    g = over_response(mean_response[None, :, :], xp.mean(values, axis=0)[None, :])[0, :]
    if not bool(xp.all(xp.isfinite(g))):
        raise FdntValueError("the mean of v does not respond to shear")
    errors = ratio_errors(values, each)
    return ShearEstimate(
        # To third order what adds up is eta: 2 atanh g is what the frames are steps of.
        g=reduced_shear_from_eta(2.0 * g),
        g_err=errors[0],
        n_used=n_used,
        n_excluded=count_true(good) - n_used,
        method="responses",
        g_err_jackknife=errors[1],
        responsivity=float(0.5 * (mean_response[0, 0] + mean_response[1, 1])),
    )


def _frame_weight(result: ResponseResult, selection: Selection, frame: int, good: Array) -> Array:
    """Return what each galaxy counts in one frame, shape (n_gal,)."""
    xp = array_namespace(v=result.v)
    if selection.cuts:
        quantities = {name: getattr(result, name)[:, frame] for name in QUANTITIES}
        weight = selection.weight(FrameQuantities(**quantities))
    else:
        weight = xp.ones_like(result.v[:, 0])
    return xp.where(good, weight, xp.zeros_like(weight))


def _galaxy_weight(result: ResponseResult, given: Array) -> Array:
    xp = array_namespace(v=result.v, galaxy_weight=given)
    given = as_floating(xp, given, "galaxy_weight")
    require_dtype(result.v.dtype, galaxy_weight=given)
    if given.shape != (result.n_gal,):
        raise ShapeMismatchError(
            f"galaxy_weight must have the shape ({result.n_gal},), not {tuple(given.shape)}"
        )
    if not bool(xp.all(xp.isfinite(given) & (given >= 0))):
        raise FdntValueError("galaxy_weight must be finite and not negative")
    return given


def _from_columns(table: Mapping[str, Any] | Table) -> ResponseResult:
    """Return the result whose columns a table or a mapping has."""
    names = getattr(table, "colnames", None) or (
        list(table) if isinstance(table, Mapping) else None
    )
    if names is None:
        raise FdntTypeError(
            "responses must be a ResponseResult, a table or a mapping of columns, not "
            f"{type(table).__name__}"
        )
    missing = [name for name in COLUMNS if name not in names and name not in ("x", "y")]
    if missing:
        raise FdntTypeError(f"responses has no column {', '.join(missing)}")
    columns = {name: _column(table[name]) for name in COLUMNS if name in names}
    xp = array_namespace(v1=columns["v1"])
    step = getattr(table, "meta", {}).get("RSTEP")
    if step is None:
        raise FdntTypeError('responses must tell the step of its frames in meta["RSTEP"]')

    def rows(*names: str) -> Array:
        return xp.stack([columns[name] for name in names], axis=-1)

    quantities = {name: rows(*(name + suffix for suffix in FRAMES)) for name in QUANTITIES}
    v = rows("v1", "v2")
    return ResponseResult(
        v=v,
        response=xp.stack([rows("R11", "R12"), rows("R21", "R22")], axis=1),
        centroid=rows("x", "y") if "x" in columns and "y" in columns else xp.full_like(v, math.nan),
        flags=columns["flags"],
        step=float(step),
        **quantities,
    )


def _column(values: Any) -> Array:
    """Return a column as an array; those of a table are of a class of their own."""
    return np.asarray(values) if isinstance(values, np.ndarray) else values
