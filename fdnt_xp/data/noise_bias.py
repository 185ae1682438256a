"""Noise bias: what shear comes back from faint galaxies, to a part in a thousand and better.

Galaxies are drawn once, with shear and with the opposite shear, each also turned by 90
degrees before it; noise is put on again and again. The shears that come back, less those
put on, are noise bias alone: shape noise cancels between the turned galaxies, and much of
the noise between stamps that share it (`draw_versions`, `noise_bias`).
"""

from __future__ import annotations

import math
import sys
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from fdnt_xp.arrays import Array, to_numpy
from fdnt_xp.data.coloured_noise import coloured_stamps
from fdnt_xp.data.noise_estimators import ESTIMATORS, Settings, arrays_of, check_estimators
from fdnt_xp.data.other_codes import Found, NoisyStamps, turn_quarter
from fdnt_xp.data.versions import Population, Versions
from fdnt_xp.errors import FdntValueError, FdntWarning, RangeError
from fdnt_xp.fourier.psf import Psf
from fdnt_xp.shears.cuts import Cut
from fdnt_xp.shears.responses import measure_responses

SYMMETRIES: Final = (0, 1, 4, 5)
"""The versions of a galaxy that share noise, as `noise_symmetry` counts: as it is, turned
with its noise, with the noise of opposite sign, and both."""
_UNTURNED: Final = (0, 0, 4, 4)
"""The same where the noise has directions of its own: it is not turned along."""
VERSIONS: Final = 2 * len(SYMMETRIES)
"""Noisy stamps of a galaxy in one realisation of the noise: those, for either shear."""


