"""What `fdnt-xp bench` does: times the measurements beside one batched FFT of the same stamps."""

from __future__ import annotations

import platform
import warnings
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import scipy.fft

import fdnt_xp
from fdnt_xp.app.backends import Backend, load_backend
from fdnt_xp.app.bench_stamps import BenchStamps, make_stamps
from fdnt_xp.app.chunks import CHUNK_ON_CPU, CHUNK_ON_GPU
from fdnt_xp.app.numbers import check_json, write_json
from fdnt_xp.app.prefetch import prepared_ahead
from fdnt_xp.app.timing import (
    Case,
    Clock,
    Timing,
    check_threads,
    clock_for,
    cores,
    limited_threads,
    time_cases,
)
from fdnt_xp.arrays import Array, array_namespace, to_numpy
from fdnt_xp.errors import FdntWarning
from fdnt_xp.fourier.psf import Psf
from fdnt_xp.shapes.measure import measure_shapes
from fdnt_xp.shears.population import population_null
from fdnt_xp.shears.responses import measure_responses

FFT_BLOCK: Final = 64
"""Stamps that the floor transforms at a time on a CPU, whose cache they fit."""
FEW: Final = 64
"""Galaxies, at most, with a Gauss-Laguerre fit, which takes long for each."""
MANY_PSFS: Final = 1024
"""Galaxies, at most, with a PSF each."""
ON_CPU, ON_GPU = 1024, 65_536
"""Galaxies, unless told otherwise."""


@dataclass(frozen=True, kw_only=True)
class BenchOptions:
    """What to time, by the options of the command line."""

    backend: str = "numpy"
    device: str | None = None
    dtype: str = "float64"
    threads: int = 1
    n: int | None = None
    stamp_size: int = 48
    snr: float = 200.0
    seconds: float = 40.0


