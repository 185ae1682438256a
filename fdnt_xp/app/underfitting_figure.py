"""The figure on underfitting of Bernstein 2010, drawn again: bias and noise of three methods."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

import fdnt_xp.peers  # noqa: F401  gives its methods their names
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
from fdnt_xp.arrays import to_numpy
from fdnt_xp.data.profiles import gaussian_psf, load_galsim, sersic
from fdnt_xp.data.ring import draw
from fdnt_xp.fourier.psf import Psf
from fdnt_xp.shapes.measure import measure_shapes
from fdnt_xp.shapes.methods import ShapeMethod, shape_method
from fdnt_xp.shapes.results import ShapeResult

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SERSIC: Final = (0.5, 1.0, 2.0, 4.0)
DISTORTIONS: Final = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6)
PSF_SIZES: Final = (0.5, 1.0, 2.0)
"""Half-light radius of the PSF over that of the galaxy."""
PSF_E: Final = (0.1, 0.098)
"""e = 0.14, askew to the galaxies, which lie along x."""
RADIUS: Final = 3.0
"""Half-light radius of the galaxies, pixels."""
OFFSET: Final = (0.31, -0.23)
"""Of the galaxies from the centre of the stamp, pixels."""
SNR: Final = 1e4
"""`sqrt(sum I²)` over the noise of a pixel, of the round Gaussian galaxy."""

PANELS: Final = {
    # title: names of the methods, drawn solid and dashed
    "NB07, N = 8 (dashed: 12)": ("nb07-8", "nb07-12"),
    "FDNT-GL, N = 12 (dashed: 16)": ("fdnt-gl", "fdnt-gl-16"),
    "FDNT-FT": ("fdnt-ft",),
}
_FLOOR: Final = 1e-9
"""Lower end of the axis of bias."""
_CURVES: Final = dict(
    zip(SERSIC, ((ORANGE, "o"), (GREEN, "s"), (BLUE, "^"), (INK, "D")), strict=True)
)

Row: TypeAlias = "dict[str, Any]"
"""One galaxy measured by one method."""


@dataclass(frozen=True, kw_only=True)
class UnderfittingFigure:
    """What is measured for the figure, and where; as the options of the command line."""

    stamp: int = 128
    padding: int = 1
    backend: str = "numpy"
    device: str | None = None
    dtype: str = "float64"


def draw_underfitting_figure(
    figure: UnderfittingFigure,
    output: str,
    table: str | None,
    *,
    overwrite: bool,
    say: Callable[[str], None],
) -> None:
    """Measure all galaxies by all methods, say what comes out, write figure and numbers."""
    check_figure(output, overwrite=overwrite)
    if table is not None:
        check_rows(table, overwrite=overwrite)
    say(f"{'method':<12}{'PSF':>5}{'n':>5}" + "".join(f"{e:>18}" for e in DISTORTIONS))
    rows = measure_underfitting(figure, say)
    save_figure(plot_underfitting(rows), output, overwrite=overwrite)
    say(f"written    {output}")
    if table is not None:
        write_rows(rows, table, overwrite=overwrite)
        say(f"written    {table}")


def measure_underfitting(figure: UnderfittingFigure, say: Callable[[str], None]) -> list[Row]:
    """Measure without noise; errors are those that the methods report for the noise."""
    to_array = load_backend(figure.backend, figure.device, figure.dtype).from_numpy
    rows: list[Row] = []
    for ratio in PSF_SIZES:
        psf = gaussian_psf(ratio * RADIUS, PSF_E)
        star = Psf.from_image(to_array(draw(psf, figure.stamp, pixel=False)))
        variance, reference = _reference(to_array, psf, star, figure.stamp)
        for n in SERSIC:
            stamps = to_array(draw_galaxies(n, psf, figure.stamp))
            for name in (name for names in PANELS.values() for name in names):
                shapes = method_of(name)(
                    stamps, star, noise_variance=variance, padding=figure.padding
                )
                new = _rows(name, ratio, n, shapes.to_numpy(), reference)
                say(f"{name:<12}{ratio:>5}{n:>5}" + "".join(map(_cell, new)))
                rows += new
    return rows


def draw_galaxies(n: float, psf: Any, stamp: int) -> NDArray[np.float64]:
    """Draw a Sersic galaxy of each distortion behind a PSF, shape (n_distortion, ny, nx)."""
    galsim = load_galsim()
    galaxies = (sersic(n, RADIUS, (e, 0.0)).shift(*OFFSET) for e in DISTORTIONS)
    seen = (galsim.Convolve([one, psf], gsparams=psf.gsparams) for one in galaxies)
    return np.stack([draw(one, stamp, pixel=False) for one in seen])


def method_of(name: str) -> ShapeMethod:
    """Return a method by its name; `fdnt-gl-16` is FDNT-GL of order 16."""
    if name.startswith("fdnt-gl-"):
        return partial(measure_shapes, transform="gl", order=int(name.rpartition("-")[2]))
    return shape_method(name)


def plot_underfitting(rows: list[Row]) -> Figure:
    """Draw the figure: three PSFs for each method, bias above, noise below."""
    with page_style():
        figure = new_figure(16.0, 7.5)
        blocks: Any = figure.subfigures(1, len(PANELS), wspace=0.02)
        most = 2.0 * max((row["noise"] for row in rows if row["noise"] > 0), default=10.0)
        for block, (title, names) in zip(blocks, PANELS.items(), strict=True):
            block.suptitle(title, x=0.02, ha="left", fontsize=12, fontweight="bold")
            axes = block.subplots(2, len(PSF_SIZES), sharex=True, sharey="row")
            for column, ratio in enumerate(PSF_SIZES):
                for name, style in zip(names, ("-", "--"), strict=False):
                    mine = [r for r in rows if r["method"] == name and r["psf_size"] == ratio]
                    _draw(axes[:, column], mine, style)
                top, bottom = axes[:, column]
                top.set_title(f"PSF {ratio:g} x galaxy", fontsize=10, fontweight="normal")
                top.axhspan(_FLOOR, TARGET, color=GREEN, alpha=0.10, lw=0, zorder=0)
                top.set(yscale="log", ylim=(_FLOOR, 1.0))
                bottom.axhline(1.0, color=PALE, lw=1, zorder=0)
                bottom.set(yscale="log", ylim=(0.5, most), xlabel="$e$", xticks=DISTORTIONS[1::2])
            axes[0, 0].set_ylabel(r"bias  $|\delta e|/e$")
            axes[1, 0].set_ylabel(r"noise  $\sigma_e$ / that of a round Gaussian")
        handles, labels = blocks[0].axes[0].get_legend_handles_labels()
        solid = len(SERSIC)
        figure.legend(
            handles[:solid], labels[:solid], loc="outside lower center", ncols=solid, fontsize=10
        )
    return figure


def _reference(
    to_array: Callable[[NDArray[np.float64]], Any], psf: Any, star: Psf, stamp: int
) -> tuple[float, float]:
    """Return the noise variance, and the error of e of a round Gaussian galaxy.

    It is that of the maximum of the likelihood, the least there is: one for all methods.
    """
    galsim = load_galsim()
    galaxy = sersic(0.5, RADIUS).shift(*OFFSET)
    image = draw(galsim.Convolve([galaxy, psf], gsparams=psf.gsparams), stamp, pixel=False)
    variance = float(np.sum(image**2)) / SNR**2
    shapes = shape_method("gauss-1")(to_array(image[None]), star, noise_variance=variance)
    return variance, math.sqrt(float(np.mean(to_numpy(shapes.eta_cov)[0].diagonal())))


def _rows(name: str, ratio: float, n: float, shapes: ShapeResult, reference: float) -> list[Row]:
    rows = []
    for i, e in enumerate(DISTORTIONS):
        error = math.hypot(float(shapes.e[i, 0]) - e, float(shapes.e[i, 1]))
        # Along the galaxy, de = (1 - e²) deta.
        sigma = math.sqrt(float(shapes.eta_cov[i, 0, 0])) * (1.0 - float(shapes.e[i, 0]) ** 2)
        rows.append(
            {
                "method": name,
                "psf_size": ratio,
                "sersic": n,
                "e": e,
                "bias": error / e,
                "noise": sigma / reference,
                "flags": int(shapes.flags[i]),
            }
        )
    return rows


def _cell(row: Row) -> str:
    return f"{row['bias']:>10.1e}{row['noise']:>8.2f}"


def _draw(axes: Any, rows: list[Row], style: str) -> None:
    """Draw bias and noise of one method behind one PSF, a curve for each profile."""
    for n, (colour, marker) in _CURVES.items():
        mine = [row for row in rows if row["sersic"] == n]
        e = [row["e"] for row in mine]
        how = {"color": colour, "ls": style, "lw": 1.5, "marker": marker, "ms": 4.0}
        axes[0].plot(e, [row["bias"] for row in mine], label=f"Sersic n = {n:g}", **how)
        axes[1].plot(e, [row["noise"] for row in mine], **how)
