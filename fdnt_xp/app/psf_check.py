"""What `fdnt-xp check --psf` does: whether to trust shapes and shears with this PSF and noise."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from fdnt_xp.app.backends import load_backend
from fdnt_xp.app.check import CheckOptions, parse_numbers, snr_axis
from fdnt_xp.app.numbers import check_json, write_json
from fdnt_xp.app.plots import (
    BLUE,
    GREEN,
    ORANGE,
    PALE,
    check_figure,
    new_figure,
    page_style,
    save_figure,
)
from fdnt_xp.app.ring import TARGET
from fdnt_xp.data.calibration import Calibration, error_calibration
from fdnt_xp.data.images import native_pixels, read_image
from fdnt_xp.data.noise_bias import NoiseBias, check_snr, noise_bias
from fdnt_xp.data.noise_power import measure_noise_power, noise_stamps
from fdnt_xp.data.own_psf import OwnPsf, psf_of_image
from fdnt_xp.data.versions import Population, Versions, draw_versions
from fdnt_xp.errors import FdntValueError, RangeError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

OWN: Final = ("psf", "oversampling", "pixel", "noise_variance", "noise_image")
"""Options of `OwnOptions` on the command line."""
_RADII: Final = (0.7, 1.5)
"""Half-light radii of the galaxies over that of the PSF."""
_LEAST_STAMP: Final = 48
_STAMP_PER_RADIUS: Final = 24.0
"""Pixels of a stamp per half-light radius of the PSF: the wings of the galaxies need them."""
_LARGEST_STAMP: Final = 480
"""Of a PSF that is none but an image of many stars, or of sky, it would be as large as that."""
_CHANCE: Final = 1e-3
"""Of a deviation that is none to be called one."""
_RIGHT: Final = 0.1
"""Of scatter over error: as far off 1 an error is called right."""
_CALIBRATION_STAMPS: Final = 6400
"""Enough to know the scatter over the error to 5 %."""
_MOST_LOST: Final = 0.01
_STYLES: Final = {"exp": (BLUE, "o", "exponential"), "dev": (ORANGE, "s", "de Vaucouleurs")}


@dataclass(frozen=True, kw_only=True)
class OwnOptions:
    """What is the user's own, by the options of the command line.

    Parameters
    ----------
    psf : str
        FITS file.
    oversampling : float
        Its pixels per pixel of the galaxies.
    pixel : bool
        Whether it lacks the pixel response.
    noise_variance : float or None
        Of a pixel.
    noise_image : str or None
        FITS file of blank sky.
    kinds : tuple of str
        Galaxies, "exp" and "dev".
    """

    psf: str
    oversampling: float = 1.0
    pixel: bool = False
    noise_variance: float | None = None
    noise_image: str | None = None
    kinds: tuple[str, ...] = ("exp", "dev")

    def __post_init__(self) -> None:
        """Refuse what there is not."""
        if not set(self.kinds) <= set(_STYLES):
            raise FdntValueError(
                f"--kind {self.kinds[0]} has PSFs of its own; with --psf it is exp or dev"
            )


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """What came out for one kind of galaxies at one S/N, and what to think of it.

    Parameters
    ----------
    bias : NoiseBias
    calibration : Calibration
    flux : float or None
        Of the mean galaxy at this S/N, in the unit of the image; None if the noise was not said.
    """

    bias: NoiseBias
    calibration: Calibration
    flux: float | None

    @property
    def complaints(self) -> list[str]:
        """What is wrong; empty if nothing is, as far as so many stamps can tell."""
        found, seen = [], self.calibration
        m, m_err = abs(self.bias.m), self.bias.m_err
        # Errors of few batches are none too well known.
        certain = float(stdtrit(self.bias.n_batches - 1, 1.0 - 0.5 * _CHANCE))
        if not math.isfinite(m):
            found.append("no shear can be found")
        elif m > TARGET and m > certain * m_err:
            found.append(f"m is {self.bias.m:+.4f}")
        for i, (c, err) in enumerate(zip(self.bias.c, self.bias.c_err, strict=True), start=1):
            if abs(c) > 0.2 * TARGET and abs(c) > certain * err:
                found.append(f"c{i} is {c:+.1e}")
        if abs(seen.shear_ratio - 1.0) > _RIGHT + 2.0 * seen.shear_ratio_err:
            found.append(f"the shear scatters by {seen.shear_ratio:.2f} of its error")
        if seen.lost > _MOST_LOST:
            found.append(f"{100.0 * seen.lost:.1f} % are lost")
        return found

    @property
    def settled(self) -> bool:
        """Whether m is known well enough to say that it meets the target."""
        return abs(self.bias.m) + 2.0 * self.bias.m_err <= TARGET

    @property
    def text(self) -> str:
        """One line for people."""
        if self.complaints:
            return "do not trust: " + "; ".join(self.complaints)
        if self.settled:
            return "fine"
        limit = abs(self.bias.m) + 2.0 * self.bias.m_err
        return f"nothing wrong is seen; |m| < {limit:.4f}, more --stamps say more"

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain Python, ready for `json.dumps`."""
        seen = {k: None if v != v else v for k, v in asdict(self.calibration).items()}
        return {
            **self.bias.to_dict(),
            "flux": self.flux,
            "calibration": seen,
            "complaints": self.complaints,
            "verdict": self.text,
        }


