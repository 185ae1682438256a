"""What `fdnt-xp check` does, between its options and its last line."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Literal

import numpy as np

from fdnt_xp.app.backends import load_backend
from fdnt_xp.app.numbers import check_json, write_json
from fdnt_xp.app.plots import (
    BLUE,
    GREEN,
    INK,
    ORANGE,
    PALE,
    check_figure,
    new_figure,
    page_style,
    save_figure,
)
from fdnt_xp.app.ring import TARGET
from fdnt_xp.data.noise_bias import NoiseBias, check_snr, noise_bias
from fdnt_xp.data.noise_estimators import check_estimators
from fdnt_xp.data.versions import MIXED_RADII, Population, draw_versions
from fdnt_xp.errors import FdntValueError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

STYLES: Final = {
    "null": (BLUE, "o"),
    "null-plain": (INK, "o"),
    "null-eta": (INK, "s"),
    "responses": (GREEN, "o"),
    "shapes": (PALE, "s"),
    "hsm": (ORANGE, "v"),
    "anacal": (ORANGE, "D"),
}
"""Colour and marker by estimator."""
_RADIUS: Final = 2.3
_LINEAR_C: Final = 1e-4
"""Where the axis of c is linear; that of m is within the target."""


@dataclass(frozen=True, kw_only=True)
class CheckOptions:
    """A test of noise bias by the options of the command line; see `noise_bias`."""

    snr: str = "10,15,20,50"
    kind: Literal["exp", "dev", "mixed"] = "exp"
    radius: str | None = None
    psf_e: float = 0.1
    shear: float = 0.02
    estimators: tuple[str, ...] = ("null",)
    galaxies: int = 1024
    stamps: int = 100_000
    batch: int = 1024
    padding: int = 1
    seed: int = 0
    backend: str = "numpy"
    device: str | None = None
    dtype: str = "float64"


def run_check(
    options: CheckOptions, output: str | None, plot: str | None, *, overwrite: bool
) -> Iterator[str]:
    """Run the tests, yield the lines of the report as they come, write what is asked for."""
    if output is not None:
        check_json(output, overwrite=overwrite)
    if plot is not None:
        check_figure(plot, overwrite=overwrite)
    snrs = [check_snr(snr) for snr in parse_numbers("--snr", options.snr)]
    names = [name for given in options.estimators for name in given.split(",")]
    check_estimators(names)
    to_array = load_backend(options.backend, options.device, options.dtype).from_numpy
    population = Population(
        kind=options.kind,
        radius=parse_radius(options.radius, options.kind),
        psf_e=options.psf_e,
        shear=options.shear,
        n_gal=options.galaxies,
        seed=options.seed,
    )
    yield from describe(population)
    versions = draw_versions(population)
    yield table_header()
    biases = []
    for snr in snrs:
        found = noise_bias(
            versions,
            snr,
            names,
            n_stamps=options.stamps,
            batch=options.batch,
            padding=options.padding,
            seed=options.seed,
            to_array=to_array,
            quiet=False,
        )
        yield from map(table_row, found)
        biases += found
    if output is not None:
        write_json([bias.to_dict() for bias in biases], output, overwrite=overwrite)
        yield f"written    {output}"
    if plot is not None:
        save_figure(plot_biases(biases), plot, overwrite=overwrite)
        yield f"written    {plot}"


def describe(population: Population) -> Iterator[str]:
    """Yield the lines that say what is drawn."""
    low, high = population.radii
    radius = f"{low:g}" if low == high else f"{low:g} to {high:g}"
    yield (
        f"galaxies   {population.n_gal} {population.kind}, half-light radius {radius} pixels, "
        f"stamps of {population.stamp_size} pixels"
    )
    yield f"PSF        Moffat, e1 = {population.psf_e:g}, e2 = {0.5 * population.psf_e:g}"
    yield f"shear      g = +-{population.shear:g}"


def table_header() -> str:
    """Return the head of the table of biases."""
    return (
        f"{'estimator':<11}{'S/N':>6}{'m':>10}{'+-':>9}{'c1':>10}{'c2':>10}{'+-':>8}"
        f"{'sigma_g':>9}{'unused':>9}{'stamps':>10}{'us/stamp':>10}"
    )


def table_row(bias: NoiseBias) -> str:
    """Return the line of one bias."""
    return (
        f"{bias.estimator:<11}{bias.snr:>6g}{bias.m:>+10.5f}{bias.m_err:>9.5f}"
        f"{bias.c[0]:>+10.1e}{bias.c[1]:>+10.1e}{max(bias.c_err):>8.0e}{bias.sigma_g:>9.4f}"
        f"{bias.unused:>9.1e}{bias.n_stamps:>10d}{1e6 * bias.seconds_per_stamp:>10.0f}"
    )


def parse_numbers(option: str, text: str) -> list[float]:
    """Return the numbers of a comma list."""
    try:
        return [float(part) for part in text.split(",")]
    except ValueError as error:
        raise FdntValueError(f"{option} must be numbers with commas, not {text!r}") from error


def parse_radius(text: str | None, kind: str) -> float | tuple[float, float]:
    """Return a radius, or the ends of a range; by default what suits the kind."""
    if text is None:
        return MIXED_RADII if kind == "mixed" else _RADIUS
    numbers = parse_numbers("--radius", text)
    if len(numbers) > 2:
        raise FdntValueError(f"--radius must be a number or LOW,HIGH, not {text!r}")
    return numbers[0] if len(numbers) == 1 else (numbers[0], numbers[1])


def plot_biases(biases: Sequence[NoiseBias]) -> Figure:
    """Draw m, c1 and sigma_g of each estimator against S/N, m with the target.

    m and c are linear near zero and logarithmic beyond.
    """
    population = biases[0].population
    with page_style():
        figure = new_figure(9.5, 6.8)
        axes: dict[str, Axes] = figure.subplot_mosaic(
            [["m", "c"], ["sigma", "sigma"]], height_ratios=[3, 2]
        )
        axes["m"].axhspan(-TARGET, TARGET, color=GREEN, alpha=0.10, lw=0, zorder=0)
        axes["m"].set_yscale("symlog", linthresh=TARGET)
        axes["c"].set_yscale("symlog", linthresh=_LINEAR_C)
        names = list(dict.fromkeys(bias.estimator for bias in biases))
        for number, name in enumerate(names):
            # Side by side, or one would hide the others.
            shift = 1.02 ** (number - 0.5 * (len(names) - 1))
            _draw_estimator(axes, [bias for bias in biases if bias.estimator == name], shift)
        axes["m"].set(ylabel="$m$")
        axes["c"].set(ylabel="$c_1$")
        axes["sigma"].set(ylabel=r"$\sigma_g$ of a galaxy", ylim=(0.0, None))
        for panel in axes.values():
            snr_axis(panel, sorted({bias.snr for bias in biases}))
        for panel in (axes["m"], axes["c"]):
            panel.axhline(0.0, color=PALE, lw=1.0, zorder=0)
        handles, labels = axes["sigma"].get_legend_handles_labels()
        figure.legend(handles, labels, ncols=len(names), loc="outside lower center")
        low, high = population.radii
        radius = f"{low:g}" if low == high else f"{low:g}-{high:g}"
        title = f"{population.kind}, half-light radius {radius} px, PSF e1 = {population.psf_e:g}"
        figure.suptitle(f"{title},  $g = \\pm{population.shear:g}$", x=0.02, ha="left", fontsize=12)
    return figure


def _draw_estimator(axes: dict[str, Axes], biases: list[NoiseBias], shift: float) -> None:
    """Draw the points of one estimator, moved by a factor along the axis of S/N."""
    name = biases[0].estimator
    colour, marker = STYLES.get(name, (INK, "x"))
    snr = shift * np.array([bias.snr for bias in biases])
    points = {
        "m": [(bias.m, bias.m_err) for bias in biases],
        "c": [(bias.c[0], bias.c_err[0]) for bias in biases],
    }
    for panel, values in points.items():
        y, err = np.transpose(values)
        axes[panel].errorbar(snr, y, err, fmt=marker, ms=5, color=colour, capsize=2, lw=1.2)
    sigma = [bias.sigma_g for bias in biases]
    axes["sigma"].plot(snr, sigma, marker, ms=5, color=colour, label=name)


def snr_axis(panel: Axes, snrs: list[float]) -> None:
    """Label the axis of S/N at the values that were tested."""
    from matplotlib.ticker import NullLocator

    panel.set(xscale="log", xlabel="S/N", xlim=(0.8 * snrs[0], 1.25 * snrs[-1]))
    panel.set_xticks(snrs, [f"{snr:g}" for snr in snrs])
    panel.xaxis.set_minor_locator(NullLocator())
