"""Time and memory of `measure_shapes` against the number of galaxies: both should be linear in n.

    python benchmarks/scaling.py                             # to 100,000, in a minute
    python benchmarks/scaling.py --largest 1000000           # needs 4.1 GB for the stamps
    python benchmarks/scaling.py --stamp-size 48 --largest 1000000    # 9.2 GB
    python benchmarks/scaling.py --from-file --stamp-size 48 --largest 1000000

Stamps are float32: 128 galaxies again and again, each with noise of its own. They are held in
memory, or with `--from-file` mapped from a temporary file, for where that does not hold them;
file pages that the system keeps cached are not memory of the process. What is measured is the
one call, from an array to arrays. `work` is the most memory that it holds at a time beyond its
result, as NumPy counts its arrays; the result, 0.1 kB a galaxy, cannot but grow with n.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
import tracemalloc
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import click
import numpy as np

import fdnt_xp as fx
from fdnt_xp.app.backends import load_backend
from fdnt_xp.app.bench import fft_of
from fdnt_xp.app.bench_stamps import make_stamps
from fdnt_xp.app.numbers import check_json, write_json
from fdnt_xp.app.timing import limited_threads
from fdnt_xp.errors import FdntValueError

SMALLEST = 1000
STEPS = (1, 3)
AT_ONCE = 1024
"""Stamps that get their noise together."""


@dataclass(frozen=True, kw_only=True)
class Point:
    """What one call took.

    Parameters
    ----------
    n_gal : int
    seconds, fft_seconds : float
        CPU time of a galaxy, and of its FFT.
    work_bytes, result_bytes : int
        Most memory beyond the result; the result.
    used : float
        Fraction that was measured.
    """

    n_gal: int
    seconds: float
    fft_seconds: float
    work_bytes: int
    result_bytes: int
    used: float


def numbers(largest: int) -> list[int]:
    """Return 1, 3, 10, 30, ... thousand, and the largest."""
    steps = (SMALLEST * 10**power * step for power in range(7) for step in STEPS)
    return [*(n for n in steps if n < largest), largest]


@contextmanager
def stamps_array(n_gal: int, size: int, *, from_file: bool) -> Iterator[np.ndarray]:
    """Give an array for stamps, in memory or in a temporary file."""
    if not from_file:
        needed = 4 * n_gal * size**2
        if hasattr(os, "sysconf") and "SC_AVPHYS_PAGES" in os.sysconf_names:
            there = os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
            if needed > 0.8 * there:
                raise FdntValueError(
                    f"{n_gal} stamps are {needed / 1e9:.1f} GB, and {there / 1e9:.1f} GB are free: "
                    "use --from-file, smaller stamps, or fewer"
                )
        yield np.empty((n_gal, size, size), dtype=np.float32)
        return
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "stamps"
        stamps = np.memmap(path, dtype=np.float32, mode="w+", shape=(n_gal, size, size))
        yield stamps
        del stamps


def fill(stamps: np.ndarray, seed: int) -> tuple[np.ndarray, float]:
    """Draw galaxies and noise; return the star and the variance of the noise."""
    drawn = make_stamps(128, stamps.shape[-1], 1e4, seed=seed)
    sigma = 50.0 * drawn.variance**0.5  # S/N 200
    rng = np.random.default_rng(seed)
    for first in range(0, len(stamps), AT_ONCE):
        part = stamps[first : first + AT_ONCE]
        part[:] = sigma * rng.standard_normal(part.shape, dtype=np.float32)
        rows = (first + np.arange(len(part))) % len(drawn.pixels)
        part += drawn.pixels[rows].astype(np.float32)
    return drawn.star, sigma**2


def measure(stamps: np.ndarray, psf: fx.Psf, variance: float) -> Point:
    """Time one call, with its memory counted, which costs a per cent or two."""
    fft = fft_of(stamps, load_backend(), 1)
    start = time.process_time()
    fft()
    middle = time.process_time()
    tracemalloc.start()
    shapes = fx.measure_shapes(stamps, psf, noise_variance=variance)
    end = time.process_time()
    held, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    return Point(
        n_gal=len(stamps),
        seconds=(end - middle) / len(stamps),
        fft_seconds=(middle - start) / len(stamps),
        work_bytes=peak - held,
        result_bytes=held,
        used=float(np.mean(shapes.measured)),
    )


def text_line(point: Point) -> str:
    return (
        f"{point.n_gal:>9,}{1e6 * point.seconds:>9.1f}{point.seconds / point.fft_seconds:>8.1f}"
        f"{1e-6 * point.work_bytes:>9.1f}{1e-6 * point.result_bytes:>11.1f}{point.used:>9.2%}"
    )


def markdown_line(point: Point) -> str:
    return (
        f"| {point.n_gal:,} | {1e6 * point.seconds:.0f} | {point.seconds / point.fft_seconds:.3g} "
        f"| {1e-6 * point.work_bytes:.0f} | {1e-6 * point.result_bytes:.1f} |"
    )


TEXT_HEAD = (
    f"{'galaxies':>9}{'us each':>9}{'/ FFT':>8}{'work MB':>9}{'result MB':>11}{'measured':>9}"
)
MARKDOWN_HEAD = "| galaxies | µs each | / FFT | work, MB | result, MB |\n|---|---|---|---|---|"


def main() -> None:
    options = parse()
    if options.json:
        check_json(options.json, overwrite=options.overwrite)
    shown = (MARKDOWN_HEAD, markdown_line) if options.markdown else (TEXT_HEAD, text_line)
    head, line = shown
    points: list[Point] = []
    with (
        limited_threads(load_backend(), 1),
        stamps_array(options.largest, options.stamp_size, from_file=options.from_file) as stamps,
    ):
        star, variance = fill(stamps, seed=3)
        psf = fx.Psf.from_image(star.astype(np.float32))
        fx.measure_shapes(stamps[:SMALLEST], psf, noise_variance=variance)  # makes the tables
        click.echo(head)
        for n_gal in numbers(options.largest):
            points.append(measure(stamps[:n_gal], psf, variance))
            click.echo(line(points[-1]))
    if options.json:
        write_json([asdict(point) for point in points], options.json, overwrite=options.overwrite)


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--largest", type=int, default=100_000, help="number of galaxies")
    parser.add_argument("--stamp-size", type=int, default=32)
    parser.add_argument("--from-file", action="store_true", help="map the stamps from a file")
    parser.add_argument("--markdown", action="store_true", help="print a table for the docs")
    parser.add_argument("--json")
    parser.add_argument("--overwrite", action="store_true")
    return parser.parse_args()


if __name__ == "__main__":
    main()
