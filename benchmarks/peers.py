"""Speed beside accuracy, ours and that of other codes: same stamps, same run, one thread.

    python benchmarks/peers.py
    python benchmarks/peers.py --snr 200,20 --json peers.json --plot peers.png
    python benchmarks/peers.py --markdown

Times are CPU times in units of a batched FFT of the same stamps (`scipy.fft.rfft2`, 64 at a
time), each beside one; arguments are made before the clock starts. m and c come from galaxies
drawn with the shears +g and -g, each turned by 90 degrees as well, as `fdnt-xp check` has them.
Codes that are not installed are left out and named.
"""

from __future__ import annotations

import argparse
import importlib.util
import math
import os
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass

# Before NumPy loads.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import click
import numpy as np

import fdnt_xp as fx
from fdnt_xp.app.backends import load_backend
from fdnt_xp.app.bench import fft_of
from fdnt_xp.app.check import parse_numbers
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
from fdnt_xp.app.timing import Case, Timing, clock_for, limited_threads, time_cases
from fdnt_xp.data.noise_bias import NoiseBias, noise_bias, noisy_pair
from fdnt_xp.data.noise_estimators import ESTIMATORS, Estimator
from fdnt_xp.data.other_codes import (
    Found,
    NoisyStamps,
    fpfs_calls,
    fpfs_shear,
    hsm_shapes,
    ksb_shear,
)
from fdnt_xp.data.versions import KINDS, Population, Versions, draw_versions

BATCH = 128
"""Galaxies that make one m; the scatter of m makes its error."""
MARKERS = "osDv^<>P"
"""Of the codes in the figure, in their order."""
LEAST_M = 1e-6
"""Where the axis of the figure begins; what is below lies there."""
METACAL_BATCH, METACAL_STEP, METACAL_FWHM = 32, 0.01, 4.5
"""Of ngmix: a hundred times slower than the others; FWHM of the weight in pixels."""


@dataclass(frozen=True, kw_only=True)
class Code:
    """A code to compare.

    Parameters
    ----------
    label : str
    estimator : str
        Its name in `ESTIMATORS`, for m and c.
    prepare : callable
        Makes the arguments from stamps and star, and returns what is timed.
    needs : str, optional
        A package.
    few : bool
        Whether it is so slow that few stamps must do.
    """

    label: str
    estimator: str
    prepare: Callable[[NoisyStamps, np.ndarray], Callable[[], object]]
    needs: str | None = None
    few: bool = False


@dataclass(frozen=True, kw_only=True)
class Row:
    """What was found of a code at one S/N."""

    code: str
    ours: bool
    timing: Timing
    bias: NoiseBias


def ours(measure: Callable[..., object]) -> Callable[..., Callable[[], object]]:
    """Return the preparation of one of our functions."""

    def prepare(stamps: NoisyStamps, star: np.ndarray) -> Callable[[], object]:
        psf = fx.Psf.from_image(star)
        return lambda: measure(stamps.pixels, psf, noise_variance=stamps.variance)

    return prepare


def hsm(method: str) -> Callable[..., Callable[[], object]]:
    return lambda stamps, star: lambda: hsm_shapes(stamps, star[None], method)


def fpfs(*, renoise: bool) -> Callable[..., Callable[[], object]]:
    def prepare(stamps: NoisyStamps, star: np.ndarray) -> Callable[[], object]:
        calls = fpfs_calls(stamps, star[None], renoise=renoise)
        return lambda: [call() for call in calls]

    return prepare


CODES = (
    Code(label="measure_shapes", estimator="shapes", prepare=ours(fx.measure_shapes)),
    Code(label="population_null", estimator="null", prepare=ours(fx.population_null)),
    Code(label="measure_responses", estimator="responses", prepare=ours(fx.measure_responses)),
    Code(
        label="AnaCal FPFS, with responses",
        estimator="anacal-plain",
        prepare=fpfs(renoise=False),
        needs="anacal",
    ),
    Code(
        label="AnaCal FPFS, renoised",
        estimator="anacal",
        prepare=fpfs(renoise=True),
        needs="anacal",
    ),
    Code(label="GalSim HSM KSB", estimator="ksb", prepare=hsm("KSB")),
    Code(label="GalSim HSM REGAUSS", estimator="hsm", prepare=hsm("REGAUSS")),
    Code(
        label="ngmix metacal moments",
        estimator="ngmix",
        prepare=lambda stamps, star: lambda: metacal_moments(stamps, star),
        needs="ngmix",
        few=True,
    ),
)


