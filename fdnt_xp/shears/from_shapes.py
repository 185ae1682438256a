"""The shear of a population from the shapes of its galaxies, by their responsivity.

B10, appendix: the linear estimate `gamma^ = sum w eta / (2 sum R1)`, whose expectation is
`g (1 - |g|² sum R3/sum R1)` to third order in the shear g; that is solved for g. R1 and R3
are those at the observed shapes, for which this relation is written. What the orientations
that a finite sample happens to have do to its response is taken off (docs, "Responsivity").
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from typing import Final

from fdnt_xp.arrays import Array, array_namespace, as_floating, count_true, device_of, require_dtype
from fdnt_xp.errors import FdntTypeError, FdntValueError, FdntWarning, ShapeMismatchError
from fdnt_xp.shapes.results import ShapeResult
from fdnt_xp.shear import add_shears, eta_from_reduced_shear
from fdnt_xp.shears.estimate import ShearEstimate
from fdnt_xp.shears.ratio import over_response
from fdnt_xp.shears.responsivity import (
    along_and_across,
    first_order,
    has_response,
    third_order,
)
from fdnt_xp.shears.weights import (
    Function,
    ShapeWeight,
    WeightExpansion,
    as_shape_weight,
    galaxy_weights,
)

_PASSES: Final = 2
"""Of the orientations before the shear: the shear and they depend on each other, weakly."""
_NEWTON_STEPS: Final = 60
"""Quadratic in all cases but at the very end of the cubic's range, where a bit a step is left."""


def shear_from_shapes(
    shapes: ShapeResult,
    weight: ShapeWeight | Function | str = "uniform",
    *,
    galaxy_weight: Array | None = None,
    use_eg: bool = True,
    cubic: bool = True,
    orientations: bool = True,
) -> ShearEstimate:
    """Estimate the reduced shear of a population from the shapes of its galaxies.

    The galaxies must be isotropic but for the shear. Exact to third order in the shear for
    galaxies whose shapes transform as those of ellipses; the response of all others is that
    of their ellipticity gradient EG, exact to first order.

    Parameters
    ----------
    shapes : ShapeResult
        From `measure_shapes`. Galaxies that are not `measured` are left out.
    weight : ShapeWeight, callable or str
        What a shape counts, `w(|eta|)`: a `ShapeWeight`, a function of `|eta|`, or "uniform",
        "gaussian" (exp(-eta²)), "lorentzian" (1/(1 + eta²)).
    galaxy_weight : array, shape (n_gal,), optional
        Multiplies `w`. Finite and not negative where `measured`, and not a function of the
        observed shape: its response to shear is not known.
    use_eg : bool
        Whether to correct for `shapes.eg`.
    cubic : bool
        Whether to correct for the third order in the shear.
    orientations : bool
        Whether to take off the noise of the response by the orientations at hand, which
        pairs of galaxies at 90 degrees do not take away. It has no mean.

    Returns
    -------
    ShearEstimate
        `method` is "responsivity", `responsivity`, `cubic` and `g_err_noise` are given, the
        latter from `eta_cov`. `n_excluded` counts galaxies whose EG is not below 1.

    Warns
    -----
    FdntWarning
        If galaxies were excluded for their EG.

    Raises
    ------
    FdntValueError
        If fewer than two galaxies are usable, a weight is negative or not finite, the
        responsivities do not sum to a positive number, or no shear gives the mean shape.
    FdntTypeError, NamespaceError, ShapeMismatchError
        If `shapes` is no ShapeResult, or `galaxy_weight` not of its library or length.

    Notes
    -----
    `g_err` is the standard deviation of the influence of a galaxy on the estimate over
    sqrt(n): shape noise and pixel noise together. In `g_err_noise` the noise of R1 is left
    out: it enters multiplied by the shear.

    References
    ----------
    .. [1] Bernstein 2010, MNRAS 406, 2793, appendix.
    """
    if not isinstance(shapes, ShapeResult):
        raise FdntTypeError(
            f"shapes must be a ShapeResult, not {type(shapes).__name__}; see measure_shapes"
        )
    measured = shapes.measured
    if shapes.n_gal == 0 or not bool(array_namespace(m=measured).any(measured)):
        raise FdntValueError(
            f"shapes holds no measured galaxy of {shapes.n_gal}; their flags say why"
        )
    sample = _sample(
        shapes.eta, measured, shapes.eg if use_eg else None, shapes.eta_cov, galaxy_weight
    )
    return _estimate(sample, as_shape_weight(weight), cubic=cubic, orientations=orientations)


