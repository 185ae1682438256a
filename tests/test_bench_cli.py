"""The command that times measurements: what it times, what it prints, what it refuses."""

from __future__ import annotations

import builtins
import importlib.util
import json
import time

import numpy as np
import pytest
from click.testing import CliRunner

import fdnt_xp as fx
from fdnt_xp.app import bench_stamps, timing
from fdnt_xp.app.backends import load_backend
from fdnt_xp.app.bench import FFT_BLOCK, fft_of
from fdnt_xp.app.bench_stamps import make_stamps
from fdnt_xp.app.cli import main
from fdnt_xp.app.timing import Case, Clock, check_threads, clock_for, cores, limited_threads
from fdnt_xp.errors import FdntValueError, RangeError

NUMPY = load_backend()
WALL = Clock(name="wall time", now=time.perf_counter)


@pytest.fixture
def without_galsim(monkeypatch):
    found = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: None if name == "galsim" else found(name)
    )


def run(*arguments, code=0):
    result = CliRunner().invoke(main, ["bench", *map(str, arguments)])
    assert result.exit_code == code, result.output
    assert "Traceback" not in result.output
    return result.output


# --- the command ------------------------------------------------------------------------


def test_table_and_numbers(without_galsim, tmp_path):
    output = tmp_path / "bench.json"
    printed = run("--n", 12, "--stamp-size", 32, "--seconds", 0, "-o", output)
    content = json.loads(output.read_text())
    names = [row["name"].strip() for row in content["timings"]]
    assert names[:2] == ["FFT", "measure_shapes"]
    assert {"population_null", "measure_responses", "transform=gl"} <= set(names)
    for row in content["timings"]:
        assert row["name"].strip() in printed
        assert row["seconds"] > 0
        assert row["n_rounds"] == 1
        assert row["used"] > 0.9
    by_name = dict(zip(names, content["timings"], strict=True))
    # A transform is one of the steps of everything else.
    assert by_name["measure_shapes"]["ratio"] > 1.5
    assert "12 of 32 x 32 pixels, S/N 200, Gaussian galaxies" in printed
    assert content["options"]["threads"] == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--threads", 10_000], "--threads must be 1 to"),
        (["--threads", 0], "--threads must be 1 to"),
        (["--device", "cuda"], "numpy computes on the cpu only"),
        (["--n", 0], "n = 0"),
        (["--stamp-size", 2], "stamp size = 2"),
        (["--snr", -1], "snr = -1"),
        (["-o", "bench.txt"], "must be .json"),
    ],
)
def test_one_line_for_what_cannot_be(arguments, message):
    output = run(*arguments, code=1)
    assert output.startswith("Error: ")
    assert message in output
    assert output.count("\n") == 1


def test_markdown_is_a_table(without_galsim, monkeypatch):
    monkeypatch.setattr(
        "fdnt_xp.app.bench.time_cases", lambda *_, **__: [timed(1.0), timed(1234.5)]
    )
    lines = run("--n", 8, "--stamp-size", 32, "--markdown").splitlines()
    table = [line for line in lines if line.startswith("|")]
    assert {line.count("|") for line in table} == {8}
    assert "| 1,234 |" in table[-1]  # no exponents


def timed(ratio):
    return timing.Timing(
        name="x",
        n_gal=8,
        seconds=1e-5 * ratio,
        ratio=ratio,
        ratio_err=0.1,
        n_rounds=3,
        used=1.0,
        peak_bytes=None,
    )


# --- timing -----------------------------------------------------------------------------


class FakeTime:
    """A clock that cases move on, so that the test does not depend on the machine."""

    def __init__(self):
        self.seconds = 0.0

    def clock(self):
        return Clock(name="", now=lambda: self.seconds)

    def case(self, name, seconds, n_gal=1):
        def run():
            self.seconds += seconds
            return 1.0

        return Case(name=name, n_gal=n_gal, run=run)