def metacal_moments(stamps: NoisyStamps, star: np.ndarray) -> list[dict[str, dict[str, object]]]:
    """Return ngmix's weighted moments of each metacalibrated stamp."""
    import ngmix

    rng = np.random.RandomState(stamps.seed % 2**32)
    moments = ngmix.gaussmom.GaussMom(fwhm=METACAL_FWHM)
    boot = ngmix.metacal_bootstrap.MetacalBootstrapper(
        runner=ngmix.runners.Runner(fitter=moments),
        psf_runner=ngmix.runners.PSFRunner(fitter=moments),
        rng=rng,
        psf="fitgauss",
        step=METACAL_STEP,
        types=["noshear", "1p", "1m", "2p", "2m"],
    )
    middle = 0.5 * (star.shape[0] - 1.0)
    psf = ngmix.Observation(
        star,
        weight=np.full_like(star, 1e12),
        jacobian=ngmix.DiagonalJacobian(row=middle, col=middle, scale=1.0),
    )
    results = []
    for pixels, (x, y) in zip(stamps.pixels, stamps.offsets, strict=True):
        place = ngmix.DiagonalJacobian(row=middle + y, col=middle + x, scale=1.0)
        weight = np.full_like(pixels, 1.0 / stamps.variance)
        boot.go(ngmix.Observation(pixels, weight=weight, jacobian=place, psf=psf))
        results.append(boot.get_result())
    return results


def metacal_shear(stamps: NoisyStamps, star: np.ndarray) -> Found:
    """Return the mean shape over its mean response, the shear of metacalibration."""
    found = [
        result
        for result in metacal_moments(stamps, star)
        if all(one["flags"] == 0 for one in result.values())
    ]
    e = np.array([result["noshear"]["e"] for result in found])
    response = np.stack(
        [
            [result[f"{i + 1}p"]["e"][i] - result[f"{i + 1}m"]["e"][i] for result in found]
            for i in (0, 1)
        ],
        axis=-1,
    ) / (2.0 * METACAL_STEP)
    mean = np.mean(response, axis=0)
    g = np.mean(e, axis=0) / mean
    spread = (e - response * g) / mean
    return Found(g=g, sigma_g=float(np.sqrt(np.mean(spread**2))), n_used=len(found))


MORE_ESTIMATORS = {
    "ksb": Estimator(
        text="KSB of GalSim, <g>", measure=lambda s, known: ksb_shear(s, known.psf_images)
    ),
    "anacal-plain": Estimator(
        text="FPFS of AnaCal, noise as it is",
        measure=lambda s, known: fpfs_shear(s, known.psf_images, renoise=False),
    ),
    "ngmix": Estimator(
        text="metacalibration of ngmix",
        measure=lambda s, known: metacal_shear(s, known.psf_images[0]),
    ),
}


def compare(versions: Versions, snr: float, codes: list[Code], options: argparse.Namespace):
    """Return a row for each code, the FFT's time first."""
    sigma = math.sqrt(np.mean(np.sum(versions.stamps**2, axis=(-2, -1)))) / snr
    stamps, _ = noisy_pair(versions, 0, versions.population.n_gal, sigma, [options.seed])
    star = versions.psf_images[0]
    backend = load_backend("numpy")
    cases = []
    for code in codes:
        part = stamps.take(np.arange(METACAL_BATCH)) if code.few else stamps
        cases.append(case_of(code.label, len(part.pixels), code.prepare(part, star)))
    floor = Case(name="FFT", n_gal=len(stamps.pixels), run=fft_of(stamps.pixels, backend, 1))
    with limited_threads(backend, 1):
        first, *timings = time_cases(
            floor, cases, backend=backend, clock=clock_for(backend, 1), seconds=options.seconds
        )
        biases = [bias_of(code, versions, snr, options) for code in codes]
    rows = [
        Row(code=code.label, ours=code.label in fx.__all__, timing=t, bias=b)
        for code, t, b in zip(codes, timings, biases, strict=True)
    ]
    return first, rows


def case_of(name: str, n_gal: int, run: Callable[[], object]) -> Case:
    def whole() -> float:
        run()
        return 1.0

    return Case(name=name, n_gal=n_gal, run=whole)


def bias_of(code: Code, versions: Versions, snr: float, options: argparse.Namespace) -> NoiseBias:
    (found,) = noise_bias(
        versions,
        snr,
        [code.estimator],
        n_stamps=1 if code.few else options.stamps,
        batch=METACAL_BATCH if code.few else BATCH,
        seed=options.seed,
        quiet=False,
    )
    return found


def text_lines(rows: list[Row]) -> Iterator[str]:
    yield (
        f"{'S/N':>5} {'code':<28}{'/ FFT':>7}{'+-':>6}{'us':>8}{'m':>10}{'+-':>8}{'c1':>10}"
        f"{'c2':>10}{'+-':>8}{'sigma_g':>9}{'unused':>9}"
    )
    for row in rows:
        t, b = row.timing, row.bias
        yield (
            f"{b.snr:>5g} {row.code:<28}{t.ratio:>7.3g}{t.ratio_err:>6.1g}{1e6 * t.seconds:>8.0f}"
            f"{b.m:>+10.1e}{b.m_err:>8.0e}{b.c[0]:>+10.1e}{b.c[1]:>+10.1e}{max(b.c_err):>8.0e}"
            f"{b.sigma_g:>9.4f}{b.unused:>9.1e}"
        )