def shear_from_eta(
    eta: Array,
    weight: ShapeWeight | Function | str = "uniform",
    *,
    eg: Array | None = None,
    eta_cov: Array | None = None,
    galaxy_weight: Array | None = None,
    cubic: bool = True,
    orientations: bool = True,
) -> ShearEstimate:
    """Estimate the reduced shear from bare shapes, as `shear_from_shapes` does.

    Parameters
    ----------
    eta : array, shape (n_gal, 2), n_gal >= 2
        Finite conformal shears.
    weight, galaxy_weight, cubic, orientations
        As for `shear_from_shapes`.
    eg : array, shape (n_gal,), optional
        Ellipticity gradients.
    eta_cov : array, shape (n_gal, 2, 2), optional
        Their covariances by the noise of the pixels, for `g_err_noise`.

    Raises
    ------
    ShapeMismatchError, FdntValueError
        If `eta` or `eta_cov` has another shape, `eta` is not finite; and as
        `shear_from_shapes`.

    Examples
    --------
    >>> import numpy as np
    >>> from fdnt_xp.shear import add_shears, eta_from_reduced_shear
    >>> from fdnt_xp.shears.from_shapes import shear_from_eta
    >>> angle = np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False)
    >>> ring = 0.4 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    >>> lens = eta_from_reduced_shear(np.array([[0.03, -0.01]]))
    >>> shear_from_eta(add_shears(lens, ring)).g.round(6)
    array([ 0.03, -0.01])
    """
    xp = array_namespace(eta=eta)
    eta = as_floating(xp, eta, "eta")
    if eta.ndim != 2 or eta.shape[1] != 2:
        raise ShapeMismatchError(f"eta must have the shape (n_gal, 2), not {tuple(eta.shape)}")
    finite = xp.isfinite(eta[:, 0]) & xp.isfinite(eta[:, 1])
    if not bool(xp.all(finite)):
        raise FdntValueError("eta must be finite; leave out the galaxies without a shape")
    if eta_cov is not None:
        array_namespace(eta=eta, eta_cov=eta_cov)
        if eta_cov.shape != (eta.shape[0], 2, 2):
            raise ShapeMismatchError(
                f"eta_cov must have the shape ({eta.shape[0]}, 2, 2), not {tuple(eta_cov.shape)}"
            )
    return _estimate(
        _sample(eta, finite, eg, eta_cov, galaxy_weight),
        as_shape_weight(weight),
        cubic=cubic,
        orientations=orientations,
    )


@dataclass(frozen=True, kw_only=True)
class _Sample:
    """The usable galaxies, in float64; the others are round and have no weight.

    `galaxy_weight` is 1 unless given; `dtype` is that of the shapes, and of the answer.
    """

    eta: Array
    eg: Array | None
    eta_cov: Array | None
    galaxy_weight: Array
    n_used: int
    n_excluded: int
    dtype: object


