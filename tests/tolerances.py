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
}


def dtype_name(dtype: DType) -> str:
    """Return "float64" or "float32" for a dtype of any library."""
    return "float32" if "float32" in str(dtype) else "float64"


def tolerance(quantity: str, dtype: DType) -> dict[str, float]:
    """Return `rtol` and `atol` for a quantity of the table."""
    rtol, atol = TABLE[quantity][dtype_name(dtype)]
    return {"rtol": rtol, "atol": atol}
