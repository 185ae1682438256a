"""Time of the steps of `measure_shapes`, beside that of the batched FFT of the same stamps.

    pytest benchmarks/test_bench_kernels.py --benchmark-only

One call of each, on 1,024 stamps: a galaxy needs one transform and division, four or five
evaluations of the tests, and one of their noise. An evaluation holds one look-up in the table of
the weight and three sets of moments at least.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import pytest

import fdnt_xp as fx
from fdnt_xp.app.bench import fft_of
from fdnt_xp.arrays import Array, array_namespace
from fdnt_xp.fourier.transform import deconvolve, mode_phase
from fdnt_xp.nulltests.dogleg import find_root
from fdnt_xp.nulltests.tests import NullTests
from fdnt_xp.shapes.centroid import starting_centroid, wide_weight
from fdnt_xp.shapes.job import Job, prepare


@dataclass(frozen=True, kw_only=True)
class Step:
    """What the steps need of each other, made once."""

    stamps: Array
    job: Job
    inverse_transfer: Array
    tests: NullTests
    start: Array
    solution: Array


@pytest.fixture
def step(library, drawn) -> Step:
    stamps = library.array(drawn.pixels)
    xp = array_namespace(stamps=stamps)
    job = prepare(xp, stamps, fx.Psf.from_image(library.array(drawn.star)), padding=1, max_iter=12)
    inverse_transfer = job.psf.inverse_transfer(job.coarse)
    tests = NullTests(
        grid=job.coarse,
        galaxies=deconvolve(stamps, inverse_transfer, job.coarse),
        weight=job.weight,
        length=job.length,
    )
    start = xp.concat([xp.zeros_like(first := centroid(tests, job)), first / job.length], axis=-1)
    return Step(
        stamps=stamps,
        job=job,
        inverse_transfer=inverse_transfer,
        tests=tests,
        start=start,
        solution=find_root(tests, start).x,
    )


def centroid(tests: NullTests, job: Job) -> Array:
    side = min(job.coarse.shape)
    weight = wide_weight(job.weight, tests.grid, side)
    return starting_centroid(tests.grid, tests.galaxies, weight, job.length, reach=0.5 * side)


@pytest.fixture(autouse=True)
def grouped(benchmark, library, step):
    n_k = int(step.tests.galaxies.re.shape[1])
    benchmark.group = f"{library.name} {library.dtype}, {n_k} modes"


@pytest.fixture
def timed(benchmark, library):
    def time(run: Any) -> None:
        benchmark.pedantic(library.waiting(run), rounds=5, warmup_rounds=1)

    return time


def test_fft(timed, library, step):
    timed(fft_of(step.stamps, library.backend, 1))


def test_fft_and_deconvolve(timed, step):
    timed(lambda: deconvolve(step.stamps, step.inverse_transfer, step.job.coarse))


def test_phase(timed, step):
    x0 = step.job.length * step.solution[:, 2:]
    timed(lambda: mode_phase(step.job.coarse, x0))


def test_table_of_the_weight(timed, step):
    xp = array_namespace(x=step.solution)
    square = xp.zeros_like(step.tests.galaxies.re) + step.job.coarse.squares[0, :]
    shrink = xp.ones_like(step.solution[:, 0])
    timed(lambda: step.job.weight.psf_factor(square, shrink))


def test_moments(timed, step):
    timed(lambda: step.job.coarse.moments(step.tests.galaxies.re, 0, 2, 4))


def test_starting_centroid(timed, step):
    timed(lambda: centroid(step.tests, step.job))


def test_evaluation(timed, step):
    timed(lambda: step.tests.evaluate(step.solution))


def test_dogleg(timed, step):
    timed(lambda: find_root(step.tests, step.start))


def test_noise(timed, step):
    xp = array_namespace(x=step.solution)
    inverse_power = xp.real(step.inverse_transfer) ** 2 + xp.imag(step.inverse_transfer) ** 2
    eta, x0 = step.solution[:, :2], step.job.length * step.solution[:, 2:]
    timed(lambda: step.tests.noise(eta, x0, inverse_power))
