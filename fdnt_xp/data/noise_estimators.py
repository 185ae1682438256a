"""The estimators of shear that tests of noise bias compare, by name.

Ours are called as a user calls them. What they are told beyond that, which stamps share
their noise and how it is turned, changes no mean.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from fdnt_xp.arrays import Array, array_namespace, device_of, to_numpy
from fdnt_xp.data.noise_control import KnownNoise, second_order
from fdnt_xp.data.other_codes import Found, NoisyStamps, fpfs_shear, regauss_shear
from fdnt_xp.errors import FdntValueError
from fdnt_xp.fourier.psf import Psf
from fdnt_xp.shapes.measure import measure_shapes
from fdnt_xp.shears.cuts import Cut
from fdnt_xp.shears.estimate import ShearEstimate
from fdnt_xp.shears.from_responses import shear_from_responses
from fdnt_xp.shears.from_shapes import shear_from_shapes
from fdnt_xp.shears.population import population_null
from fdnt_xp.shears.responses import STEP, measure_responses
from fdnt_xp.shears.sample import default_size

MAX_SHEAR: Final = 0.1
"""Of the nulls, unless a batch wants more: for their control that makes no difference."""
_FOR_RESPONSE: Final = 256
"""Galaxies whose mean response scales the control variate."""


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What is the same for all batches.

    Parameters
    ----------
    psf : Psf
        All of them, in the library that computes.
    psf_images, host_psf : array, shape (n_psf, ny, nx), and Psf
        The same, on the host.
    to_array : callable
        From NumPy to that library.
    cut : Cut or None
        In the counter-sheared frame.
    softening, bound, padding
        Of `population_null`.
    """

    psf: Psf
    psf_images: NDArray[np.float64]
    host_psf: Psf
    to_array: Callable[[NDArray[np.float64]], Array]
    cut: Cut | None
    softening: float
    bound: float
    padding: int


@dataclass(frozen=True, kw_only=True)
class Estimator:
    """An estimator of shear.

    Parameters
    ----------
    text : str
        What to say of it.
    measure : callable
    cuts : bool
        Whether it can cut in the counter-sheared frame.
    control : callable, optional
        Returns what the noise of these very stamps does to its shear and has no mean, (2,).
    """

    text: str
    measure: Callable[[NoisyStamps, Settings], Found]
    cuts: bool = False
    control: Callable[[NoisyStamps, Settings], NDArray[np.float64]] | None = None


def arrays_of(stamps: NoisyStamps, settings: Settings) -> tuple[Array, Psf, dict[str, Array]]:
    """Return stamps, PSFs and whole numbers in the library that computes."""
    pixels = settings.to_array(stamps.pixels)
    xp, device = array_namespace(pixels=pixels), device_of(pixels)
    psf = settings.psf
    if psf.n_psf > 1:
        psf = psf.with_index(xp.asarray(stamps.psf_of, device=device))
    numbers = {"identifiers": stamps.identifiers, "noise_symmetry": stamps.symmetry}
    return pixels, psf, {name: xp.asarray(n, device=device) for name, n in numbers.items()}


def noise_of(stamps: NoisyStamps, settings: Settings) -> dict[str, Any]:
    """Return what our estimators are told of the noise: its variance, or its power."""
    if stamps.power is None:
        return {"noise_variance": stamps.variance}
    return {"noise_power": settings.to_array(stamps.power)}


def _found(estimate: ShearEstimate) -> Found:
    g, error = (np.asarray(to_numpy(a), dtype=np.float64) for a in (estimate.g, estimate.g_err))
    sigma_g = float(np.sqrt(np.mean(error**2) * estimate.n_used))
    return Found(g=g, sigma_g=sigma_g, n_used=estimate.n_used)


def _null(stamps: NoisyStamps, settings: Settings, **options: Any) -> Found:
    pixels, psf, numbers = arrays_of(stamps, settings)
    return _found(
        population_null(
            pixels,
            psf,
            **noise_of(stamps, settings),
            seed=stamps.seed,
            cut=settings.cut,
            padding=settings.padding,
            **numbers,
            softening=settings.softening,
            **{"bound": settings.bound, **options},
        )
    )


def _null_plain(stamps: NoisyStamps, settings: Settings) -> Found:
    return _null(stamps, settings, isotropise=False)


def _null_eta(stamps: NoisyStamps, settings: Settings) -> Found:
    return _null(stamps, settings, statistic="eta", bound=0.0)


