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
from dataclasses import asdict, dataclass
from typing import Any, Final, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from fdnt_xp.arrays import Array, array_namespace, device_of, to_numpy
from fdnt_xp.data.other_codes import (
    Found,
    NoisyStamps,
    fpfs_shear,
    regauss_shear,
    turn_quarter,
)
from fdnt_xp.data.profiles import load_galsim
from fdnt_xp.data.simulate import PSF_BETA, PSF_FWHM, sample_g
from fdnt_xp.errors import FdntValueError, FdntWarning, RangeError
from fdnt_xp.fourier.psf import Psf
from fdnt_xp.shapes.measure import measure_shapes
from fdnt_xp.shears.cuts import Cut
from fdnt_xp.shears.estimate import ShearEstimate
from fdnt_xp.shears.from_responses import shear_from_responses
from fdnt_xp.shears.from_shapes import shear_from_shapes
from fdnt_xp.shears.population import population_null
from fdnt_xp.shears.responses import measure_responses

Kind: TypeAlias = Literal["exp", "dev", "mixed"]
KINDS: Final = ("exp", "dev", "mixed")
MIXED_RADII: Final = (1.3, 2.3)
SYMMETRIES: Final = (0, 1, 4, 5)
"""The versions of a galaxy that share noise, as `noise_symmetry` counts: as it is, turned
with its noise, with the noise of opposite sign, and both."""
VERSIONS: Final = 2 * len(SYMMETRIES)
"""Noisy stamps of a galaxy in one realisation of the noise: those, for either shear."""
_LARGEST_G: Final = 0.6
"""Of a shape before the shear: the stamps would cut off more elongated galaxies."""
_MIXED_FLUXES, _MIXED_PSFS, _MIXED_E, _MIXED_FWHM = 6.0, 20, 0.03, 0.1
"""Brightest over faintest; PSFs, and the ranges of their e and of their FWHM around the mean."""


@dataclass(frozen=True, kw_only=True)
class Population:
    """Galaxies to draw; `draw_versions` draws them.

    Parameters
    ----------
    kind : {"exp", "dev", "mixed"}
        Exponential, de Vaucouleurs, or both, with fluxes over a factor of 6 and 20 PSFs of
        different shape and size.
    radius : float or tuple of float
        Half-light radius in pixels, or the ends of a range.
    psf_e : float
        Distortion e1 of the Moffat PSF; e2 is half of that. For "mixed" those of the mean.
    shear : float
        Reduced shear g, applied along x as +g and -g.
    n_gal : int
        Different galaxies.
    stamp_size : int
        Pixels on a side.
    seed : int
        Of everything that is drawn but the noise.
    """

    kind: Kind = "exp"
    radius: float | tuple[float, float] = 2.3
    psf_e: float = 0.1
    shear: float = 0.02
    n_gal: int = 1024
    stamp_size: int = 48
    seed: int = 0

    def __post_init__(self) -> None:
        """Refuse what cannot be drawn."""
        if self.kind not in KINDS:
            raise FdntValueError(f"no kind {self.kind!r} of galaxies; known are {', '.join(KINDS)}")
        low, high = self.radii
        if not (0.0 < low <= high and high < 0.25 * self.stamp_size):
            raise FdntValueError(
                f"radius must be positive, or a range from low to high, and below a quarter of "
                f"the stamp of {self.stamp_size} pixels, not {self.radius!r}"
            )
        if not 0.0 <= self.psf_e <= 0.5:
            raise RangeError("psf_e", self.psf_e, 0.0, 0.5)
        if not 0.0 < self.shear <= 0.2:
            raise RangeError("shear", self.shear, 0.0, 0.2)
        if self.n_gal < 2:
            raise RangeError("n_gal", self.n_gal, 2, None)

    @property
    def radii(self) -> tuple[float, float]:
        """Ends of the range of radii."""
        if isinstance(self.radius, int | float):
            return float(self.radius), float(self.radius)
        low, high = self.radius
        return float(low), float(high)