def _sample(
    eta: Array, usable: Array, eg: Array | None, eta_cov: Array | None, galaxy_weight: Array | None
) -> _Sample:
    """Choose the usable galaxies; warn of those whose EG excludes them."""
    xp = array_namespace(eta=eta, eg=eg, galaxy_weight=galaxy_weight)
    n_excluded = 0
    if eg is not None:
        require_dtype(eta.dtype, eg=eg)
        if eg.shape != usable.shape:
            raise ShapeMismatchError(
                f"eg must have the shape {tuple(usable.shape)}, not {tuple(eg.shape)}"
            )
        unresponsive = usable & ~has_response(eg)
        n_excluded = count_true(unresponsive)
        usable = usable & ~unresponsive
    weights = galaxy_weights(usable, galaxy_weight)
    n_used = count_true(weights > 0)
    if n_excluded:
        warnings.warn(
            f"{n_excluded} of {n_excluded + count_true(usable)} galaxies left out: their "
            "ellipticity gradient is not below 1",
            FdntWarning,
            stacklevel=3,
        )
    if n_used < 2:
        raise FdntValueError(
            f"{n_used} usable galaxies ({n_excluded} left out for their ellipticity gradient); "
            "a mean with an error needs two"
        )

    def chosen(values: Array | None) -> Array | None:
        if values is None:
            return None
        mask = xp.reshape(usable, (-1,) + (1,) * (values.ndim - 1))
        return xp.astype(xp.where(mask, values, xp.zeros_like(values)), xp.float64)

    return _Sample(
        eta=chosen(eta),
        eg=chosen(eg),
        eta_cov=chosen(eta_cov),
        galaxy_weight=weights,
        n_used=n_used,
        n_excluded=n_excluded,
        dtype=eta.dtype,
    )


def _estimate(
    sample: _Sample, weight: ShapeWeight, *, cubic: bool, orientations: bool
) -> ShearEstimate:
    eta = sample.eta
    xp = array_namespace(eta=eta)
    abs_eta = xp.sqrt(eta[:, 0] ** 2 + eta[:, 1] ** 2)
    expansion = weight.expand(abs_eta)
    r1 = sample.galaxy_weight * first_order(abs_eta, expansion, sample.eg)
    r3 = sample.galaxy_weight * third_order(abs_eta, expansion)
    response = float(xp.sum(r1))
    if not (math.isfinite(response) and response > 0):
        raise FdntValueError(
            f"the responsivities sum to {response:g}: with the weight {weight.name!r} these "
            "shapes do not follow the shear"
        )
    counted = (sample.galaxy_weight * expansion.value)[:, None] * eta
    linear = xp.sum(counted, axis=0) / (2.0 * response)
    influence = (counted - 2.0 * r1[:, None] * linear[None, :]) / (2.0 * response)
    slope = float(xp.sum(r3)) / response if cubic else 0.0
    stretch, back = _inversion(linear, slope)
    influence = xp.matmul(influence, back)
    even = stretch * linear
    g = even
    for _ in range(_PASSES if orientations else 0):
        uneven = _uneven_response(sample, weight, g) / response
        unit = xp.eye(2, dtype=eta.dtype, device=device_of(eta))
        g = over_response((unit + xp.sum(uneven, axis=0))[None, :, :], even[None, :])[0, :]
    if orientations:
        influence = influence - xp.matmul(uneven, g)
    n = sample.n_used
    noise = None
    if sample.eta_cov is not None:
        by_linear = _by_eta(sample, expansion) / (2.0 * response)
        noise = xp.astype(_noise(xp.matmul(back, by_linear), sample.eta_cov), sample.dtype)
    return ShearEstimate(
        g=xp.astype(g, sample.dtype),
        g_err=xp.astype(xp.sqrt(xp.sum(influence**2, axis=0) * (n / (n - 1.0))), sample.dtype),
        n_used=n,
        method="responsivity",
        n_excluded=sample.n_excluded,
        g_err_noise=noise,
        responsivity=response / float(xp.sum(sample.galaxy_weight)),
        cubic=slope if cubic else None,
    )


