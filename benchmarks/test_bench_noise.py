"""Time of shear from faint galaxies, beside that of the batched FFT of the same stamps.

    make bench

The large sample is what a survey has: its search begins with a part of it, and reads the
whole twice. FFT and null go through it in the same chunks.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

import fdnt_xp as fx
from conftest import CELL, N_GAL
from fdnt_xp.data.simulate import NOISE_SIGMA

SNR = 15.0
LARGE, CHUNK = 96 * N_GAL, 512


@pytest.fixture(scope="session")
def faint(field):
    """Stamps at S/N 15 and the variance of a pixel."""
    galaxies = field[0] * (SNR / 200.0)  # with a trace of the noise at S/N 200
    noise = NOISE_SIGMA * np.random.default_rng(0).standard_normal(galaxies.shape)
    return galaxies + noise, NOISE_SIGMA**2 * (1.0 + (SNR / 200.0) ** 2)


@pytest.fixture
def psf(field, library):
    return fx.Psf.from_image(library.array(field[1]))


@pytest.fixture(autouse=True)
def grouped(benchmark, request, library):
    size = "large" if "large" in request.node.name else "small"
    benchmark.group = f"{library.name} {library.dtype} {size}"


def test_fft(benchmark, library, faint):
    stamps, xp = library.array(faint[0]), library.xp
    benchmark(library.waiting(lambda: xp.fft.rfftn(stamps, axes=(-2, -1))))


@pytest.mark.parametrize("isotropise", [True, False], ids=["round", "plain"])
def test_null(benchmark, library, faint, psf, isotropise):
    stamps = library.array(faint[0])
    options = {"noise_variance": faint[1], "isotropise": isotropise}
    run = library.waiting(lambda: fx.population_null(stamps, psf, **options))
    estimate = benchmark.pedantic(run, rounds=5, warmup_rounds=1)
    benchmark.extra_info.update(n_gal=N_GAL, used=estimate.n_used)


def test_responses(benchmark, library, faint, psf):
    stamps = library.array(faint[0])
    run = library.waiting(lambda: fx.measure_responses(stamps, psf, noise_variance=faint[1]))
    result = benchmark.pedantic(run, rounds=5, warmup_rounds=1)
    benchmark.extra_info.update(n_gal=result.n_gal)


@pytest.fixture(scope="session")
def large(field, faint):
    rng = np.random.default_rng(1)
    stamps = np.empty((LARGE, CELL, CELL))
    for first in range(0, LARGE, N_GAL):
        noise = NOISE_SIGMA * rng.standard_normal(field[0].shape)
        stamps[first : first + N_GAL] = field[0] * (SNR / 200.0) + noise
    return stamps, faint[1]


def only_numpy_float64(library):
    if (library.name, library.dtype) != ("numpy", "float64"):
        pytest.skip("the large sample is timed on NumPy")


def test_large_fft(benchmark, library, large):
    only_numpy_float64(library)

    def run():
        for first in range(0, LARGE, CHUNK):
            np.fft.rfftn(large[0][first : first + CHUNK], axes=(-2, -1))

    benchmark.pedantic(run, rounds=3, warmup_rounds=1)


def test_large_null(benchmark, library, large, psf):
    only_numpy_float64(library)
    options = {"noise_variance": large[1], "chunk_size": CHUNK}
    estimate = benchmark.pedantic(
        lambda: fx.population_null(large[0], psf, **options), rounds=1, warmup_rounds=0
    )
    benchmark.extra_info.update(n_gal=LARGE, error=math.hypot(*map(float, estimate.g_err)))