@dataclass(frozen=True, kw_only=True)
class Versions:
    """Galaxies without noise, each drawn four times.

    Parameters
    ----------
    population : Population
        What was drawn.
    stamps : array, shape (n_gal, 2, 2, ny, nx)
        By galaxy; as it is, and turned by 90 degrees counter-clockwise before the shear with
        its offset from the middle; shear +g, and -g. The PSF is never turned.
    psf_images : array, shape (n_psf, ny, nx)
        With the pixel.
    psf_of : array, shape (n_gal,)
        Which PSF each galaxy has.
    offsets : array, shape (n_gal, 2, 2)
        By galaxy; as it is, and turned; (x, y) of the centre from the middle of the stamp.
    e_rms : float
        Of one component of the distortions before the shear.
    """

    population: Population
    stamps: NDArray[np.float64]
    psf_images: NDArray[np.float64]
    psf_of: NDArray[np.int64]
    offsets: NDArray[np.float64]
    e_rms: float


def draw_versions(population: Population) -> Versions:
    """Draw every galaxy four times: as it is and turned, with shear +g and -g.

    Raises
    ------
    MissingExtraError
        If GalSim is not installed.
    """
    galsim = load_galsim()
    # The wings of an elongated de Vaucouleurs need transforms beyond GalSim's limit.
    accuracy = galsim.GSParams(folding_threshold=2e-3, maximum_fft_size=32768, kvalue_accuracy=1e-6)
    n, size = population.n_gal, population.stamp_size
    rng = np.random.default_rng([population.seed, 0])
    psfs = [galsim.Moffat(beta=PSF_BETA, fwhm=fwhm, gsparams=accuracy).shear(e1=e1, e2=e2)
            for fwhm, e1, e2 in _psf_shapes(population, rng)]  # fmt: skip
    psf_of = rng.integers(len(psfs), size=n)
    g, angle = _intrinsic_g(rng, n), rng.uniform(0.0, 2.0 * np.pi, n)
    shapes = np.stack([g * np.cos(angle), g * np.sin(angle)], axis=-1)
    offset = rng.uniform(-0.5, 0.5, (n, 2))
    offsets = np.stack([offset, np.stack([-offset[:, 1], offset[:, 0]], axis=-1)], axis=1)
    mixed = population.kind == "mixed"
    radii = rng.uniform(*population.radii, n)
    fluxes = _MIXED_FLUXES ** rng.uniform(0.0, 1.0, n) if mixed else np.ones(n)
    profiles = {"exp": galsim.Exponential, "dev": galsim.DeVaucouleurs}
    kinds = rng.choice(["exp", "dev"], n) if mixed else np.full(n, population.kind)
    stamps = np.zeros((n, 2, 2, size, size))
    for i in range(n):
        round_one = profiles[kinds[i]](
            half_light_radius=radii[i], flux=fluxes[i], gsparams=accuracy
        )
        for turned, shape in enumerate((shapes[i], -shapes[i])):
            galaxy = round_one.shear(g1=shape[0], g2=shape[1])
            for minus, shear in enumerate((population.shear, -population.shear)):
                seen = galsim.Convolve([galaxy.shear(g1=shear, g2=0.0), psfs[psf_of[i]]])
                at = galsim.PositionD(*offsets[i, turned])
                stamps[i, turned, minus] = _draw(seen, size, at)
    return Versions(
        population=population,
        stamps=stamps,
        psf_images=np.stack([_draw(psf, size, None) for psf in psfs]),
        psf_of=psf_of,
        offsets=offsets,
        e_rms=float(np.sqrt(0.5 * np.mean((2.0 * g / (1.0 + g**2)) ** 2))),
    )


def _psf_shapes(population: Population, rng: np.random.Generator) -> NDArray[np.float64]:
    """Return FWHM, e1 and e2 of each PSF, (n_psf, 3)."""
    mean = np.array([[PSF_FWHM, population.psf_e, 0.5 * population.psf_e]])
    if population.kind != "mixed":
        return mean
    spread = np.array([_MIXED_FWHM * PSF_FWHM, _MIXED_E, _MIXED_E])
    return mean + spread * rng.uniform(-1.0, 1.0, (_MIXED_PSFS, 3))


