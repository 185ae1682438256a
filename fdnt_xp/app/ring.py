"""What `fdnt-xp ring` does, between its options and its last line."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

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
from fdnt_xp.data.profiles import TEST_GALAXIES, gaussian_psf, moffat_psf, sersic
from fdnt_xp.data.ring import RingResult, ring_test
from fdnt_xp.errors import FdntValueError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

TARGET: Final = 1e-3
"""What surveys want `|m|` to be below."""
COLOURS: Final = {
    "raw": INK,
    "eg": ORANGE,
    "eg+cubic": ORANGE,
    "null-frozen": BLUE,
    "null-eta": GREEN,
}
"""By estimator, here and in the figures of the documentation."""


@dataclass(frozen=True, kw_only=True)
class RingOptions:
    """A ring test by the options of the command line; see `fdnt_xp.data.ring.ring_test`."""

    galaxy: str = "vb-spiral"
    psf: str = "gaussian:2,0.1,0.05"
    delta_eta: float = 0.02
    angles: int = 16
    stamp: int = 128
    padding: int = 1
    pixel: bool = False
    method: str = "fdnt-ft"
    backend: str = "numpy"
    device: str | None = None
    dtype: str = "float64"


def run_ring(
    options: RingOptions, output: str | None, plot: str | None, *, overwrite: bool
) -> Iterator[str]:
    """Run the test, write what is asked for, and yield the lines of the report."""
    if output is not None:
        check_json(output, overwrite=overwrite)
    if plot is not None:
        check_figure(plot, overwrite=overwrite)
    galaxy, psf = parse_galaxy(options.galaxy), parse_psf(options.psf)
    result = ring_test(
        galaxy,
        psf,
        options.delta_eta,
        method=options.method,
        n_angles=options.angles,
        stamp_size=options.stamp,
        padding=options.padding,
        pixel=options.pixel,
        to_array=load_backend(options.backend, options.device, options.dtype).from_numpy,
    )
    yield f"galaxy     {options.galaxy}, PSF {options.psf}"
    yield from report(result)
    if output is not None:
        named = {"galaxy": options.galaxy, "psf": options.psf}
        write_json({**named, **result.to_dict()}, output, overwrite=overwrite)
        yield f"written    {output}"
    if plot is not None:
        title = f"{options.galaxy}, PSF {options.psf}"
        save_figure(plot_ring(result, title), plot, overwrite=overwrite)
        yield f"written    {plot}"


def report(result: RingResult) -> Iterator[str]:
    """Yield the lines that say how a ring test came out."""
    turn = "2 pi" if result.full_turn else "pi"
    yield (
        f"ring       {result.n_gal} angles over {turn}, stamps of {result.stamp_size} pixels, "
        f"{result.method}"
    )
    eta = math.hypot(*result.delta_eta)
    yield f"shear      delta eta = +-{eta:g}, reduced shear g = +-{result.g:.6f}"
    yield f"shape      |e| = {result.e:.4f}, ellipticity gradient EG = {result.eg:+.4f}"
    if result.n_failed:
        yield f"failed     {result.n_failed} of {3 * result.n_gal} galaxies"
    yield f"{'estimator':<11}{'m':>10}{'+-':>9}{'c1':>11}{'c2':>11}{'+-':>9}"
    for name, bias in result.biases.items():
        m_err = "" if bias.m_err is None else f"{bias.m_err:.0e}"
        c_err = "" if bias.c_err is None else f"{max(bias.c_err):.0e}"
        c1, c2 = bias.c
        yield f"{name:<11}{bias.m:>+10.2e}{m_err:>9}{c1:>+11.1e}{c2:>+11.1e}{c_err:>9}"


def parse_galaxy(text: str) -> Any:
    """Return the galaxy that a name or `sersic:N,HLR,E` stands for."""
    if text in TEST_GALAXIES:
        return TEST_GALAXIES[text]()
    n, radius, e = _numbers(text, {"sersic": 3}, [*TEST_GALAXIES, "sersic:N,HLR,E"])[1]
    if not (0.3 <= n <= 6.2 and radius > 0 and 0 <= e < 1):
        raise FdntValueError(f"no galaxy {text!r}: 0.3 <= N <= 6.2, HLR > 0 and 0 <= E < 1")
    return sersic(n, radius, (e, 0.0))


def parse_psf(text: str) -> Any:
    """Return the PSF that `gaussian:HLR,E1,E2` or `moffat:BETA,FWHM,E1,E2` stands for."""
    known = ["gaussian:HLR,E1,E2", "moffat:BETA,FWHM,E1,E2"]
    kind, values = _numbers(text, {"gaussian": 3, "moffat": 4}, known)
    *profile, e1, e2 = values
    least = 1.1  # of beta: a Moffat of 1 has no finite flux
    if profile[-1] <= 0 or math.hypot(e1, e2) >= 1 or (kind == "moffat" and profile[0] < least):
        raise FdntValueError(f"no PSF {text!r}: sizes are positive, BETA > {least}, e < 1")
    if kind == "gaussian":
        return gaussian_psf(profile[0], (e1, e2))
    return moffat_psf(profile[0], profile[1], (e1, e2))


def plot_ring(result: RingResult, title: str) -> Figure:
    """Draw `|m|` and `|c|` of each estimator, on logarithmic axes, with the target."""
    with page_style():
        figure = new_figure(9.5, 3.6)
        left, right = figure.subplots(1, 2, sharey=True)
        names = list(result.biases)
        left.set(xscale="log", xlabel="$|m|$   (open: negative)", xlim=(1e-10, 1.0))
        right.set(xscale="log", xlabel="$|c|$", xlim=(1e-15, 1e-3))
        for name, bias in result.biases.items():
            row = names.index(name)
            _dot(left, row, bias.m, COLOURS[name], f"{bias.m:+.1e}")
            c = math.hypot(*bias.c)
            _dot(right, row, c, COLOURS[name], f"{c:.0e}")
        left.axvspan(1e-12, TARGET, color=GREEN, alpha=0.10, lw=0, zorder=0)
        left.set_yticks(range(len(names)), names)
        left.set_ylim(len(names) - 0.5, -0.6)
        eta = math.hypot(*result.delta_eta)
        figure.suptitle(f"{title},  $\\Delta\\eta = \\pm{eta:g}$", x=0.02, ha="left", fontsize=12)
    return figure


def _dot(axes: Axes, row: int, signed: float, colour: str, label: str) -> None:
    """Draw the modulus of a number, open if it is negative, at the edge if it is off the axis."""
    low, high = axes.get_xlim()
    value = min(max(abs(signed), 2.0 * low), high)
    axes.plot([low, value], [row, row], color=PALE, lw=1.2, zorder=1)
    face = "white" if signed < 0 else colour
    axes.plot([value], [row], "o", ms=7, mec=colour, mfc=face, mew=1.6, zorder=2)
    axes.annotate(
        label, (value, row), xytext=(0, 7), textcoords="offset points", ha="center", fontsize=8.5
    )


def _numbers(text: str, kinds: dict[str, int], known: list[str]) -> tuple[str, list[float]]:
    """Split `kind:1,2,3` into the kind and as many finite numbers as it wants."""
    kind, _, rest = text.partition(":")
    try:
        values = [float(part) for part in rest.split(",")]
    except ValueError:
        values = []
    if kind not in kinds or len(values) != kinds[kind] or not all(map(math.isfinite, values)):
        raise FdntValueError(f"{text!r} is not understood; known are {', '.join(known)}")
    return kind, values