def run_psf_check(
    own: OwnOptions, options: CheckOptions, output: str | None, plot: str | None, *, overwrite: bool
) -> Iterator[str]:
    """Run the tests, yield the lines of the report as they come, write what is asked for."""
    if output is not None:
        check_json(output, overwrite=overwrite)
    if plot is not None:
        check_figure(plot, overwrite=overwrite)
    snrs = [check_snr(snr) for snr in parse_numbers("--snr", options.snr)]
    image = native_pixels(read_image(own.psf, what="PSF image"))
    psf = psf_of_image(image, oversampling=own.oversampling, pixel=own.pixel)
    size = stamp_size(psf)
    if size > _LARGEST_STAMP:
        raise FdntValueError(
            f"half the light of {own.psf} is within {psf.half_light_radius:.0f} pixels: the PSF is "
            "the image of one star, with its background taken off"
        )
    variance, power = _noise(own, size)
    to_array = load_backend(options.backend, options.device, options.dtype).from_numpy
    yield from describe(own, psf, size, options.shear)
    yield table_header()
    verdicts = []
    for kind in own.kinds:
        versions = draw_versions(_population(kind, psf, size, own.psf, options), psf.profile)
        for snr in snrs:
            verdict = _judge(versions, snr, options, variance, power, to_array)
            yield table_row(verdict)
            verdicts.append(verdict)
    yield from conclusions(verdicts)
    if output is not None:
        write_json([verdict.to_dict() for verdict in verdicts], output, overwrite=overwrite)
        yield f"written    {output}"
    if plot is not None:
        save_figure(plot_verdicts(verdicts), plot, overwrite=overwrite)
        yield f"written    {plot}"


def refuse_without_psf(given: dict[str, Any]) -> None:
    """Raise `FdntValueError` if options of `OwnOptions` were given and no PSF."""
    plain = {"psf": None, "oversampling": 1.0, "pixel": False}
    if extra := [name for name in OWN if given[name] != plain.get(name)]:
        named = ", ".join("--" + name.replace("_", "-") for name in extra)
        raise FdntValueError(f"{named}: only with --psf")


def stamp_size(psf: OwnPsf) -> int:
    """Return the side of stamps that hold galaxies behind this PSF, even."""
    return max(_LEAST_STAMP, 2 * math.ceil(0.5 * _STAMP_PER_RADIUS * psf.half_light_radius))


def describe(own: OwnOptions, psf: OwnPsf, size: int, shear: float) -> Iterator[str]:
    """Yield the lines that say what is drawn."""
    radius = psf.half_light_radius
    low, high = (radius * part for part in _RADII)
    yield f"PSF        {own.psf}, half-light radius {radius:.2f} pixels"
    if not psf.well_sampled:
        yield (
            f"           its transform has {psf.at_nyquist:.2f} of its height left where its "
            "pixels end it: what is between them is a guess, and m includes it"
        )
    yield (
        f"galaxies   {' and '.join(_STYLES[kind][2] for kind in own.kinds)}, half-light radius "
        f"{low:.2f} to {high:.2f} pixels, stamps of {size} pixels, g = +-{shear:g}"
    )


