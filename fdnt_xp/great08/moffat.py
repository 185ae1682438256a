"""Analytic PSFs on disk: a Moffat profile as a few lines of text.

::

    # lengths in pixels of the galaxies; no pixel response
    beta  3.0
    fwhm  2.85      of the round profile
    trunc 5.7       radius where it ends; without this line it does not
    g1    -0.019    reduced shear shape, (a-b)/(a+b); or e1, e2, (a^2-b^2)/(a^2+b^2)
    g2    -0.007

The profile is round and truncated, then sheared; the pixel response is put on when it is
drawn. What follows a number is a remark.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from fdnt_xp.data.files import new_file
from fdnt_xp.data.profiles import accurate, load_galsim
from fdnt_xp.errors import CatalogError, RangeError

MOFFAT_SUFFIX: Final = ".moffat"
MOFFAT_OVERSAMPLING: Final = 4
"""How much finer than the galaxies an analytic PSF is drawn."""
_LEAST_BETA: Final = 1.1
"""A Moffat of 1 has no finite flux."""
_KEYS: Final = ("beta", "fwhm", "trunc", "g1", "g2", "e1", "e2")


@dataclass(frozen=True, kw_only=True)
class MoffatPsf:
    """A Moffat profile, without the pixel.

    Parameters
    ----------
    beta : float
        Its exponent.
    fwhm : float
        Of the round profile, pixels.
    g : tuple of float
        Its shape, (a-b)/(a+b).
    trunc : float
        Radius where the round profile ends, pixels; 0 if it does not.
    """

    beta: float
    fwhm: float
    g: tuple[float, float] = (0.0, 0.0)
    trunc: float = 0.0

    def __post_init__(self) -> None:
        """Refuse what is no profile."""
        if not _LEAST_BETA <= self.beta < math.inf:
            raise RangeError("beta", self.beta, _LEAST_BETA, None)
        if not 0.0 < self.fwhm < math.inf:
            raise RangeError("fwhm", self.fwhm, 0.0, None)
        if not math.hypot(*self.g) < 1.0:
            raise RangeError("|g|", math.hypot(*self.g), 0.0, 1.0)
        # GalSim wants the half-maximum to be on the profile.
        if not (self.trunc == 0.0 or 0.5 * self.fwhm < self.trunc < math.inf):
            raise RangeError("trunc", self.trunc, 0.5 * self.fwhm, None)

    def profile(self) -> Any:
        """Return the GalSim object, without the pixel."""
        galsim = load_galsim()
        moffat = galsim.Moffat(
            beta=self.beta, fwhm=self.fwhm, trunc=self.trunc, gsparams=accurate(galsim)
        )
        return moffat.shear(g1=self.g[0], g2=self.g[1])

    def draw(self, size: int, oversampling: int = 1) -> NDArray[np.float64]:
        """Draw a star at the middle of its image, with the pixel of the galaxies.

        Parameters
        ----------
        size : int
            Pixels of the galaxies on a side.
        oversampling : int
            How much finer the image is.

        Returns
        -------
        array, shape (size oversampling, size oversampling), float64
            Of unit sum.
        """
        galsim = load_galsim()
        n = size * oversampling
        seen = galsim.Convolve([self.profile(), galsim.Pixel(1.0)])
        stamp = seen.drawImage(
            nx=n, ny=n, scale=1.0 / oversampling, method="no_pixel", dtype=np.float64
        )
        star: NDArray[np.float64] = np.array(stamp.array)
        star /= star.sum()
        return star


def read_moffat(path: str | os.PathLike[str]) -> MoffatPsf:
    """Read a PSF that `write_moffat` wrote, or anyone else.

    Raises
    ------
    CatalogError
        If there is no such file, a line of it is not understood, or it is no profile.
    """
    values: dict[str, float] = {}
    try:
        lines = Path(path).read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is not text"
        raise CatalogError(f"cannot read the PSF {path}: {reason}") from error
    for place, line in enumerate(lines, start=1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        value = _number(words[1]) if len(words) > 1 else None
        if words[0] not in _KEYS or words[0] in values or value is None:
            raise CatalogError(
                f"line {place} of {path} must be one of {', '.join(_KEYS)}, once, and its "
                f"value, not {line.strip()!r}"
            )
        values[words[0]] = value
    try:
        return _psf_of(values)
    except (KeyError, ValueError) as error:
        reason = f"it has no {error.args[0]}" if isinstance(error, KeyError) else str(error)
        raise CatalogError(f"{path} is no Moffat profile: {reason}") from error


def write_moffat(psf: MoffatPsf, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
    """Write a PSF as text, whole or not at all; the suffix must be `.moffat`."""
    if Path(path).suffix.lower() != MOFFAT_SUFFIX:
        raise CatalogError(f"the suffix of {path} must be {MOFFAT_SUFFIX}")
    values = {"beta": psf.beta, "fwhm": psf.fwhm, "trunc": psf.trunc}
    values |= {"g1": psf.g[0], "g2": psf.g[1]}
    lines = ["# Moffat profile; pixels; g = (a-b)/(a+b); without the pixel response"]
    lines += [f"{name} {value!r}" for name, value in values.items()]
    with new_file(path, overwrite=overwrite) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None


def _psf_of(values: Mapping[str, float]) -> MoffatPsf:
    """Return the profile; KeyError or ValueError if there is none."""
    has_g, has_e = ({f"{kind}1", f"{kind}2"} & values.keys() for kind in "ge")
    if has_g and has_e:
        raise ValueError("it has both g and e")
    g = (values["g1"], values["g2"]) if has_g else (0.0, 0.0)
    if has_e:
        e = math.hypot(values["e1"], values["e2"])
        if not e < 1.0:
            raise ValueError(f"|e| = {e:g} is not below 1")
        factor = 1.0 / (1.0 + math.sqrt(1.0 - e**2))
        g = (values["e1"] * factor, values["e2"] * factor)
    return MoffatPsf(beta=values["beta"], fwhm=values["fwhm"], g=g, trunc=values.get("trunc", 0.0))