def test_ratios_are_of_galaxies():
    fake = FakeTime()
    cases = [fake.case("same", 0.01), fake.case("three", 0.03, n_gal=2)]
    floor = fake.case("floor", 0.01, n_gal=2)
    found = timing.time_cases(floor, cases, backend=NUMPY, clock=fake.clock(), seconds=60.0)
    assert [row.name for row in found] == ["floor", "same", "three"]
    assert found[0].n_rounds > 2
    np.testing.assert_allclose([row.ratio for row in found], [1.0, 2.0, 3.0], rtol=1e-9)
    assert found[2].seconds == pytest.approx(0.015)


def test_there_is_one_round_at_least():
    fake = FakeTime()
    (found,) = timing.time_cases(
        fake.case("floor", 0.01), [], backend=NUMPY, clock=fake.clock(), seconds=0.0
    )
    assert found.n_rounds == 1


def test_peak_memory_is_counted():
    def allocate():
        np.ones(2_000_000)
        return 1.0

    case = Case(name="16 MB", n_gal=1, run=allocate)
    (_, found) = timing.time_cases(
        FakeTime().case("floor", 0.0), [case], backend=NUMPY, clock=WALL, seconds=0.0
    )
    assert found.peak_bytes == pytest.approx(16e6, rel=0.01)


def test_cpu_time_is_of_one_thread():
    assert clock_for(NUMPY, 1).name == "CPU time"
    assert clock_for(NUMPY, 2).name == "wall time"


def test_threads_are_set_and_given_back():
    torch = pytest.importorskip("torch")
    before = torch.get_num_threads()
    with limited_threads(load_backend("torch"), 1) as remark:
        assert torch.get_num_threads() == 1
        assert remark is None
    assert torch.get_num_threads() == before


def test_what_cannot_be_set_is_said(monkeypatch):
    imported = builtins.__import__

    def without(name, *arguments, **more):
        if name == "threadpoolctl":
            raise ImportError(name)
        return imported(name, *arguments, **more)

    monkeypatch.setattr(builtins, "__import__", without)
    with limited_threads(NUMPY, 1) as remark:
        assert "pip install threadpoolctl" in remark


def test_more_threads_than_cores():
    check_threads(cores())
    with pytest.raises(FdntValueError, match=f"not {cores() + 1}"):
        check_threads(cores() + 1)


# --- what is timed ----------------------------------------------------------------------


def test_the_floor_transforms_every_stamp(monkeypatch):
    seen = []

    def rfft2(part, **options):
        seen.append(len(part))
        return np.fft.rfft2(part)

    monkeypatch.setattr("scipy.fft.rfft2", rfft2)
    n_gal = FFT_BLOCK + 5
    assert fft_of(np.ones((n_gal, 8, 8)), NUMPY, 1)() == 1.0
    assert seen == [FFT_BLOCK, 5]


def test_gaussian_galaxies_have_their_shear():
    clean, star = bench_stamps._gaussian(64, 40, seed=1)
    estimate = fx.population_null(clean, fx.Psf.from_image(star))
    np.testing.assert_allclose(estimate.g, bench_stamps._SHEAR, atol=2e-5)


@pytest.mark.parametrize("snr", [50.0, 200.0])
def test_stamps_have_their_noise(without_galsim, snr):
    stamps = make_stamps(200, 40, snr)
    edge = stamps.pixels[:, 0, :]
    assert np.var(edge) == pytest.approx(stamps.variance, rel=0.1)
    shapes = fx.measure_shapes(
        stamps.pixels[:16], fx.Psf.from_image(stamps.star), noise_variance=stamps.variance
    )
    assert np.median(shapes.snr) == pytest.approx(snr, rel=0.1)
    # The galaxies come again after 128, with other noise.
    assert np.all(stamps.pixels[0] != stamps.pixels[128])


def test_drawn_by_galsim_where_it_is_there():
    pytest.importorskip("galsim")
    stamps = make_stamps(3, 32)
    assert stamps.pixels.shape == (3, 32, 32)
    assert "GalSim" in stamps.origin


def test_numbers_out_of_range():
    for arguments in ((0, 48), (8, 4), (8, 48, 0.0), (8, 48, float("nan"))):
        with pytest.raises(RangeError):
            make_stamps(*arguments)