def table_header() -> str:
    """Return the head of the table of verdicts."""
    return (
        f"{'kind':<5}{'S/N':>6}{'flux':>10}{'m':>10}{'+-':>9}{'c1':>10}{'c2':>10}{'+-':>8}"
        f"{'lost':>7}{'shear':>7}{'eta':>6}{'no eta':>8}  verdict"
    )


def table_row(verdict: Verdict) -> str:
    """Return the line of one verdict: scatter over error of the shear and of eta in the middle."""
    bias, seen = verdict.bias, verdict.calibration
    flux = "-" if verdict.flux is None else f"{verdict.flux:.4g}"
    return (
        f"{bias.population.kind:<5}{bias.snr:>6g}{flux:>10}{bias.m:>+10.5f}{bias.m_err:>9.5f}"
        f"{bias.c[0]:>+10.1e}{bias.c[1]:>+10.1e}{max(bias.c_err):>8.0e}{seen.lost:>7.1%}"
        f"{seen.shear_ratio:>7.2f}{seen.shape_ratio:>6.2f}{seen.shapes_failed:>8.1%}  "
        f"{verdict.text}"
    )


def conclusions(verdicts: Sequence[Verdict]) -> Iterator[str]:
    """Yield what to think of it all."""
    snrs = sorted({verdict.bias.snr for verdict in verdicts})
    bad = [v.bias.snr for v in verdicts if v.complaints]
    good = [snr for snr in snrs if not bad or snr > max(bad)]
    if not bad:
        yield f"shear      nothing wrong down to S/N {snrs[0]:g}"
    elif good:
        yield f"shear      do not trust it below S/N {good[0]:g}"
    else:
        yield f"shear      do not trust it at S/N {snrs[-1]:g} or below"
    shapes = [snr for snr in snrs if all(_shapes_right(v) for v in verdicts if v.bias.snr >= snr)]
    yield (
        f"shapes     errors of eta are right to {_RIGHT:.0%}, and few fail, from S/N {shapes[0]:g}"
        if shapes
        else f"shapes     errors of eta are not right to {_RIGHT:.0%}, or many fail, at all S/N"
    )


def _shapes_right(verdict: Verdict) -> bool:
    seen = verdict.calibration
    off = abs(seen.shape_ratio - 1.0)
    return seen.shapes_failed <= _MOST_LOST and off <= _RIGHT + 2.0 * seen.shape_ratio_err


def _noise(own: OwnOptions, size: int) -> tuple[float | None, NDArray[np.float64] | None]:
    """Return the variance of a pixel, and the power spectrum unless white, if they were said."""
    if own.noise_variance is not None and own.noise_image is not None:
        raise FdntValueError("give --noise-variance or --noise-image, not both")
    if own.noise_image is None:
        if own.noise_variance is not None and not 0.0 < own.noise_variance < math.inf:
            raise RangeError("noise_variance", own.noise_variance, 0.0, None)
        return own.noise_variance, None
    blank = native_pixels(read_image(own.noise_image, ndim=(2, 3), what="noise image"))
    planes = [blank] if blank.ndim == 2 else list(blank)
    stamps = np.concatenate([noise_stamps(plane, (size, size)) for plane in planes])
    measured = measure_noise_power(stamps)
    return measured.variance, None if measured.is_white else measured.power


def _population(kind: str, psf: OwnPsf, size: int, name: str, options: CheckOptions) -> Population:
    low, high = (part * psf.half_light_radius for part in _RADII)
    return Population(
        kind="exp" if kind == "exp" else "dev",
        radius=(low, high),
        psf_e=0.0,
        shear=options.shear,
        n_gal=options.galaxies,
        stamp_size=size,
        seed=options.seed,
        psf_image=name,
    )


