"""The figure on ellipticity gradients of Bernstein 2010, drawn again from ring tests."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, TypeAlias

import numpy as np

from fdnt_xp.app.backends import load_backend
from fdnt_xp.app.numbers import check_rows, write_rows
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
from fdnt_xp.data.profiles import TEST_GALAXIES, gaussian_psf, load_galsim
from fdnt_xp.data.ring import ESTIMATORS, RingResult, draw, ring_test

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PSF_RADII: Final = (2.0, 6.0)
"""Half-light radii of the PSF, pixels: from, to."""
TITLES: Final = {
    "vb-spiral": "1  VB spiral",
    "orthogonal": "2  Orthogonal",
    "torture": "3  Torture test",
}
_LEAST: Final = 3e-10
"""Lower end of the axis of `|m|`; the nulls come to 1e-8 or so."""
_JUMP: Final = 0.2
"""EG has a pole where the ellipticity passes through zero: no line across it."""
_CURVES: Final = {
    # estimator: (label, colour, line style, marker)
    "raw": ("without EG", INK, "--", "o"),
    "eg": ("with EG", ORANGE, "-", "s"),
    "eg+cubic": ("with EG, cubic", ORANGE, ":", "D"),
    "null-frozen": ("population null, frozen", BLUE, "-", "o"),
    "null-eta": ("population null, eta", GREEN, "-", "^"),
}

Row: TypeAlias = "dict[str, Any]"
"""One ring test: galaxy, PSF, and its result as columns."""


@dataclass(frozen=True, kw_only=True)
class GradientFigure:
    """What is measured for the figure, and where; as the options of the command line."""

    delta_eta: float = 0.02
    points: int = 9
    angles: int = 16
    stamp: int = 192
    padding: int = 2
    backend: str = "numpy"
    device: str | None = None
    dtype: str = "float64"


def draw_gradient_figure(
    figure: GradientFigure,
    output: str,
    table: str | None,
    *,
    overwrite: bool,
    say: Callable[[str], None],
) -> None:
    """Run the ring tests, say what comes out, and write the figure and the numbers."""
    check_figure(output, overwrite=overwrite)
    if table is not None:
        check_rows(table, overwrite=overwrite)
    say(f"{'galaxy':<12}{'PSF':>4}{'|e|':>8}{'EG':>9}" + "".join(f"{n:>12}" for n in ESTIMATORS))
    rows = measure_gradients(figure, say)
    save_figure(plot_gradients(rows, figure.delta_eta), output, overwrite=overwrite)
    say(f"written    {output}")
    if table is not None:
        write_rows(rows, table, overwrite=overwrite)
        say(f"written    {table}")


def measure_gradients(figure: GradientFigure, say: Callable[[str], None]) -> list[Row]:
    """Run a ring test of every galaxy with every PSF; say each."""
    to_array = load_backend(figure.backend, figure.device, figure.dtype).from_numpy
    rows = []
    for name, make in TEST_GALAXIES.items():
        for radius in np.linspace(*PSF_RADII, figure.points):
            result = ring_test(
                make(),
                gaussian_psf(float(radius)),
                figure.delta_eta,
                n_angles=figure.angles,
                stamp_size=figure.stamp,
                padding=figure.padding,
                errors=False,
                to_array=to_array,
            )
            rows.append(_row(name, float(radius), result))
            m = "".join(f"{bias.m:>+12.2e}" for bias in result.biases.values())
            say(f"{name:<12}{radius:>4.1f}{result.e:>8.4f}{result.eg:>+9.4f}{m}")
    return rows


def plot_gradients(rows: list[Row], delta_eta: float) -> Figure:
    """Draw the figure: a column for each galaxy, its image on top."""
    with page_style():
        figure = new_figure(11.5, 12.0)
        names = list(dict.fromkeys(row["galaxy"] for row in rows))
        axes = figure.subplots(
            4, len(names), sharey="row", height_ratios=[1.25, 0.75, 0.75, 1.5], squeeze=False
        )
        for column, name in enumerate(names):
            mine = [row for row in rows if row["galaxy"] == name]
            _draw_image(axes[0, column], name)
            _draw_lines(axes[1:, column], mine)
        axes[1, 0].set_ylim(0, 1.1 * max(row["e"] for row in rows))
        for row in axes[1:]:
            for panel in row[1:]:
                panel.tick_params(labelleft=False)
        labels = [
            "ellipticity  $|e|$",
            "gradient  $EG$",
            "multiplicative error  $|m|$  (open: negative)",
        ]
        for panel, label in zip(axes[1:, 0], labels, strict=True):
            panel.set_ylabel(label)
        handles, texts = axes[3, 0].get_legend_handles_labels()
        figure.legend(handles, texts, loc="outside lower center", ncols=len(texts), fontsize=10)
        figure.suptitle(
            "Ellipticity gradients: what a shear does to three galaxies that are not ellipses, "
            f"and three ways to undo it\nring tests, $\\Delta\\eta = \\pm{delta_eta:g}$, "
            "Gaussian PSF $e = (0.1, 0.05)$, no noise",
            x=0.015,
            ha="left",
            fontsize=12,
        )
    return figure


def _row(name: str, radius: float, result: RingResult) -> Row:
    biases = {f"m {key}": bias.m for key, bias in result.biases.items()}
    worst = max(abs(c) for bias in result.biases.values() for c in bias.c)
    return {
        "galaxy": name,
        "psf_hlr": radius,
        "delta_eta": result.delta_eta[0],
        "e": result.e,
        "eg": result.eg,
        **biases,
        "largest c": worst,
    }


def _draw_image(axes: Axes, name: str) -> None:
    """Draw the galaxy through the sharpest PSF, on a scale that shows its wings too."""
    seen = _seen(name)
    half = seen.shape[0] / 2
    axes.imshow(
        np.arcsinh(seen / (0.004 * seen.max())),
        origin="lower",
        cmap="magma",
        extent=(-half, half, -half, half),
        interpolation="bicubic",
    )
    axes.contour(
        seen / seen.max(),
        levels=[0.01, 0.03, 0.1, 0.3, 0.7],
        extent=(-half, half, -half, half),
        colors="white",
        linewidths=0.6,
        alpha=0.7,
    )
    axes.set_title(TITLES.get(name, name))
    axes.tick_params(labelleft=False, left=False, labelbottom=False, bottom=False)
    axes.spines[:].set_visible(False)
    axes.plot([-25, -15], [-27, -27], color="white", lw=2.5)
    axes.annotate("10 px", (-20, -25.5), color="white", ha="center", fontsize=9)


def _seen(name: str) -> np.ndarray[Any, Any]:
    both = [TEST_GALAXIES[name](), gaussian_psf(PSF_RADII[0])]
    return draw(load_galsim().Convolve(both), 64, pixel=False)


def _draw_lines(axes: Any, rows: list[Row]) -> None:
    """Draw ellipticity, EG and errors of one galaxy against the radius of the PSF."""
    radius = np.array([row["psf_hlr"] for row in rows])
    gradient = np.array([row["eg"] for row in rows])
    pole = np.flatnonzero(np.abs(np.diff(gradient)) > _JUMP) + 1
    broken = np.insert(radius, pole, np.nan), np.insert(gradient, pole, np.nan)
    for panel, curve in ((axes[0], (radius, [row["e"] for row in rows])), (axes[1], broken)):
        panel.plot(*curve, color=INK, lw=1.8, marker="o", ms=3.5)
        panel.tick_params(labelbottom=False)
    axes[1].axhline(0, color=PALE, lw=1, zorder=0)
    errors = axes[2]
    errors.axhspan(_LEAST, TARGET, color=GREEN, alpha=0.10, lw=0, zorder=0, label="target")
    for name, (label, colour, style, marker) in _CURVES.items():
        m = np.array([row[f"m {name}"] for row in rows])
        how = {"color": colour, "marker": marker, "ms": 5.0, "mew": 1.3}
        errors.plot(radius, np.abs(m), style, lw=1.6, label=label, **how)
        errors.plot(radius[m < 0], -m[m < 0], ls="", mfc="white", zorder=3, **how)
    errors.set(yscale="log", ylim=(_LEAST, 0.3), xlabel="PSF half-light radius [pixel]")
    errors.set_yticks(10.0 ** np.arange(-9, 0))
    errors.set_yticks([], minor=True)
    for panel in axes:
        panel.set_xlim(PSF_RADII[0] - 0.15, PSF_RADII[1] + 0.15)
        panel.set_xticks(range(2, 7))
