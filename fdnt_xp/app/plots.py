"""What a person looks at first: one page for a catalog of shapes."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from fdnt_xp.app.summary import (
    count_flags,
    format_measured,
    is_of_responses,
    mean_and_error,
    mean_line,
    measured_rows,
)
from fdnt_xp.data.files import check_writable, new_file
from fdnt_xp.errors import CatalogError, MissingExtraError
from fdnt_xp.flags import FAILED, Flag, flag_text

if TYPE_CHECKING:
    from astropy.table import Table
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Okabe and Ito's palette, which the colour-blind can tell apart.
BLUE: Final = "#0072B2"
ORANGE: Final = "#D55E00"
GREEN: Final = "#009E73"
INK: Final = "#333333"
PALE: Final = "#B5B5B5"

_NO_MATPLOTLIB: Final = (
    "figures need matplotlib, which is not installed: pip install 'fdnt-xp[plot]'"
)
FORMATS: Final = (".png", ".pdf", ".svg")
_MOST_WHISKERS: Final = 400
"""Up to this many galaxies each has its own whisker; more are averaged."""
_GALAXIES_PER_BIN: Final = 16
_STYLE: Final = {
    "font.size": 10.0,
    "axes.titlesize": 11.0,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "legend.frameon": False,
}


@dataclass(frozen=True)
class _Kind:
    """What a catalog holds, and the words for it."""

    columns: tuple[str, str]
    symbol: str
    title: str
    component: str


_SHAPES: Final = _Kind(("e1", "e2"), "e", "Shapes", "component of the distortion")
_RESPONSES: Final = _Kind(
    ("v1", "v2"), "v", "Quadrupoles", "component of the normalised quadrupole"
)
_ALL_HAVE: Final = ("snr", "flags")
NEEDED: Final = ("x", "y", "x_image", "y_image", *_SHAPES.columns, *_ALL_HAVE)


def plot_catalog(table: Table, title: str | None = None) -> Figure:
    """Draw the page: map of shapes, their histograms, flags, centroids, S/N.

    For a catalog of responses it is the quadrupoles that are drawn, and their responses in
    place of the ellipticity.

    Parameters
    ----------
    table : astropy.table.Table
        A catalog of `fdnt-xp measure`, with `--responses` or without.
    title : str, optional
        What to call it.

    Returns
    -------
    matplotlib.figure.Figure
        With no tie to pyplot; `save_figure` writes it.

    Raises
    ------
    CatalogError
        If a column is missing.
    MissingExtraError
        If matplotlib is not installed.
    """
    needed = NEEDED[:4] if is_of_responses(table) else NEEDED
    if missing := [name for name in needed if name not in table.colnames]:
        raise CatalogError(
            f"this is no catalog of fdnt-xp measure: it has no column {', '.join(missing)}"
        )
    kind = _RESPONSES if is_of_responses(table) else _SHAPES
    good = table[measured_rows(table)]
    with page_style():
        figure = new_figure(13.5, 11.5)
        panels = [["map", "map", "e"], ["map", "map", "abs"], ["flags", "centroid", "snr"]]
        axes: dict[str, Axes] = figure.subplot_mosaic(panels)
        figure.suptitle(_headline(table, good, title), x=0.015, ha="left", fontsize=13)
        _draw_map(axes["map"], good, kind)
        _draw_components(axes["e"], good, kind)
        if kind is _SHAPES:
            _draw_modulus(axes["abs"], good)
        else:
            _draw_responses(axes["abs"], good)
        _draw_flags(axes["flags"], table)
        _draw_centroids(axes["centroid"], good)
        _draw_snr(axes["snr"], good)
    return figure


@contextmanager
def page_style() -> Iterator[None]:
    """Draw in the style of the house; `MissingExtraError` without matplotlib."""
    try:
        import matplotlib
    except ImportError as error:
        raise MissingExtraError(_NO_MATPLOTLIB) from error
    with matplotlib.rc_context(_STYLE):
        yield


def new_figure(width: float, height: float) -> Figure:
    """Return an empty white page of so many inches, with no tie to pyplot."""
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    layout = ConstrainedLayoutEngine(w_pad=0.12, h_pad=0.12)
    return Figure(figsize=(width, height), layout=layout, facecolor="white")


def save_figure(figure: Figure, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
    """Write a figure in the format of its suffix, whole or not at all."""
    check_figure(path, overwrite=overwrite)
    with new_file(path, overwrite=overwrite) as temporary:
        figure.savefig(temporary, dpi=110)


def check_figure(path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
    """Raise what `save_figure` would raise, before there is anything to write."""
    if Path(path).suffix.lower() not in FORMATS:
        raise CatalogError(
            f"the suffix of {path} is no known figure format; known are {', '.join(FORMATS)}"
        )
    check_writable(path, overwrite=overwrite)


def _headline(table: Table, good: Table, title: str | None) -> str:
    text = f"{len(good):,} of {len(table):,} galaxies measured"
    if len(good):
        text += f"    {mean_line(table)}"
    return f"{title}\n{text}" if title else text


def _draw_map(axes: Axes, good: Table, kind: _Kind) -> None:
    """Whiskers along the major axes, averaged in bins where there are many."""
    x, y = np.asarray(good["x"], float), np.asarray(good["y"], float)
    if len(good) and np.ptp(x) == 0 and np.ptp(y) == 0:
        _draw_plane(axes, good, kind)
        return
    e = _complex(good, kind)
    axes.set(xlabel="x [pixel]", ylabel="y [pixel]", aspect="equal")
    axes.set_title(f"{kind.title} on the image")
    if not len(good):
        _say(axes, "no galaxy was measured")
        return
    if len(good) > _MOST_WHISKERS:
        x, y, e, bins = _average(x, y, e)
        axes.set_title(f"{kind.title} on the image, mean of bins of {bins:.0f} pixels")
    modulus = np.abs(e)
    direction = np.sqrt(e / np.where(modulus > 0, modulus, 1.0))
    longest = float(np.quantile(modulus, 0.98)) or 1.0
    spacing = np.sqrt(max(np.ptp(x), 1.0) * max(np.ptp(y), 1.0) / len(x))
    length = 1.1 * spacing / longest * np.minimum(modulus, 1.3 * longest)
    whiskers = axes.quiver(
        x,
        y,
        length * direction.real,
        length * direction.imag,
        modulus,
        angles="xy",
        scale_units="xy",
        scale=1.0,
        pivot="mid",
        headwidth=0,
        headlength=0,
        headaxislength=0,
        width=0.0032,
        cmap="cividis_r",
        clim=(0.0, longest),
    )
    room = 0.8 * spacing
    axes.set(xlim=(x.min() - room, x.max() + room), ylim=(y.min() - room, y.max() + room))
    bar = axes.figure.colorbar(whiskers, ax=axes, shrink=0.75, pad=0.02, extend="max")
    bar.set_label(f"|{kind.symbol}|, also the length of a whisker")
    bar.outline.set_visible(False)


def _draw_plane(axes: Axes, good: Table, kind: _Kind) -> None:
    """For stamps without a place on an image: one component against the other."""
    first, second = kind.columns
    axes.plot(good[first], good[second], ".", ms=3, alpha=_alpha(len(good)), color=BLUE, mew=0)
    reach = _reach(good, kind)
    if kind is _SHAPES:
        angle = np.linspace(0, 2 * np.pi, 181)
        axes.plot(np.cos(angle), np.sin(angle), color=PALE, lw=1)
    limits = (-1.05 * reach, 1.05 * reach)
    axes.set(xlim=limits, ylim=limits, aspect="equal", xlabel=first, ylabel=second)
    axes.set_title(f"{kind.title} (stamps of a cube have no place on an image)")


def _complex(good: Table, kind: _Kind) -> NDArray[np.complex128]:
    first, second = kind.columns
    return np.asarray(good[first]) + 1j * np.asarray(good[second])


def _reach(good: Table, kind: _Kind) -> float:
    """Return the end of the axes of components: 1 for a distortion, else beyond most."""
    if kind is _SHAPES or not len(good):
        return 1.0
    return 1.3 * float(np.quantile(np.abs(_complex(good, kind)), 0.99)) or 1.0


def _average(
    x: NDArray[Any], y: NDArray[Any], e: NDArray[Any]
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any], float]:
    """Return middles of square bins, the mean of `e` in each, and the side of a bin."""
    wanted = float(np.clip(len(x) / _GALAXIES_PER_BIN, 25, 600))
    side = np.sqrt(max(np.ptp(x), 1.0) * max(np.ptp(y), 1.0) / wanted)
    side = max(side, np.ptp(x) / 60, np.ptp(y) / 60)
    column, row = ((v - v.min()) // side for v in (x, y))
    _, bins = np.unique(np.stack([column, row]), axis=1, return_inverse=True)
    bins = bins.ravel()
    count = np.bincount(bins)
    means = [np.bincount(bins, weights=v) / count for v in (x, y, e.real, e.imag)]
    return means[0], means[1], means[2] + 1j * means[3], float(side)


def _draw_components(axes: Axes, good: Table, kind: _Kind) -> None:
    reach = _reach(good, kind)
    edges = np.linspace(-reach, reach, 1 + 2 * _bins(len(good))).tolist()
    for name, color in zip(kind.columns, (BLUE, ORANGE), strict=True):
        _step_histogram(axes, good, name, edges, color)
    axes.axvline(0, color=PALE, lw=1, zorder=0)
    axes.set(xlim=(-reach, reach), xlabel=kind.component, ylabel="galaxies")
    if kind is _SHAPES:
        axes.set_xticks([-1, -0.5, 0, 0.5, 1])
    axes.set_title("Components")
    _headroom(axes, 1.4)
    axes.legend(loc="upper left", fontsize=9)


def _draw_responses(axes: Axes, good: Table) -> None:
    """Show the two that do not vanish on average; a few per cent lie beyond the axis."""
    names = ("R11", "R22")
    values = np.concatenate([np.asarray(good[name], float) for name in names])
    low, high = np.quantile(values, (0.01, 0.99)) if len(values) else (-1.0, 1.0)
    edges = np.linspace(low, high if high > low else low + 1.0, 1 + 2 * _bins(len(good))).tolist()
    for name, color in zip(names, (BLUE, ORANGE), strict=True):
        _step_histogram(axes, good, name, edges, color)
    axes.set(xlim=(edges[0], edges[-1]), xlabel="response to shear", ylabel="galaxies")
    axes.set_title("Responses")
    _headroom(axes, 1.4)
    axes.legend(loc="upper left", fontsize=9)


def _step_histogram(axes: Axes, good: Table, name: str, edges: list[float], color: str) -> None:
    values = np.asarray(good[name])
    mean, error = mean_and_error(values)
    label = f"{name}: {format_measured(mean, error)}" if len(good) else name
    axes.hist(values, edges, histtype="step", lw=1.6, color=color, label=label)


def _draw_modulus(axes: Axes, good: Table) -> None:
    e = np.hypot(np.asarray(good["e1"]), np.asarray(good["e2"]))
    axes.hist(e, np.linspace(0, 1, 1 + _bins(len(good))).tolist(), color=BLUE, alpha=0.75)
    if len(e):
        axes.axvline(float(np.median(e)), color=INK, lw=1.2, ls="--")
        axes.annotate(
            f"median {np.median(e):.3f}",
            (float(np.median(e)), 0.94),
            xycoords=("data", "axes fraction"),
            xytext=(6, 0),
            textcoords="offset points",
            fontsize=9,
        )
    axes.set(xlim=(0, 1), xlabel="|e| = (a² - b²)/(a² + b²)", ylabel="galaxies")
    axes.set_title("Ellipticity")
    _headroom(axes)


def _draw_flags(axes: Axes, table: Table) -> None:
    counts = count_flags(table)
    plain = int(np.sum(np.asarray(table["flags"]) == 0))
    rows = [("no flag", plain, GREEN)]
    for name, count in counts.items():
        rows.append((flag_text(name), count, ORANGE if Flag[name] & FAILED else BLUE))
    names, numbers, colors = zip(*rows, strict=True)
    places = np.arange(len(rows))
    axes.barh(places, np.maximum(numbers, 0.5), height=0.34, color=colors, left=0.0)
    for place, name, number in zip(places, names, numbers, strict=True):
        axes.annotate(
            f"{name}: {number:,}",
            (0, place - 0.24),
            (2, 1),
            xycoords=("axes fraction", "data"),
            textcoords="offset points",
            fontsize=9,
            va="bottom",
        )
    axes.set(xscale="log", xlim=(0.5, 2.0 * max(len(table), 1)), yticks=[], xlabel="galaxies")
    axes.set_ylim(max(len(rows), 4) - 0.3, -0.9)
    axes.set_title("Flags")
    axes.spines["left"].set_visible(False)
    _plain_log_ticks(axes)
    for height, text, color in ((1.075, "measured, noted", BLUE), (1.01, "not measured", ORANGE)):
        axes.annotate(
            text, (1, height), xycoords="axes fraction", ha="right", fontsize=9, color=color
        )


def _draw_centroids(axes: Axes, good: Table) -> None:
    axes.set(aspect="equal", xlabel="Δx [pixel]", ylabel="Δy [pixel]")
    axes.set_title("Centroid minus given position")
    if not len(good):
        return
    dx = np.asarray(good["x_image"]) - np.asarray(good["x"])
    dy = np.asarray(good["y_image"]) - np.asarray(good["y"])
    reach = 1.15 * float(np.quantile(np.maximum(np.abs(dx), np.abs(dy)), 0.995)) or 1.0
    axes.axhline(0, color=PALE, lw=1, zorder=0)
    axes.axvline(0, color=PALE, lw=1, zorder=0)
    axes.plot(dx, dy, ".", ms=3.5, mew=0, alpha=_alpha(len(good)), color=BLUE)
    axes.set(xlim=(-reach, reach), ylim=(-reach, reach))


def _draw_snr(axes: Axes, good: Table) -> None:
    snr = np.asarray(good["snr"], float)
    snr = snr[np.isfinite(snr) & (snr > 0)]
    axes.set_title("Signal to noise")
    axes.set(xlabel="S/N under the weight", ylabel="galaxies", xscale="log")
    if not len(snr):
        axes.set(xticks=[], yticks=[])
        _say(axes, "no noise variance, no S/N")
        return
    low, high = float(snr.min()), float(snr.max())
    low, high = (low, high) if high > 1.2 * low else (low / 1.2, high * 1.2)
    axes.hist(snr, np.geomspace(low, high, 1 + _bins(len(snr))).tolist(), color=BLUE, alpha=0.75)
    axes.axvline(float(np.median(snr)), color=INK, lw=1.2, ls="--")
    left = np.median(snr) ** 2 > low * high  # of the line: where there is more room
    axes.annotate(
        f"median {np.median(snr):.3g}",
        (float(np.median(snr)), 0.94),
        xycoords=("data", "axes fraction"),
        xytext=(-6 if left else 6, 0),
        textcoords="offset points",
        ha="right" if left else "left",
        fontsize=9,
    )
    _plain_log_ticks(axes)
    _headroom(axes)


def _plain_log_ticks(axes: Axes) -> None:
    """Write 100, not 10²; where less than a decade is seen, 50 and 200 too."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    low, high = axes.get_xlim()
    decades = np.log10(high / low)
    steps = [1.0] if decades > 2 else [1.0, 2.0, 5.0] if decades > 0.7 else [*range(1, 10)]
    axes.xaxis.set_major_locator(LogLocator(subs=steps))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.4g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())


def _headroom(axes: Axes, factor: float = 1.22) -> None:
    """Leave the top free, for what is written there."""
    axes.set_ylim(0, max(1.0, factor * axes.dataLim.y1))


def _say(axes: Axes, text: str) -> None:
    axes.annotate(text, (0.5, 0.5), xycoords="axes fraction", ha="center", color=PALE)


def _bins(n: int) -> int:
    return int(np.clip(2.0 * np.sqrt(n), 10, 40))


def _alpha(n: int) -> float:
    return float(np.clip(30.0 / np.sqrt(max(n, 1)), 0.08, 0.7))