def _intrinsic_g(rng: np.random.Generator, n: int) -> NDArray[np.float64]:
    g = np.empty(0)
    while len(g) < n:
        more = sample_g(rng, n)
        g = np.concatenate([g, more[more < _LARGEST_G]])
    return g[:n]


def _draw(profile: Any, size: int, offset: Any) -> NDArray[np.float64]:
    image = profile.drawImage(nx=size, ny=size, scale=1.0, offset=offset, dtype=np.float64)
    return np.asarray(image.array)


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What is the same for all batches.

    Parameters
    ----------
    psf : Psf
        All of them, in the library that computes.
    psf_images : array, shape (n_psf, ny, nx)
        The same, on the host.
    to_array : callable
        From NumPy to that library.
    cut : Cut or None
        In the counter-sheared frame.
    softening, padding
        Of `population_null`.
    """

    psf: Psf
    psf_images: NDArray[np.float64]
    to_array: Callable[[NDArray[np.float64]], Array]
    cut: Cut | None
    softening: float
    padding: int


@dataclass(frozen=True, kw_only=True)
class Estimator:
    """An estimator of shear, what to say of it, and whether it can cut in the frame."""

    text: str
    measure: Callable[[NoisyStamps, Settings], Found]
    cuts: bool = False


def _arrays(stamps: NoisyStamps, settings: Settings) -> tuple[Array, Psf, dict[str, Array]]:
    """Return stamps, PSFs and whole numbers in the library that computes."""
    pixels = settings.to_array(stamps.pixels)
    xp, device = array_namespace(pixels=pixels), device_of(pixels)
    psf = settings.psf
    if psf.n_psf > 1:
        psf = psf.take(xp.asarray(stamps.psf_of, device=device))
    numbers = {"identifiers": stamps.identifiers, "noise_symmetry": stamps.symmetry}
    return pixels, psf, {name: xp.asarray(n, device=device) for name, n in numbers.items()}


def _found(estimate: ShearEstimate) -> Found:
    g, error = (np.asarray(to_numpy(a), dtype=np.float64) for a in (estimate.g, estimate.g_err))
    sigma_g = float(np.sqrt(np.mean(error**2) * estimate.n_used))
    return Found(g=g, sigma_g=sigma_g, n_used=estimate.n_used)


def _null(stamps: NoisyStamps, settings: Settings, **options: Any) -> Found:
    pixels, psf, numbers = _arrays(stamps, settings)
    return _found(
        population_null(
            pixels,
            psf,
            noise_variance=stamps.variance,
            seed=stamps.seed,
            cut=settings.cut,
            padding=settings.padding,
            **numbers,
            **{"softening": settings.softening, **options},
        )
    )


def _null_plain(stamps: NoisyStamps, settings: Settings) -> Found:
    return _null(stamps, settings, isotropise=False)


def _null_eta(stamps: NoisyStamps, settings: Settings) -> Found:
    return _null(stamps, settings, statistic="eta")


def _responses(stamps: NoisyStamps, settings: Settings) -> Found:
    pixels, psf, numbers = _arrays(stamps, settings)
    responses = measure_responses(
        pixels,
        psf,
        noise_variance=stamps.variance,
        seed=stamps.seed,
        softening=settings.softening,
        padding=settings.padding,
        **numbers,
    )
    return _found(shear_from_responses(responses, cut=settings.cut))


def _shapes(stamps: NoisyStamps, settings: Settings) -> Found:
    pixels, psf, _ = _arrays(stamps, settings)
    shapes = measure_shapes(pixels, psf, noise_variance=stamps.variance, padding=settings.padding)
    return _found(shear_from_shapes(shapes))


def _hsm(stamps: NoisyStamps, settings: Settings) -> Found:
    return regauss_shear(stamps, settings.psf_images)


def _anacal(stamps: NoisyStamps, settings: Settings) -> Found:
    return fpfs_shear(stamps, settings.psf_images)


ESTIMATORS: Final[dict[str, Estimator]] = {
    "null": Estimator(text="population null, noise made round", measure=_null, cuts=True),
    "null-plain": Estimator(text="the same, noise as it is", measure=_null_plain, cuts=True),
    "null-eta": Estimator(
        text="population null, every shape solved anew", measure=_null_eta, cuts=True
    ),
    "responses": Estimator(text="responses of each galaxy", measure=_responses, cuts=True),
    "shapes": Estimator(text="shape of each galaxy, responsivity and EG", measure=_shapes),
    "hsm": Estimator(text="REGAUSS of GalSim, <e>/2(1 - e_rms²)", measure=_hsm),
    "anacal": Estimator(text="FPFS of AnaCal, linear responses", measure=_anacal),
}
"""What `noise_bias` compares."""


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
    softening, padding
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
    padding: int = 1

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
    batch: int = 1024,
    cut: Cut | None = None,
    observed_cut: float | None = None,
    softening: float = 1.0,
    padding: int = 1,
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
    softening, padding
        Of `population_null`.
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
    settings = Settings(
        psf=Psf.from_image(to_array(_one_or_all(versions.psf_images))),
        psf_images=versions.psf_images,
        to_array=to_array,
        cut=cut,
        softening=softening,
        padding=padding,
    )
    n_batches = max(2, math.ceil(n_stamps / (VERSIONS * batch)))
    tallies = {name: _Tally(name=name, pairs=[]) for name in estimators}
    hidden = quiet or not sys.stderr.isatty()
    with tqdm(
        total=n_batches * VERSIONS * batch, unit=" stamps", leave=False, disable=hidden
    ) as bar:
        for number in range(n_batches):
            pair = _noisy_pair(versions, number, batch, sigma, [seed, number, round(1000 * snr)])
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
        "padding": padding,
    }
    return [tally.result(common) for tally in tallies.values()]


def _one_or_all(images: NDArray[np.float64]) -> NDArray[np.float64]:
    return images[0] if len(images) == 1 else images


def _noisy_pair(
    versions: Versions, number: int, batch: int, sigma: float, seed: list[int]
) -> tuple[NoisyStamps, NoisyStamps]:
    """Return the stamps of a batch with shear +g, and those with -g."""
    rng = np.random.default_rng(seed)
    names = number * batch + np.arange(batch)
    rows = names % versions.population.n_gal
    size = versions.population.stamp_size
    noise = sigma * rng.standard_normal((batch, size, size))
    turned = turn_quarter(noise)
    added = int(rng.integers(2**31))

    def stamps(minus: int) -> NoisyStamps:
        as_is, other = (versions.stamps[rows, turn, minus] for turn in (0, 1))
        return NoisyStamps(
            pixels=np.concatenate([as_is + noise, other + turned, as_is - noise, other - turned]),
            identifiers=np.tile(names, len(SYMMETRIES)),
            symmetry=np.repeat(SYMMETRIES, batch),
            psf_of=np.tile(versions.psf_of[rows], len(SYMMETRIES)),
            offsets=np.concatenate([versions.offsets[rows, turn] for turn in (0, 1, 0, 1)]),
            variance=sigma**2,
            seed=added,
            e_rms=versions.e_rms,
        )

    return stamps(0), stamps(1)


def _cut_as_seen(
    pair: tuple[NoisyStamps, NoisyStamps], settings: Settings, fraction: float
) -> tuple[NoisyStamps, NoisyStamps]:
    """Remove the fraction of both that has the least S/N on the image as seen."""
    seen = []
    for stamps in pair:
        pixels, psf, _ = _arrays(stamps, settings)
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
    pairs: list[tuple[Found, Found]]
    seconds: float = 0.0

    def add(self, pair: tuple[NoisyStamps, NoisyStamps], settings: Settings) -> None:
        start = time.perf_counter()
        self.pairs.append((self._measure(pair[0], settings), self._measure(pair[1], settings)))
        self.seconds += time.perf_counter() - start

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
            **common,
        )


def check_estimators(names: Sequence[str]) -> None:
    """Raise `FdntValueError` unless all are known, each is there once, and there is one."""
    unknown = [name for name in names if name not in ESTIMATORS]
    if unknown or not names:
        raise FdntValueError(
            f"no estimator {', '.join(unknown) or 'given'}; known are {', '.join(ESTIMATORS)}"
        )
    if len(set(names)) < len(names):
        raise FdntValueError(f"an estimator is given twice: {', '.join(names)}")


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
