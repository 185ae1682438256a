"""Time of the measurements, beside that of one batched FFT of the same stamps.

    make bench

Read ratios within one run; absolute times mean nothing elsewhere. `extra_info` says what
the time bought: the fraction measured and the median number of evaluations.
"""

from __future__ import annotations

import numpy as np
import pytest

import fdnt_xp as fx
from fdnt_xp.arrays import to_numpy

NOISE_VARIANCE = 1000.0**2


@pytest.fixture
def stamps(field, library):
    return library.array(field[0])


@pytest.fixture
def psf(field, library):
    return fx.Psf.from_image(library.array(field[1]))


@pytest.fixture(autouse=True)
def grouped(benchmark, library):
    """Compare what runs on one library in one precision."""
    benchmark.group = f"{library.name} {library.dtype}"


def test_fft(benchmark, library, stamps):
    xp = library.xp
    benchmark.extra_info.update(n_gal=stamps.shape[0])
    benchmark(library.waiting(lambda: xp.fft.rfftn(stamps, axes=(-2, -1))))


def test_psf(benchmark, library, field):
    star = library.array(field[1])
    benchmark(library.waiting(lambda: fx.Psf.from_image(star)))


def test_measure_shapes(benchmark, library, stamps, psf):
    run = library.waiting(lambda: fx.measure_shapes(stamps, psf, noise_variance=NOISE_VARIANCE))
    shapes = benchmark(run)
    benchmark.extra_info.update(
        n_gal=shapes.n_gal,
        measured=float(np.mean(to_numpy(shapes.measured))),
        median_evaluations=float(np.median(to_numpy(shapes.n_iter))),
    )


@pytest.mark.parametrize("statistic", ["frozen", "eta"])
def test_population_null(benchmark, library, stamps, psf, statistic):
    run = library.waiting(lambda: fx.population_null(stamps, psf, statistic=statistic))
    estimate = benchmark.pedantic(run, rounds=3, warmup_rounds=1)
    benchmark.extra_info.update(n_gal=stamps.shape[0], used=estimate.n_used)