@dataclass(frozen=True, kw_only=True)
class Bench:
    """What was timed, and where.

    Parameters
    ----------
    options : BenchOptions
    n_gal : int
    stamps, clock, machine, library : str
        What drew the stamps; the kind of time; processor; array library and device.
    remark : str or None
        On threads that could not be chosen.
    timings : list of Timing
        The first is the floor.
    """

    options: BenchOptions
    n_gal: int
    stamps: str
    clock: str
    machine: str
    library: str
    remark: str | None
    timings: list[Timing]

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain Python."""
        return {"version": fdnt_xp.__version__, **asdict(self)}


def run_bench(
    options: BenchOptions, output: str | None, *, markdown: bool, overwrite: bool
) -> Iterator[str]:
    """Time everything, write the numbers if they are wanted, yield the lines of the report."""
    if output is not None:
        check_json(output, overwrite=overwrite)
    bench = run_cases(options)
    yield from markdown_lines(bench) if markdown else text_lines(bench)
    if output is not None:
        write_json(bench.to_dict(), output, overwrite=overwrite)
        yield f"written    {output}"


def run_cases(options: BenchOptions) -> Bench:
    """Draw stamps and time everything on them.

    Raises
    ------
    MissingExtraError
        If the library is not installed.
    FdntValueError
        If the device is not there, there are more threads than cores, or a number is out of
        range.
    """
    check_threads(options.threads)
    backend = load_backend(options.backend, options.device, options.dtype)
    n_gal = options.n if options.n is not None else ON_CPU if backend.on_cpu else ON_GPU
    stamps = make_stamps(n_gal, options.stamp_size, options.snr)
    with limited_threads(backend, options.threads) as remark, warnings.catch_warnings():
        # About the shears, which are not looked at.
        warnings.simplefilter("ignore", FdntWarning)
        floor, cases = make_cases(stamps, backend, options.threads)
        clock: Clock = clock_for(backend, options.threads)
        timings = time_cases(floor, cases, backend=backend, clock=clock, seconds=options.seconds)
    return Bench(
        options=options,
        n_gal=n_gal,
        stamps=stamps.origin,
        clock=clock.name,
        machine=f"{_processor()}, {cores()} cores",
        library=f"{backend.library} {backend.version}, {backend.device}, {backend.dtype}",
        remark=remark,
        timings=timings,
    )


def make_cases(stamps: BenchStamps, backend: Backend, threads: int) -> tuple[Case, list[Case]]:
    """Return the floor, and what is compared with it; nearly all take arrays on the device.

    "From host memory" the stamps come in the chunks of `fdnt-xp measure`, of which the next is
    copied while one is measured.
    """
    pixels = backend.from_numpy(stamps.pixels)
    n_gal = len(stamps.pixels)
    few = min(n_gal, FEW)
    chunk = CHUNK_ON_CPU if backend.on_cpu else CHUNK_ON_GPU
    psf = Psf.from_image(backend.from_numpy(stamps.star))
    many = min(n_gal, MANY_PSFS)
    stars = backend.from_numpy(np.broadcast_to(stamps.star, (many, *stamps.star.shape)))
    psfs = Psf.from_image(stars)
    noise: dict[str, Any] = {"noise_variance": stamps.variance}

    def shapes(n: int, psf: Psf, **options: Any) -> Case:
        part = pixels[:n]
        return Case(
            name="",
            n_gal=n,
            run=lambda: _fraction(measure_shapes(part, psf, **noise, **options).measured),
        )

    def null(**options: Any) -> Case:
        def run() -> float:
            return population_null(pixels, psf, **noise, **options).n_used / n_gal

        return Case(name="", n_gal=n_gal, run=run)

    def from_host() -> float:
        parts = [stamps.pixels[first : first + chunk] for first in range(0, n_gal, chunk)]
        used = [
            (len(part), _fraction(measure_shapes(part, psf, **noise).measured))
            for part in prepared_ahead(parts, backend.upload)
        ]
        return sum(n * fraction for n, fraction in used) / n_gal

    named = {
        "measure_shapes": shapes(n_gal, psf),
        "  from host memory": Case(name="", n_gal=n_gal, run=from_host),
        "  a PSF for each": shapes(many, psfs),
        "  transform=gl": shapes(few, psf, transform="gl"),
        "Psf.from_image for each": Case(
            name="", n_gal=many, run=lambda: _fraction(Psf.from_image(stars).usable)
        ),
        "population_null": null(),
        "  isotropise=False": null(isotropise=False),
        "  statistic=eta": null(statistic="eta"),
        "measure_responses": Case(
            name="",
            n_gal=n_gal,
            run=lambda: _fraction(measure_responses(pixels, psf, **noise).flags == 0),
        ),
    }
    cases = [replace(case, name=name) for name, case in named.items()]
    return Case(name="FFT", n_gal=n_gal, run=fft_of(pixels, backend, threads)), cases


def fft_of(pixels: Array, backend: Backend, threads: int) -> Callable[[], float]:
    """Return the transform of all stamps, by the fastest that the library has."""
    xp = array_namespace(pixels=pixels)
    n_gal = int(pixels.shape[0])
    block = FFT_BLOCK if backend.on_cpu else n_gal

    def transform(part: Array) -> Array:
        if backend.library == "numpy":
            return scipy.fft.rfft2(part, workers=threads)
        return xp.fft.rfftn(part, axes=(-2, -1))

    def run() -> float:
        for first in range(0, n_gal, block):
            last = transform(pixels[first : first + block])
        # A host read: on a device nothing is done before.
        return float(np.all(np.isfinite(to_numpy(last[:1, 0, 0]))))

    return run


def text_lines(bench: Bench) -> Iterator[str]:
    """Yield the report for a terminal."""
    yield from (f"{name:<10} {text}" for name, text in _facts(bench).items())
    yield ""
    yield (
        f"{'what':<26}{'/ FFT':>8}{'+-':>7}{'us/galaxy':>11}{'galaxies/s':>12}"
        f"{'memory':>10}{'used':>8}"
    )
    for row in map(_cells, bench.timings):
        name, ratio, err, per_galaxy, rate, memory, used = row
        yield f"{name:<26}{ratio:>8}{err:>7}{per_galaxy:>11}{rate:>12}{memory:>10}{used:>8}"


def markdown_lines(bench: Bench) -> Iterator[str]:
    """Yield the report for a page of documentation."""
    facts = _facts(bench)
    yield f"{facts['library']}, {facts['threads']}; {facts['stamps']}; {facts['time']}:"
    yield ""
    yield "| what | / FFT | ± | µs a galaxy | galaxies/s | memory | used |"
    yield "|---|---|---|---|---|---|---|"
    for timing in bench.timings:
        name, *numbers = _cells(timing)
        yield f"| {name.replace('  ', '… ')} | {' | '.join(numbers)} |"


def _facts(bench: Bench) -> dict[str, str]:
    options = bench.options
    threads = "one thread" if options.threads == 1 else f"{options.threads} threads"
    if bench.remark:
        threads += f" ({bench.remark})"
    size = options.stamp_size
    rounds = "one round" if (n := bench.timings[0].n_rounds) == 1 else f"median of {n} rounds"
    return {
        "machine": bench.machine,
        "library": bench.library,
        "threads": threads,
        "stamps": f"{bench.n_gal} of {size} x {size} pixels, S/N {options.snr:g}, {bench.stamps}",
        "time": f"{bench.clock}, {rounds}, each beside an FFT of the same stamps",
    }


def _cells(timing: Timing) -> tuple[str, ...]:
    """Return name, ratio, its error, time of a galaxy, galaxies per second, memory, used."""
    per_galaxy = timing.seconds
    memory = "-" if timing.peak_bytes is None else f"{timing.peak_bytes / 1e6:.0f} MB"
    return (
        timing.name,
        _three_digits(timing.ratio),
        f"{timing.ratio_err:.1g}",
        _three_digits(1e6 * per_galaxy),
        f"{_two_digits(1.0 / per_galaxy):,}" if per_galaxy > 0 else "-",
        memory,
        f"{timing.used:.2%}",
    )


def _three_digits(value: float) -> str:
    """Return a positive number without an exponent."""
    return f"{value:.3g}" if value < 999.5 else f"{value:,.0f}"


def _two_digits(value: float) -> int:
    """Return a number rounded to two digits: the next run has other ones beyond."""
    return int(float(f"{value:.2g}"))


def _fraction(where: Array) -> float:
    """Return the fraction that is true; reads it on the host, so that it is done by then."""
    return float(np.mean(to_numpy(where)))


def _processor() -> str:
    """Return the model of the processor where Linux tells it, else its kind."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.processor() or platform.machine()