def _responses(stamps: NoisyStamps, settings: Settings) -> Found:
    pixels, psf, numbers = arrays_of(stamps, settings)
    responses = measure_responses(
        pixels,
        psf,
        **noise_of(stamps, settings),
        seed=stamps.seed,
        softening=settings.softening,
        bound=settings.bound,
        padding=settings.padding,
        **numbers,
    )
    return _found(shear_from_responses(responses, cut=settings.cut))


def _shapes(stamps: NoisyStamps, settings: Settings) -> Found:
    pixels, psf, _ = arrays_of(stamps, settings)
    shapes = measure_shapes(pixels, psf, **noise_of(stamps, settings), padding=settings.padding)
    return _found(shear_from_shapes(shapes))


def _hsm(stamps: NoisyStamps, settings: Settings) -> Found:
    return regauss_shear(stamps, settings.psf_images)


def _anacal(stamps: NoisyStamps, settings: Settings) -> Found:
    return fpfs_shear(stamps, settings.psf_images)


def _null_control(stamps: NoisyStamps, settings: Settings) -> NDArray[np.float64]:
    """Return the control variate in the frame of the true shear."""
    return _control(stamps, settings, stamps.shear, reach=MAX_SHEAR)


def _responses_control(stamps: NoisyStamps, settings: Settings) -> NDArray[np.float64]:
    """Return the control variate in the frame of the image."""
    return _control(stamps, settings, 0.0, reach=STEP)


def _control(
    stamps: NoisyStamps, settings: Settings, shear: float, *, reach: float
) -> NDArray[np.float64]:
    """Return `R⁻¹ <T - <T>>`: see `fdnt_xp.data.noise_control`.

    R is that of galaxies without noise. One that knew the noise would correlate with it, and
    the product would have a mean.
    """
    psf = settings.host_psf
    psf = psf if psf.n_psf == 1 else psf.with_index(stamps.psf_of)
    # Of the galaxies without noise: a size that knew the noise would correlate with it.
    size = default_size(
        stamps.clean,
        psf,
        noise_variance=stamps.variance,
        max_shear=reach,
        padding=settings.padding,
    )
    known = KnownNoise(
        clean=stamps.clean,
        noise=stamps.pixels - stamps.clean,
        psf=psf,
        variance=stamps.variance,
        identifiers=stamps.identifiers,
        symmetry=stamps.symmetry,
        seed=stamps.seed,
        size=size,
        softening=settings.softening,
        bound=settings.bound,
        max_shear=reach,
        padding=settings.padding,
    )
    some = np.arange(min(_FOR_RESPONSE, len(stamps.clean)))
    responses = measure_responses(
        stamps.clean[some],
        psf if psf.n_psf == 1 else psf.take(some),
        noise_variance=stamps.variance,
        isotropise=False,
        softening=settings.softening,
        bound=settings.bound,
        size=size,
        padding=settings.padding,
    )
    control = np.mean(second_order(known, (2.0 * math.atanh(shear), 0.0)), axis=0)
    return np.linalg.solve(np.nanmean(responses.response, axis=0), control)


ESTIMATORS: Final[dict[str, Estimator]] = {
    "null": Estimator(
        text="population null, noise made round",
        measure=_null,
        cuts=True,
        control=_null_control,
    ),
    "null-plain": Estimator(text="the same, noise as it is", measure=_null_plain, cuts=True),
    "null-eta": Estimator(
        text="population null, every shape solved anew", measure=_null_eta, cuts=True
    ),
    "responses": Estimator(
        text="responses of each galaxy",
        measure=_responses,
        cuts=True,
        control=_responses_control,
    ),
    "shapes": Estimator(text="shape of each galaxy, responsivity and EG", measure=_shapes),
    "hsm": Estimator(text="REGAUSS of GalSim, <e>/2(1 - e_rms²)", measure=_hsm),
    "anacal": Estimator(text="FPFS of AnaCal, linear responses", measure=_anacal),
}
"""What `noise_bias` compares."""


def check_estimators(names: Sequence[str]) -> None:
    """Raise `FdntValueError` unless all are known, each is there once, and there is one."""
    unknown = [name for name in names if name not in ESTIMATORS]
    if unknown or not names:
        raise FdntValueError(
            f"no estimator {', '.join(unknown) or 'given'}; known are {', '.join(ESTIMATORS)}"
        )
    if len(set(names)) < len(names):
        raise FdntValueError(f"an estimator is given twice: {', '.join(names)}")
