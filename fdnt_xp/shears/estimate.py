"""What an estimate of shear returns, whatever the method."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any, TypeAlias

from fdnt_xp.arrays import Array, to_numpy
from fdnt_xp.shear import eta_from_reduced_shear

Number: TypeAlias = float | int | str
"""What a row of a report may hold."""


@dataclass(frozen=True, kw_only=True)
class ShearEstimate:
    """The shear of one population of galaxies.

    `g` is the reduced shear: a round galaxy gets `(a - b)/(a + b) = |g|` and its major axis
    along `(cos 2b, sin 2b) = g/|g|`, counter-clockwise from +x (columns), y along rows. The
    conformal shear of the same lens is `eta = 2 atanh|g|` in the same direction: `.eta`.

    All arrays share the library, dtype and device of the measurement.

    Parameters
    ----------
    g : array, shape (2,)
        Reduced shear (g1, g2); no unit.
    g_err : array, shape (2,)
        Standard error of each component from the scatter of the sample, which holds the
        shape noise and the pixel noise together.
    n_used : int
        Galaxies that enter the estimate.
    method : str
        "responsivity", "stack", ...: the function that made it says which.
    n_excluded : int
        Galaxies that were left out; the warning that comes with it says why. Those that
        have no shape to begin with are not counted.
    n_masked, n_filled : int
        Galaxies with missing pixels: left out, a part of `n_excluded`; and used, with the
        pixels filled from the others.
    g_err_noise : array, shape (2,), optional
        Standard error from the noise of the pixels alone; NaN where the noise is unknown.
        It is a part of `g_err`, not an addition to it.
    g_err_jackknife : array, shape (2,), optional
        Standard error by leaving out groups of galaxies in turn.
    g_err_noise_power : array, shape (2,), optional
        Systematic error from that of the noise power, which all galaxies share; not a part
        of `g_err`.
    responsivity : float, optional
        Weighted mean of `R1`: the mean of `w eta` is `2 g responsivity`, to first order.
    cubic : float, optional
        `sum R3 / sum R1`: the linear estimate is `g (1 - cubic |g|²)`, to third order.
    """

    g: Array
    g_err: Array
    n_used: int
    method: str
    n_excluded: int = 0
    n_masked: int = 0
    n_filled: int = 0
    g_err_noise: Array | None = None
    g_err_jackknife: Array | None = None
    g_err_noise_power: Array | None = None
    responsivity: float | None = None
    cubic: float | None = None

    @property
    def eta(self) -> Array:
        """Conformal shear `2 atanh|g|` along `g`, shape (2,)."""
        return eta_from_reduced_shear(self.g)

    def to_numpy(self) -> ShearEstimate:
        """Return the same estimate with NumPy arrays, copied to the host."""
        arrays: dict[str, Any] = {
            field.name: to_numpy(value)
            for field in fields(self)
            if field.name.startswith("g") and (value := getattr(self, field.name)) is not None
        }
        return replace(self, **arrays)

    def to_dict(self) -> dict[str, Number]:
        """Return the estimate as plain Python numbers, for reports and JSON.

        Vectors become `g1`, `g2`, `g1_err`, `g2_err`, `g1_err_noise`, ...; what the method
        does not give is left out.
        """
        host = self.to_numpy()
        row: dict[str, Number] = {}
        for field in fields(self):
            value = getattr(host, field.name)
            if value is None:
                continue
            if field.name.startswith("g"):
                for i in (0, 1):
                    row[f"g{i + 1}{field.name[1:]}"] = float(value[i])
            else:
                row[field.name] = value
        return row