@dataclass(frozen=True, kw_only=True)
class NoiseBias:
    """The bias of one estimator at one S/N.

    Parameters
    ----------
    estimator : str
        Name in `ESTIMATORS`.
    population : Population
        What was drawn.
    snr : float
        `sqrt(<sum of I²>)/sigma`, the mean over the population.
    m, m_err : float
        `(g^(+g) - g^(-g))/2g - 1`, along the shear. NaN where the estimator finds no shear.
    c, c_err : tuple of float
        `(g^(+g) + g^(-g))/2`, both components.
    sigma_g : float
        Error of one component of the shear from one galaxy with its own noise, shape noise
        included.
    unused : float
        Fraction of the stamps that did not count: failures, and what a cut removes.
    n_stamps, n_batches : int
        Noisy stamps that were measured; groups of them with a shear of their own.
    seconds_per_stamp : float
        Wall time.
    seed : int
        Of the noise.
    cut : str, optional
        Range of a quantity, in the counter-sheared frame.
    observed_cut : float, optional
        Fraction that was removed by their S/N as seen.
    softening, bound, padding
        Of `population_null`.
    """

    estimator: str
    population: Population
    snr: float
    m: float
    m_err: float
    c: tuple[float, float]
    c_err: tuple[float, float]
    sigma_g: float
    unused: float
    n_stamps: int
    n_batches: int
    seconds_per_stamp: float
    seed: int
    cut: str | None = None
    observed_cut: float | None = None
    softening: float = 1.0
    bound: float = 0.0
    padding: int = 1
    control: bool = False

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain Python, ready for `json.dumps`; None for NaN."""

        def plain(value: Any) -> Any:
            if isinstance(value, dict):
                return {name: plain(one) for name, one in value.items()}
            if isinstance(value, tuple):
                return [plain(one) for one in value]
            return None if isinstance(value, float) and math.isnan(value) else value

        return {name: plain(value) for name, value in asdict(self).items()}

    @classmethod
    def from_dict(cls, plain: dict[str, Any]) -> NoiseBias:
        """Return the result that `to_dict` wrote."""

        def number(value: float | None) -> float:
            return math.nan if value is None else value

        drawn = dict(plain["population"])
        if isinstance(drawn["radius"], list):
            drawn["radius"] = tuple(drawn["radius"])
        measured = {name: number(plain[name]) for name in ("m", "m_err", "sigma_g")}
        pairs = {name: (number(plain[name][0]), number(plain[name][1])) for name in ("c", "c_err")}
        return cls(**{**plain, **measured, **pairs, "population": Population(**drawn)})


def noise_bias(
    versions: Versions,
    snr: float,
    estimators: Sequence[str] = ("null",),
    *,
    n_stamps: int = 100_000,
    batch: int = 256,
    cut: Cut | None = None,
    observed_cut: float | None = None,
    softening: float = 1.0,
    bound: float = 0.0,
    padding: int = 1,
    control: bool = True,
    power: NDArray[np.float64] | None = None,
    seed: int = 0,
    to_array: Callable[[NDArray[np.float64]], Array] = np.asarray,
    quiet: bool = True,
) -> list[NoiseBias]:
    """Put noise on drawn galaxies, again and again, and see what shear comes back.

    Parameters
    ----------
    versions : Versions
        From `draw_versions`.
    snr : float
        `sqrt(<sum of I²>)/sigma`.
    estimators : sequence of str
        Which of `ESTIMATORS` to compare; all see the same noise.
    n_stamps : int
        Noisy stamps to measure with each, rounded up to whole batches, of which there are
        two at least.
    batch : int
        Galaxies of a batch, each 8 stamps. The bias of a ratio, of a part `1/batch`, is in m.
    cut : Cut, optional
        In the counter-sheared frame; for the nulls and the responses.
    observed_cut : float, optional
        Remove this fraction of the stamps, those of the least S/N on the image as seen. It
        biases, as every such cut does.
    softening, bound, padding
        Of `population_null`.
    control : bool
        Whether to take off what is known of the noise and has no mean, for estimators that
        have such a control, without cuts. It changes the errors alone.
    power : array, shape (ny, nx), optional
        Power spectrum of the noise, up to a factor, where it is correlated between pixels; as
        `population_null` takes it. The noise is cut out of larger fields, as that of a survey
        is. Errors of m are then larger, without a control.
    seed : int
        Of the noise.
    to_array : callable
        Takes a NumPy array to the library, device and precision that shall compute.
    quiet : bool
        No progress bar; there is none either where stderr is not a terminal.

    Returns
    -------
    list of NoiseBias
        In the order of `estimators`.

    Raises
    ------
    FdntValueError, RangeError
        If a name is unknown or given twice, a number out of range, or a cut is not known to
        an estimator.
    MissingExtraError
        If an estimator needs what is not installed.

    Notes
    -----
    The same noise is on the stamps with shear +g and -g; on those of the turned galaxy,
    turned with it; on the others with the opposite sign. So is the noise that the estimators
    of this library add. Errors are those of the mean over batches (leaving out one in turn
    gives the same). They do not tell what another draw of galaxies would give, unless there
    are more galaxies than in a batch.
    """
    _check(snr, estimators, n_stamps, batch, cut, observed_cut)
    sigma = math.sqrt(np.mean(np.sum(versions.stamps**2, axis=(-2, -1)))) / snr
    stars = _one_or_all(versions.psf_images)
    settings = Settings(
        psf=Psf.from_image(to_array(stars)),
        psf_images=versions.psf_images,
        host_psf=Psf.from_image(stars),
        to_array=to_array,
        cut=cut,
        softening=softening,
        bound=bound,
        padding=padding,
    )
    n_batches = max(2, math.ceil(n_stamps / (VERSIONS * batch)))
    if power is not None:
        power = sigma**2 * power / np.mean(power)
    control = control and cut is None and observed_cut is None and power is None
    tallies = {
        name: _Tally(name=name, control=ESTIMATORS[name].control if control else None, pairs=[])
        for name in estimators
    }
    hidden = quiet or not sys.stderr.isatty()
    with tqdm(
        total=n_batches * VERSIONS * batch, unit=" stamps", leave=False, disable=hidden
    ) as bar:
        for number in range(n_batches):
            seeds = [seed, versions.population.seed, number, round(1000 * snr)]
            pair = noisy_pair(versions, number, batch, sigma, seeds, power)
            if observed_cut is not None:
                pair = _cut_as_seen(pair, settings, observed_cut)
            for tally in tallies.values():
                tally.add(pair, settings)
            bar.update(VERSIONS * batch)
    common = {
        "population": versions.population,
        "snr": float(snr),
        "n_batches": n_batches,
        "n_stamps": n_batches * VERSIONS * batch,
        "seed": seed,
        "cut": None if cut is None else f"{cut.quantity} {cut.low} to {cut.high}",
        "observed_cut": observed_cut,
        "softening": softening,
        "bound": bound,
        "padding": padding,
    }
    return [tally.result(common) for tally in tallies.values()]


def _one_or_all(images: NDArray[np.float64]) -> NDArray[np.float64]:
    return images[0] if len(images) == 1 else images


def noisy_pair(
    versions: Versions,
    number: int,
    batch: int,
    sigma: float,
    seed: list[int],
    power: NDArray[np.float64] | None = None,
) -> tuple[NoisyStamps, NoisyStamps]:
    """Return the stamps of a batch with shear +g, and those with -g.

    Parameters
    ----------
    versions : Versions
    number, batch : int
        Which batch; galaxies in it.
    sigma : float
        Of the noise of a pixel.
    seed : list of int
        Of the noise.
    power : array, shape (ny, nx), optional
        Its power spectrum, where it is not white.
    """
    rng = np.random.default_rng(seed)
    names = number * batch + np.arange(batch)
    rows = names % versions.population.n_gal
    size = versions.population.stamp_size
    if power is None:
        noise = sigma * rng.standard_normal((batch, size, size))
    else:
        noise = coloured_stamps(rng, batch, power)
    turned = turn_quarter(noise) if power is None else noise
    symmetries = SYMMETRIES if power is None else _UNTURNED
    added = int(rng.integers(2**31))

    def stamps(minus: int) -> NoisyStamps:
        clean = np.concatenate([versions.stamps[rows, turn, minus] for turn in (0, 1, 0, 1)])
        shear = versions.population.shear
        return NoisyStamps(
            pixels=clean + np.concatenate([noise, turned, -noise, -turned]),
            clean=clean,
            shear=-shear if minus else shear,
            identifiers=np.tile(names, len(symmetries)),
            symmetry=np.repeat(symmetries, batch),
            psf_of=np.tile(versions.psf_of[rows], len(symmetries)),
            offsets=np.concatenate([versions.offsets[rows, turn] for turn in (0, 1, 0, 1)]),
            variance=sigma**2,
            seed=added,
            e_rms=versions.e_rms,
            power=power,
        )

    return stamps(0), stamps(1)


def _cut_as_seen(
    pair: tuple[NoisyStamps, NoisyStamps], settings: Settings, fraction: float
) -> tuple[NoisyStamps, NoisyStamps]:
    """Remove the fraction of both that has the least S/N on the image as seen."""
    seen = []
    for stamps in pair:
        pixels, psf, _ = arrays_of(stamps, settings)
        responses = measure_responses(pixels, psf, noise_variance=stamps.variance, isotropise=False)
        snr = np.asarray(to_numpy(responses.snr[:, 0]))
        seen.append(np.where(np.isfinite(snr), snr, -np.inf))
    least = np.quantile(np.concatenate(seen), fraction)
    plus, minus = (
        stamps.take(np.flatnonzero(snr > least)) for stamps, snr in zip(pair, seen, strict=True)
    )
    return plus, minus


@dataclass(kw_only=True)
class _Tally:
    """What one estimator has found so far."""

    name: str
    control: Callable[[NoisyStamps, Settings], NDArray[np.float64]] | None
    pairs: list[tuple[Found, Found]]
    seconds: float = 0.0

    def add(self, pair: tuple[NoisyStamps, NoisyStamps], settings: Settings) -> None:
        start = time.perf_counter()
        plus, minus = (self._measure(stamps, settings) for stamps in pair)
        self.seconds += time.perf_counter() - start
        if self.control is not None:
            plus, minus = (
                replace(found, g=found.g - self.control(stamps, settings))
                for found, stamps in zip((plus, minus), pair, strict=True)
            )
        self.pairs.append((plus, minus))

    def _measure(self, stamps: NoisyStamps, settings: Settings) -> Found:
        with warnings.catch_warnings():
            # They say that results at this S/N are bad, which is what is to be seen here.
            warnings.simplefilter("ignore", FdntWarning)
            try:
                return ESTIMATORS[self.name].measure(stamps, settings)
            except FdntValueError:  # no shear can be found
                return Found(g=np.full(2, np.nan), sigma_g=math.nan, n_used=0)

    def result(self, common: dict[str, Any]) -> NoiseBias:
        g = np.array([[plus.g, minus.g] for plus, minus in self.pairs])
        m = (g[:, 0, 0] - g[:, 1, 0]) / (2.0 * common["population"].shear) - 1.0
        c = 0.5 * (g[:, 0] + g[:, 1])
        halves = [found for pair in self.pairs for found in pair]
        root = math.sqrt(len(m))
        c_mean, c_err = np.mean(c, axis=0), np.std(c, axis=0, ddof=1) / root
        return NoiseBias(
            estimator=self.name,
            m=float(np.mean(m)),
            m_err=float(np.std(m, ddof=1) / root),
            c=(float(c_mean[0]), float(c_mean[1])),
            c_err=(float(c_err[0]), float(c_err[1])),
            sigma_g=float(np.sqrt(np.mean([found.sigma_g**2 for found in halves]))),
            unused=1.0 - sum(found.n_used for found in halves) / common["n_stamps"],
            seconds_per_stamp=self.seconds / common["n_stamps"],
            control=self.control is not None,
            **common,
        )


def check_snr(snr: float) -> float:
    """Return an S/N that can be; `RangeError` otherwise."""
    if not 0.0 < snr < math.inf:
        raise RangeError("snr", snr, 0.0, None)
    return snr


def _check(
    snr: float,
    estimators: Sequence[str],
    n_stamps: int,
    batch: int,
    cut: Cut | None,
    observed_cut: float | None,
) -> None:
    check_estimators(estimators)
    check_snr(snr)
    if n_stamps < 1:
        raise RangeError("n_stamps", n_stamps, 1, None)
    if batch < 2:
        raise RangeError("batch", batch, 2, None)
    if observed_cut is not None and not 0.0 < observed_cut < 1.0:
        raise RangeError("observed_cut", observed_cut, 0.0, 1.0)
    if cut is not None and (deaf := [name for name in estimators if not ESTIMATORS[name].cuts]):
        raise FdntValueError(f"{', '.join(deaf)} cannot cut in the counter-sheared frame")
