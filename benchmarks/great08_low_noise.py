"""GREAT08 simulated, measured and scored: figures of docs/great08.md.

    python benchmarks/great08_low_noise.py DIR                  # all: hours, 15 GB in DIR
    python benchmarks/great08_low_noise.py DIR --part cells     # three seeds, 64 and 40 px
    python benchmarks/great08_low_noise.py DIR --part methods   # every method of shapes
    python benchmarks/great08_low_noise.py DIR --seeds 1 --sets 2 --grid 20   # a quick look

Nothing is told to the measurement but the images and the star. Images, catalogs and
`results.json` stay in DIR, and an interrupted run goes on where it was.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import os
import platform
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

import fdnt_xp
from fdnt_xp.app.great08_measure import ESTIMATORS, MeasureOptions, shear_from_catalog
from fdnt_xp.app.great08_run import MeasureReport, measure_challenge
from fdnt_xp.app.great08_simulate import run_simulate
from fdnt_xp.app.numbers import write_json
from fdnt_xp.data.catalog import read_catalog
from fdnt_xp.data.simulate import (
    NOISE_SIGMA,
    PSF_BETA,
    PSF_FWHM,
    PSF_G,
    PSF_TRUNCATION,
    great08_image,
)
from fdnt_xp.great08.answers import Answers, match_answers, pooled
from fdnt_xp.great08.moffat import MoffatPsf
from fdnt_xp.great08.score import Score, score_answers
from fdnt_xp.great08.sets import Simulation, make_simulation
from fdnt_xp.great08.submission import read_submission
from fdnt_xp.great08.truth import read_truth

METHODS = (
    "fdnt-ft",
    "fdnt-gl",
    "nb07-8",
    "nb07-12",
    "gauss-1",
    "gauss-2",
    "gauss-3",
    "gauss-4",
    "exponential",
    "devaucouleurs",
)
STAR = 4
"""Pixels of the star in a pixel, for the part truncation."""
PARTS = ("cells", "estimators", "methods", "real-noise", "truncation", "responsivity")


@dataclass(frozen=True, kw_only=True)
class Entry:
    """One line of a table: simulations that are measured alike, and scored together."""

    name: str
    simulations: tuple[Simulation, ...]
    estimators: tuple[str, ...]
    method: str = "fdnt-ft"


def entries(args: argparse.Namespace) -> Iterator[Entry]:
    """Yield what there is to do."""
    if "cells" in args.part:
        for cell in args.cells:
            yield Entry(
                name=f"cells of {cell}",
                simulations=low_noise(args, cell, 100, args.seeds),
                estimators=("null", "responsivity"),
            )
    if "estimators" in args.part:
        yield Entry(
            name="every estimator",
            simulations=low_noise(args, 64, 30, args.seeds[:1]),
            estimators=tuple(ESTIMATORS),
        )
    if "methods" in args.part:
        for method in METHODS:
            yield Entry(
                name=f"method {method}",
                simulations=low_noise(args, 64, 30, args.seeds[:1]),
                estimators=("responsivity",),
                method=method,
            )
    if "real-noise" in args.part:
        for snr in (20.0, 10.0):
            size = {"cell": 64, "grid": args.grid or 30, "snr": snr}
            size["n_sets"] = args.sets
            drawn = make_simulation("real-noise", seed=args.seeds[0], **size)
            yield Entry(
                name=f"RealNoise, S/N {snr:g}",
                simulations=(drawn,),
                estimators=tuple(ESTIMATORS),
            )


def low_noise(
    args: argparse.Namespace, cell: int, grid: int, seeds: list[int]
) -> tuple[Simulation, ...]:
    """Return simulations of LowNoise that differ by their seed."""
    size = {"cell": cell, "grid": args.grid or grid, "n_sets": args.sets}
    return tuple(make_simulation("low-noise", seed=seed, **size) for seed in seeds)


def folder_of(directory: Path, simulation: Simulation) -> Path:
    """Return where a simulation is kept."""
    one = simulation
    return directory / f"{one.branch}-snr{one.snr:g}-{one.grid}x{one.cell}px-seed{one.seed}"


def output_of(folder: Path, method: str, estimators: tuple[str, ...]) -> Path:
    """Return where what was measured is kept."""
    return folder.with_name(f"{folder.name}-{method}-{'-'.join(estimators)}")


def measured(directory: Path, simulation: Simulation, entry: Entry, jobs: int) -> MeasureReport:
    """Draw and measure a simulation, as far as that is not done."""
    folder = folder_of(directory, simulation)
    for line in run_simulate(str(folder), simulation, jobs=jobs):
        print(" ", line, flush=True)
    options = MeasureOptions(method=entry.method, estimators=entry.estimators)
    output = output_of(folder, entry.method, entry.estimators)
    report = measure_challenge(folder, output, options, jobs=jobs, quiet=False)
    if report.failures:
        raise SystemExit(f"{folder}: {report.failures}")
    return report


def answers_of(report: MeasureReport, estimator: str) -> Answers:
    """Return what an estimator said, beside the truth."""
    submission = read_submission(report.folder / "submission.ecsv")
    return match_answers(
        submission, read_truth(report.challenge.directory / "truth.ecsv"), estimator
    )


def result(entry: Entry, reports: list[MeasureReport]) -> dict[str, Any]:
    """Return the scores of an entry, all seeds pooled and each alone."""
    results = [one for report in reports for one in report.results]
    n_gal = sum(one.n_gal for one in results)
    scores = {}
    for estimator in entry.estimators:
        runs = [answers_of(report, estimator) for report in reports]
        used = [
            shear.n_used for one in results for shear in one.shears if shear.estimator == estimator
        ]
        score = score_answers(pooled(runs))
        say(f"{entry.name}, {estimator}", score, sum(used) / n_gal)
        scores[estimator] = {
            "pooled": score.to_dict(),
            "q_of_each_seed": [score_answers(run).q for run in runs],
            "used": sum(used) / n_gal,
        }
    return {
        "galaxies_of_a_set": results[0].n_gal,
        "sets": len(results),
        "measured": sum(one.n_measured for one in results) / n_gal,
        "seconds_per_galaxy": sum(one.seconds for one in results) / n_gal,
        "scores": scores,
        "versions": versions(),
    }


def say(what: str, score: Score, used: float) -> None:
    """Print a line of a table."""
    floor = score.best_floor
    biases = "  ".join(
        f"m{i} = {1e3 * fit.m:+.2f} ± {1e3 * fit.m_scatter:.2f}  c{i} = {1e4 * fit.c:+.2f} ± "
        f"{1e4 * fit.c_scatter:.2f}"
        for i, fit in enumerate(score.fits, 1)
    )
    beside = "no floor"
    if floor is not None:
        low, high = floor.ratio_range
        beside = f"floor {floor.q:.0f}, RMS/floor {floor.ratio:.3f} ({low:.2f} to {high:.2f})"
    print(f"{what:34} Q {score.q:.0f}, {beside}  {biases} (e-3, e-4)  used {used:.4f}", flush=True)


def truncation() -> None:
    """Print the bias that the edge of the cells makes, on galaxies without noise."""
    n, g = 30, 0.03
    for cell in (40, 48, 64, 96):
        found: dict[str, list[float]] = {"null": [], "responsivity": []}
        for shear in (g, -g):
            drawn = great08_image(n_x=n, n_y=n, cell=cell, shear=(shear, 0.0), snr=None, seed=5)
            stamps = drawn.image.reshape(n, cell, n, cell).transpose(0, 2, 1, 3)
            stamps = stamps.reshape(n * n, cell, cell)
            # A star in pixels as large as those of the galaxies has m = -2e-4 of its own.
            star = MoffatPsf(beta=PSF_BETA, fwhm=PSF_FWHM, g=PSF_G, trunc=PSF_TRUNCATION * PSF_FWHM)
            psf = fdnt_xp.Psf.from_image(star.draw(cell, STAR), oversampling=STAR)
            null = fdnt_xp.population_null(
                stamps, psf, noise_variance=NOISE_SIGMA**2, isotropise=False
            )
            shapes = fdnt_xp.measure_shapes(stamps, psf)
            found["null"].append(float(null.g[0]))
            found["responsivity"].append(
                float(fdnt_xp.shear_from_shapes(shapes, "lorentzian").g[0])
            )
        m = {name: (plus - minus) / (2.0 * g) - 1.0 for name, (plus, minus) in found.items()}
        print(f"cells of {cell}, no noise: " + ", ".join(f"{k} m = {v:+.1e}" for k, v in m.items()))


def responsivity(directory: Path, simulations: tuple[Simulation, ...]) -> None:
    """Print RMS over floor of other responsivities, from the catalogs of the part "cells"."""
    for weight in ("uniform", "lorentzian"):
        for orientations in (True, False):
            squares, floors = [], []
            for simulation in simulations:
                folder = folder_of(directory, simulation)
                truth = read_truth(folder / "truth.ecsv")
                output = output_of(folder, "fdnt-ft", ("null", "responsivity"))
                for row in truth:
                    catalog = read_catalog(output / "catalogs" / f"set{row['set']:04d}.fits")
                    found = shear_from_catalog(catalog, weight, orientations=orientations)
                    squares.append((found.g - np.array([row["g1"], row["g2"]])) ** 2)
                    floors.append(found.g_err_noise**2)
            ratio = np.sqrt(np.mean(squares) / np.mean(floors))
            print(f"responsivity, {weight}, orientations={orientations}: RMS/floor {ratio:.2f}")


def versions() -> dict[str, str]:
    """Return what made the numbers."""
    names = ("numpy", "scipy", "galsim", "astropy")
    return {
        "fdnt_xp": fdnt_xp.__version__,
        "python": platform.python_version(),
        **{name: importlib.metadata.version(name) for name in names},
    }


def main() -> None:
    """Do all entries that are not in the file of results."""
    lines = (__doc__ or "").splitlines()
    parser = argparse.ArgumentParser(
        description="\n".join(lines), formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("directory", type=Path)
    parser.add_argument("--part", choices=PARTS, action="append", help="[default: all]")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--cells", type=int, nargs="+", default=[64, 40], help="of the part cells")
    parser.add_argument("--sets", type=int, help="of each simulation [default: 15, RealNoise 27]")
    parser.add_argument("--grid", type=int, help="cells on a side [default: 100, or 30 by part]")
    parser.add_argument("--jobs", type=int, default=1)
    args = parser.parse_args()
    args.part = args.part or list(PARTS)
    args.directory.mkdir(parents=True, exist_ok=True)
    path = args.directory / "results.json"
    for entry in entries(args):
        print(entry.name, flush=True)
        reports = [measured(args.directory, one, entry, args.jobs) for one in entry.simulations]
        found = json.loads(path.read_text()) if path.exists() else {}
        found[entry.name] = result(entry, reports)
        write_json(found, str(path), overwrite=True)
    if "truncation" in args.part:
        truncation()
    if "responsivity" in args.part:
        responsivity(args.directory, low_noise(args, 64, 100, args.seeds))


if __name__ == "__main__":
    main()
