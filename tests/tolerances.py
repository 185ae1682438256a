"""How closely numbers must agree: one table, with the reason for each entry.

`tolerance("backends", dtype)` gives the keywords of `assert_close`.
"""

from __future__ import annotations

from fdnt_xp.arrays import DType

TABLE: dict[str, dict[str, tuple[float, float]]] = {
    # quantity: {dtype: (rtol, atol)}
    # 4 sqrt(eps), half the digits: the root of a function that is itself known to eps.
    "default": {"float64": (6e-8, 0.0), "float32": (1.4e-3, 0.0)},
    # A few dozen roundings in closed formulae; atol because components may cancel to 0.
    "algebra": {"float64": (2e-14, 2e-14), "float32": (1e-5, 1e-5)},
    # eta of one galaxy on two libraries: sums over k in another order, another last step.
    "backends": {"float64": (0.0, 1e-10), "float32": (0.0, 5e-4)},
    # eta of one galaxy alone and in a batch: matrix products of other sizes block otherwise.
    "batch": {"float64": (0.0, 1e-12), "float32": (0.0, 5e-4)},
    # A sum over k or pixels, over the sum of its absolute terms: rounding of each term, and
    # of phases k.x of some 30 radians.
    "sums": {"float64": (0.0, 3e-14), "float32": (0.0, 5e-6)},
    # A Gaussian's transform, over T as small as 0.03: the image is cut where it is below
    # 1e-9 of its sum, and float32 divides the rounding of sums by T.
    "deconvolved": {"float64": (0.0, 1e-7), "float32": (0.0, 2e-5)},
    # 𝒯, of order one: a cubic over cells of 1/96 errs by 1e-6 where its slope is one-sided.
    "weight": {"float64": (0.0, 2e-6), "float32": (0.0, 1e-5)},
    # d𝒯/dk², of order one in units of its value at 0: a third-order slope, over k/kmax >= 0.05.
    "weight slope": {"float64": (0.0, 5e-5), "float32": (0.0, 1e-3)},
    # sigma² from <k²>: integrals of the table of 𝒯, and a table of 128 cells.
    "matched width": {"float64": (3e-6, 0.0), "float32": (1e-4, 0.0)},
    # Null tests over t0, and widths: sums over k of data divided by T >= 0.03.
    "tests": {"float64": (0.0, 1e-11), "float32": (0.0, 3e-4)},
    # Their derivatives against central differences of step 1e-5, good to 1e-9 of terms of
    # order ten; modes that cross a node of the table of 𝒯 within the step add as much.
    "test slopes": {"float64": (0.0, 3e-7), "float32": (0.0, 5e-3)},
    # Null tests over t0 at the truth: the sum over cells of 2 pi/30 is not quite isotropic.
    "null": {"float64": (0.0, 1e-5), "float32": (0.0, 1e-4)},
    # Covariances against differences of step 1e-4 of the peak, in units of the largest.
    "noise": {"float64": (0.0, 1e-6), "float32": (0.0, 2e-3)},
    # V_iso, relative: its logarithm, of order ten, passes through two tables.
    "noise made round": {"float64": (1e-10, 0.0), "float32": (2e-4, 0.0)},
    # Responses are differences over 0.04; S/N and flux are of order 20 and of order one.
    "responses": {"float64": (1e-9, 1e-10), "float32": (2e-3, 2e-3)},
    # Gauss-Laguerre functions of order 20 where they are of order one: 20 steps of rounding.
    "laguerre": {"float64": (0.0, 2e-14), "float32": (0.0, 1e-5)},
    # Their sums and integrals on a grid, which ends where the functions are below 1e-9.
    "laguerre sums": {"float64": (0.0, 1e-9), "float32": (0.0, 3e-5)},
    # Coefficients of a fit over the largest: rounding times the inflation, at most 20.
    "laguerre fit": {"float64": (0.0, 1e-11), "float32": (0.0, 1e-4)},
    # A matched basis: its tests are solved to sqrt(eps).
    "matched basis": {"float64": (0.0, 1e-7), "float32": (0.0, 2e-3)},
    # A noise-free Gaussian galaxy on 48 pixels: the stamp cuts it where it is below 1e-8.
    # float32: the solver stops at 1e-5 in the tests, whose response to eta is about a third.
    "shapes": {"float64": (0.0, 2e-6), "float32": (0.0, 2e-4)},
    # The same from a fit of one function among many, found to the tolerances above.
    "gl shapes": {"float64": (0.0, 5e-6), "float32": (0.0, 1e-3)},
    # The same on stamps of 37 pixels and more.
    "small stamps": {"float64": (0.0, 2e-4), "float32": (0.0, 4e-4)},
    # The shear of eight such galaxies.
    "nulls": {"float64": (0.0, 1e-7), "float32": (0.0, 5e-5)},
    # With noise the search leaves a ten-thousandth of the error, 0.03 here, but the same on all.
    "noisy nulls": {"float64": (0.0, 1e-8), "float32": (0.0, 5e-5)},
    # Fits that stop at an angle of 1e-10 (1e-5) between data and slopes, which are a tenth
    # of the data; of galaxies that the stamp cuts where they are below 1e-9.
    "fitted shapes": {"float64": (0.0, 2e-8), "float32": (0.0, 3e-4)},
    # A sum of two components: size and amplitudes go together. Relative.
    "fitted sizes": {"float64": (2e-5, 0.0), "float32": (5e-3, 0.0)},
    # Laws with wings, 16 times as wide as the stamp against 8 times.
    "fitted laws": {"float64": (0.0, 2e-5), "float32": (0.0, 1e-3)},
    # A Gaussian galaxy by functions as wide as its image: what the order cuts off. It is
    # computed in float64 in any case.
    "nb07 order 8": {"float64": (0.0, 5e-4), "float32": (0.0, 6e-4)},
    "nb07 order 12": {"float64": (0.0, 2e-5), "float32": (0.0, 1e-4)},
    # A sum of the functions of the fit, cut by the stamp where they are below 1e-6.
    "nb07 exact": {"float64": (0.0, 1e-6), "float32": (0.0, 1e-5)},
    # Its normal equations are inverted at a condition of 1e8.
    "nb07 batch": {"float64": (0.0, 1e-7), "float32": (0.0, 1e-6)},
    # Pixels.
    "centroids": {"float64": (0.0, 1e-3), "float32": (0.0, 1e-3)},
    "sizes": {"float64": (2e-3, 0.0), "float32": (2e-3, 0.0)},
    "gradients": {"float64": (0.0, 1e-3), "float32": (0.0, 1e-3)},
}


def dtype_name(dtype: DType) -> str:
    """Return "float64" or "float32" for a dtype of any library."""
    return "float32" if "float32" in str(dtype) else "float64"


def tolerance(quantity: str, dtype: DType) -> dict[str, float]:
    """Return `rtol` and `atol` for a quantity of the table."""
    rtol, atol = TABLE[quantity][dtype_name(dtype)]
    return {"rtol": rtol, "atol": atol}
