"""Time of the measurements, beside that of the FFT of the same stamps, 64 of them at a time.

    make bench
    pytest benchmarks/test_bench_shapes.py --benchmark-only --every-scene

Read ratios within one group; absolute times mean nothing elsewhere. `extra_info` says what
the time bought: the fraction measured and the median number of evaluations. Stamp size, batch
and S/N are changed one at a time, or all together with `--every-scene`.
"""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np
import pytest

import fdnt_xp as fx
from conftest import CELL, N_GAL, scene_of
from fdnt_xp.app.bench import FEW, fft_of
from fdnt_xp.arrays import to_numpy


class Scene(NamedTuple):
    """What is measured."""

    size: int = CELL
    n_gal: int = N_GAL
    snr: float = 200.0


SIZES, BATCHES, SNRS = (32, 48, 64, 96), (64, N_GAL, 8 * N_GAL), (200.0, 20.0)
ONE_AT_A_TIME = list(
    dict.fromkeys(
        [
            *(Scene(size=size) for size in SIZES),
            *(Scene(n_gal=n_gal) for n_gal in BATCHES),
            *(Scene(snr=snr) for snr in SNRS),
        ]
    )
)


def pytest_generate_tests(metafunc):
    if "scene" in metafunc.fixturenames:
        every = metafunc.config.getoption("--every-scene")
        scenes = [Scene(*one) for one in product(SIZES, BATCHES, SNRS)] if every else ONE_AT_A_TIME
        names = [f"{scene.size}px-{scene.n_gal}-snr{scene.snr:g}" for scene in scenes]
        metafunc.parametrize("scene", scenes, ids=names)


@pytest.fixture
def stamps(library, scene):
    drawn = scene_of(scene.n_gal, scene.size, scene.snr)
    return library.array(drawn.pixels), library.array(drawn.star), drawn.variance


@pytest.fixture(autouse=True)
def grouped(benchmark, request, library):
    """Compare what runs on one library in one precision, on the same stamps."""
    scene = request.getfixturevalue("scene") if "scene" in request.fixturenames else Scene()
    name = f"{library.name} {library.dtype}"
    benchmark.group = f"{name}, {scene.n_gal} of {scene.size} px, S/N {scene.snr:g}"
    benchmark.extra_info.update(scene._asdict(), device=library.backend.device)


@pytest.fixture
def base(library, drawn):
    """Stamps, PSF and the variance of the noise, of what is changed."""
    return library.array(drawn.pixels), fx.Psf.from_image(library.array(drawn.star)), drawn.variance


def timed(benchmark, library, run, rounds=3):
    return benchmark.pedantic(library.waiting(run), rounds=rounds, warmup_rounds=1)


def test_fft(benchmark, library, stamps):
    timed(benchmark, library, fft_of(stamps[0], library.backend, 1), rounds=9)


def test_measure_shapes(benchmark, library, stamps):
    pixels, star, variance = stamps
    psf = fx.Psf.from_image(star)
    run = lambda: fx.measure_shapes(pixels, psf, noise_variance=variance)  # noqa: E731
    shapes = timed(benchmark, library, run)
    benchmark.extra_info.update(
        measured=float(np.mean(to_numpy(shapes.measured))),
        median_evaluations=float(np.median(to_numpy(shapes.n_iter))),
    )


@pytest.mark.parametrize("statistic", ["frozen", "eta"])
def test_population_null(benchmark, library, base, statistic):
    pixels, psf, variance = base
    options = {"noise_variance": variance, "statistic": statistic}
    estimate = timed(benchmark, library, lambda: fx.population_null(pixels, psf, **options))
    benchmark.extra_info.update(used=estimate.n_used)


def test_responses(benchmark, library, base):
    pixels, psf, variance = base
    timed(benchmark, library, lambda: fx.measure_responses(pixels, psf, noise_variance=variance))


def test_few_by_gauss_laguerre(benchmark, library, base):
    """Of FEW galaxies: times N_GAL/FEW to compare with the others of the group."""
    pixels, psf, variance = base
    options = {"noise_variance": variance, "transform": "gl"}
    timed(benchmark, library, lambda: fx.measure_shapes(pixels[:FEW], psf, **options))
    benchmark.extra_info.update(n_gal=FEW)