def _uneven_response(sample: _Sample, weight: ShapeWeight, g: Array) -> Array:
    """Return what orientation does to the response of each galaxy, shape (n_gal, 2, 2).

    A shape responds to shear along it otherwise than to shear across it: its response is
    `R1 + R4 (cos 4b, sin 4b; sin 4b, -cos 4b)`, R4 half the difference, b its position
    angle. Taken at the shapes before the shear, the mean of the second part is zero.
    """
    xp = array_namespace(eta=sample.eta)
    lens = xp.broadcast_to(-eta_from_reduced_shear(g)[None, :], sample.eta.shape)
    eta = add_shears(lens, sample.eta)
    square = xp.sum(eta**2, axis=-1)
    abs_eta = xp.sqrt(square)
    along, across = along_and_across(abs_eta, weight.expand(abs_eta), sample.eg)
    safe = xp.where(square > 0, square, xp.ones_like(square))
    fourfold = sample.galaxy_weight * 0.5 * (along - across) / safe
    cos = fourfold * (eta[:, 0] ** 2 - eta[:, 1] ** 2)
    sin = fourfold * 2.0 * eta[:, 0] * eta[:, 1]
    return xp.stack([xp.stack([cos, sin], axis=-1), xp.stack([sin, -cos], axis=-1)], axis=-2)


def _by_eta(sample: _Sample, w: WeightExpansion) -> Array:
    """Return the derivative of each galaxy's weighted shape by its shape, (n_gal, 2, 2).

    `d(w eta_i)/deta_j = w delta_ij + (w'/|eta|) eta_i eta_j`.
    """
    xp = array_namespace(eta=sample.eta)
    eta = sample.eta
    unit = xp.eye(2, dtype=eta.dtype, device=device_of(eta))
    outer = w.ratio[:, None, None] * eta[:, :, None] * eta[:, None, :]
    return sample.galaxy_weight[:, None, None] * (w.value[:, None, None] * unit + outer)


def _noise(by_eta: Array, eta_cov: Array) -> Array:
    """Return the error of a sum over galaxies from the covariance of each shape, (2,)."""
    xp = array_namespace(by_eta=by_eta)
    return xp.sqrt(xp.sum(xp.matmul(by_eta, eta_cov) * by_eta, axis=(0, 2)))


def _inversion(linear: Array, slope: float) -> tuple[float, Array]:
    """Solve `linear = g (1 - slope |g|²)` for the vector g.

    Returns
    -------
    stretch : float
        `|g|/|linear|`, 1 at zero.
    jacobian : array, shape (2, 2)
        `dg/dlinear`, symmetric: `1/(1 - 3 slope |g|²)` along g, `1/(1 - slope |g|²)` across.
    """
    xp = array_namespace(linear=linear)
    wanted = float(xp.sqrt(xp.sum(linear**2)))
    length = _root_of_cubic(wanted, slope)
    across = 1.0 / (1.0 - slope * length**2)
    along = 1.0 / (1.0 - 3.0 * slope * length**2)
    direction = linear / (wanted if wanted > 0 else 1.0)
    unit = xp.eye(2, dtype=linear.dtype, device=device_of(linear))
    jacobian = across * unit + (along - across) * direction[:, None] * direction[None, :]
    return across, jacobian


def _root_of_cubic(wanted: float, slope: float) -> float:
    """Return the root of `x (1 - slope x²) = wanted >= 0` that goes to `wanted` as slope to 0."""
    if slope > 0 and wanted >= (limit := 2.0 / (3.0 * math.sqrt(3.0 * slope))):
        raise FdntValueError(
            f"no shear gives this mean shape: its linear estimate is {wanted:.4g}, and the third "
            f"order reaches no further than {limit:.4g}; cubic=False gives the linear estimate"
        )
    # The function is concave for slope > 0, convex for slope < 0: from `wanted` Newton's
    # steps go to the root without passing it.
    x = wanted
    for _ in range(_NEWTON_STEPS):
        x += (wanted - x * (1.0 - slope * x * x)) / (1.0 - 3.0 * slope * x * x)
    if x >= 1.0:
        raise FdntValueError(f"the shear would be |g| = {x:.4g}; it must be below 1")
    return x