def _judge(
    versions: Versions,
    snr: float,
    options: CheckOptions,
    variance: float | None,
    power: NDArray[np.float64] | None,
    to_array: Any,
) -> Verdict:
    """Measure bias and calibration at one S/N."""
    common = {"power": power, "seed": options.seed, "to_array": to_array}
    (bias,) = noise_bias(
        versions,
        snr,
        n_stamps=options.stamps,
        batch=min(options.batch, options.galaxies),
        padding=options.padding,
        quiet=False,
        **common,
    )
    seen = error_calibration(
        versions, snr, n_stamps=min(options.stamps, _CALIBRATION_STAMPS), **common
    )
    # Fluxes are 1 where noise is sqrt(<sum I²>)/snr.
    height = math.sqrt(float(np.mean(np.sum(versions.stamps**2, axis=(-2, -1)))))
    flux = None if variance is None else snr * math.sqrt(variance) / height
    return Verdict(bias=bias, calibration=seen, flux=flux)


def plot_verdicts(verdicts: Sequence[Verdict]) -> Figure:
    """Draw m, c1, scatter over error, and what is lost, against S/N."""
    with page_style():
        figure = new_figure(9.5, 7.2)
        axes: dict[str, Axes] = figure.subplot_mosaic([["m", "c"], ["ratio", "lost"]])
        axes["m"].axhspan(-TARGET, TARGET, color=GREEN, alpha=0.10, lw=0, zorder=0)
        axes["m"].set_yscale("symlog", linthresh=TARGET)
        axes["c"].set_yscale("symlog", linthresh=0.1 * TARGET)
        axes["ratio"].axhspan(1.0 - _RIGHT, 1.0 + _RIGHT, color=GREEN, alpha=0.10, lw=0, zorder=0)
        kinds = list(dict.fromkeys(verdict.bias.population.kind for verdict in verdicts))
        for number, kind in enumerate(kinds):
            shift = 1.03 ** (number - 0.5 * (len(kinds) - 1))
            _draw_kind(axes, [v for v in verdicts if v.bias.population.kind == kind], shift)
        axes["m"].set(ylabel="$m$ of the population null")
        axes["c"].set(ylabel="$c_1$")
        axes["ratio"].set(ylabel="scatter / reported error")
        axes["lost"].set(ylabel="fraction lost", ylim=(-0.02, None))
        snrs = sorted({verdict.bias.snr for verdict in verdicts})
        for panel in axes.values():
            snr_axis(panel, snrs)
        for panel in (axes["m"], axes["c"]):
            panel.axhline(0.0, color=PALE, lw=1.0, zorder=0)
        axes["ratio"].axhline(1.0, color=PALE, lw=1.0, zorder=0)
        handles, labels = axes["ratio"].get_legend_handles_labels()
        figure.legend(handles, labels, ncols=2, loc="outside lower center")
        name = verdicts[0].bias.population.psf_image
        figure.suptitle(f"Simple galaxies behind {name}", x=0.02, ha="left", fontsize=12)
    return figure


def _draw_kind(axes: dict[str, Axes], verdicts: list[Verdict], shift: float) -> None:
    """Draw the points of one kind of galaxies, moved by a factor along the axis of S/N."""
    colour, marker, name = _STYLES[verdicts[0].bias.population.kind]
    snr = shift * np.array([v.bias.snr for v in verdicts])
    look: dict[str, Any] = {"fmt": marker, "ms": 5, "color": colour, "capsize": 2, "lw": 1.2}
    m = np.array([(v.bias.m, v.bias.m_err) for v in verdicts])
    c = np.array([(v.bias.c[0], v.bias.c_err[0]) for v in verdicts])
    axes["m"].errorbar(snr, m[:, 0], m[:, 1], **look)
    axes["c"].errorbar(snr, c[:, 0], c[:, 1], **look)
    seen = [v.calibration for v in verdicts]
    shear = np.array([(s.shear_ratio, s.shear_ratio_err) for s in seen])
    eta = np.array([(s.shape_ratio, s.shape_ratio_err) for s in seen])
    axes["ratio"].errorbar(snr, shear[:, 0], shear[:, 1], label=f"{name}, shear", **look)
    open_look = {**look, "mfc": "white"}
    axes["ratio"].errorbar(snr, eta[:, 0], eta[:, 1], label=f"{name}, eta (open)", **open_look)
    axes["lost"].plot(snr, [s.lost for s in seen], marker, ms=5, color=colour)
    axes["lost"].plot(snr, [s.shapes_failed for s in seen], marker, ms=5, color=colour, mfc="white")