def markdown_lines(rows: list[Row]) -> Iterator[str]:
    yield "| S/N | code | / FFT | m, 10⁻³ | c₁, 10⁻⁵ | c₂, 10⁻⁵ | σ_g of a galaxy | unused |"
    yield "|---|---|---|---|---|---|---|---|"
    for row in rows:
        t, b = row.timing, row.bias
        name = f"`{row.code}`" if row.ours else row.code
        c = " | ".join(
            f"{1e5 * value:+.2f} ± {1e5 * err:.2f}" for value, err in zip(b.c, b.c_err, strict=True)
        )
        yield (
            f"| {b.snr:g} | {name} | {t.ratio:.3g} ± {t.ratio_err:.1g} "
            f"| {1e3 * b.m:+.3f} ± {1e3 * b.m_err:.3f} | {c} | {b.sigma_g:.4f} | {b.unused:.2%} |"
        )


def draw(rows: list[Row]):
    """Draw `|m|` against time, a panel for each S/N; fast and right is at the lower left."""
    snrs = list(dict.fromkeys(row.bias.snr for row in rows))
    with page_style():
        figure = new_figure(1.0 + 5.5 * len(snrs), 4.6)
        panels = figure.subplots(1, len(snrs), sharey=True, squeeze=False)[0]
        for panel, snr in zip(panels, snrs, strict=True):
            panel.axhspan(LEAST_M, TARGET, color=GREEN, alpha=0.10, lw=0, zorder=0)
            shown = [row for row in rows if row.bias.snr == snr]
            for marker, row in zip(MARKERS, shown, strict=False):
                draw_code(panel, row, marker)
            panel.axvline(1.0, color=PALE, lw=1.0)
            panel.set(
                xscale="log",
                xlabel="time of a galaxy / its FFT",
                title=f"S/N {snr:g}",
                xlim=(0.8, 4.0 * max(row.timing.ratio for row in rows)),
            )
            panel.set(yscale="log", ylim=(LEAST_M, 1.0))
        panels[0].set(ylabel="$|m|$   (open: negative)")
        for marker, row in zip(MARKERS, shown, strict=False):
            colour = BLUE if row.ours else ORANGE
            panels[0].plot([], [], marker, ms=7, color=colour, label=row.code)
        figure.legend(ncols=4, loc="outside lower center")
    return figure


def draw_code(panel, row: Row, marker: str) -> None:
    colour = BLUE if row.ours else ORANGE
    m, err = abs(row.bias.m), row.bias.m_err
    shown = min(max(m, 1.3 * LEAST_M), 0.8)
    panel.errorbar(
        row.timing.ratio,
        shown,
        [[min(err, shown - LEAST_M)], [err]],
        fmt=marker,
        ms=7,
        color=colour,
        mfc="white" if row.bias.m < 0 else colour,
        capsize=2,
        lw=1.2,
    )


def main() -> None:
    options = parse()
    if options.json:
        check_json(options.json, overwrite=options.overwrite)
    if options.plot:
        check_figure(options.plot, overwrite=options.overwrite)
    ESTIMATORS.update(MORE_ESTIMATORS)
    codes = [code for code in CODES if code.needs is None or importlib.util.find_spec(code.needs)]
    versions = draw_versions(
        Population(
            kind=options.kind,
            psf_e=options.psf_e,
            radius=options.radius,
            n_gal=options.galaxies,
            stamp_size=options.stamp_size,
        )
    )
    rows: list[Row] = []
    for snr in parse_numbers("--snr", options.snr):
        floor, found = compare(versions, snr, codes, options)
        rows += found
    for line in markdown_lines(rows) if options.markdown else text_lines(rows):
        click.echo(line)
    click.echo(f"\nFFT of a stamp: {1e6 * floor.seconds:.3g} us, {floor.n_rounds} rounds")
    if missing := [code.label for code in CODES if code not in codes]:
        click.echo(f"not installed: {', '.join(missing)}")
    if options.json:
        content = [asdict(row.timing) | {"code": row.code, **row.bias.to_dict()} for row in rows]
        write_json(content, options.json, overwrite=options.overwrite)
    if options.plot:
        save_figure(draw(rows), options.plot, overwrite=options.overwrite)


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--snr", default="200")
    parser.add_argument(
        "--kind", choices=[kind for kind in KINDS if kind != "mixed"], default="exp"
    )
    parser.add_argument("--radius", type=float, default=2.3, help="half-light, pixels")
    parser.add_argument("--psf-e", type=float, default=0.04)
    parser.add_argument("--galaxies", type=int, default=256, help="timed on 4 of each")
    parser.add_argument("--stamp-size", type=int, default=48)
    parser.add_argument("--stamps", type=int, default=8192, help="noisy ones, for each m")
    parser.add_argument("--seconds", type=float, default=30.0, help="of timing, for each S/N")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--markdown", action="store_true", help="print a table for the docs")
    parser.add_argument("--json")
    parser.add_argument("--plot")
    parser.add_argument("--overwrite", action="store_true")
    return parser.parse_args()


if __name__ == "__main__":
    main()
