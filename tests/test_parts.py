"""A catalog made in parts: the same as one made at once, whatever is killed, by any processes."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from click.testing import CliRunner

import fdnt_xp
from fdnt_xp.app import measure_run, parts
from fdnt_xp.app.backends import load_backend
from fdnt_xp.app.chunks import ChunkSize
from fdnt_xp.app.cli import main
from fdnt_xp.app.noise import find_noise
from fdnt_xp.app.runner import IMAGE_COLUMNS, measure_source
from fdnt_xp.data import row_batches
from fdnt_xp.data.catalog import read_catalog
from fdnt_xp.data.stamps import cube_stamps
from fdnt_xp.errors import FdntError, FdntWarning, RangeError
from fdnt_xp.flags import Flag
from fdnt_xp.shapes.measure import measure_shapes
from fdnt_xp.shapes.results import COLUMNS, PSF_COLUMNS
from fdnt_xp.shears.responses import COLUMNS as RESPONSES
from images import galaxies, gaussian_covariance, gaussian_image, star

SIZE = 24
N_GAL = 22
PARTS = [(0, 8), (8, 16), (16, 22)]
MEASURE = ("measure", "cube.fits", "--psf", "psf.fits", "--chunk", 4)


@pytest.fixture(scope="module")
def stamps():
    rng = np.random.default_rng(5)
    drawn = galaxies(rng.uniform(-0.3, 0.3, (N_GAL, 2)), (SIZE, SIZE))
    return (drawn + 2e-4 * rng.standard_normal(drawn.shape)).astype("f4")


@pytest.fixture
def folder(stamps, tmp_path, monkeypatch):
    """A working directory with `cube.fits` and `psf.fits`, where a part has eight galaxies."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(parts, "PART", 8)
    fits.PrimaryHDU(stamps).writeto("cube.fits")
    fits.PrimaryHDU(star((SIZE, SIZE))).writeto("psf.fits")
    return tmp_path


def run(*arguments, code=0):
    result = CliRunner().invoke(main, [str(argument) for argument in arguments])
    assert result.exit_code == code, result.output
    assert "Traceback" not in result.output
    return result.output


def names_of(done):
    return [f"rows{start:010d}-{stop:010d}.npz" for start, stop in done]


def stop_in_part(monkeypatch, number, error):
    """Let the measurement of a part end with an error."""
    measure = measure_run.measure_rows

    def measure_or_stop(source, psfs, how, rows, **options):
        if tuple(rows) == PARTS[number]:
            raise error
        return measure(source, psfs, how, rows, **options)

    monkeypatch.setattr(measure_run, "measure_rows", measure_or_stop)


def same_catalogs(one, other):
    one, other = read_catalog(one), read_catalog(other)
    assert one.colnames == other.colnames
    for facts in (one.meta, other.meta):
        del facts["DATE"]
    assert one.meta == other.meta
    for name in one.colnames:
        np.testing.assert_array_equal(one[name], other[name])
        assert (one[name].unit, one[name].description) == (
            other[name].unit,
            other[name].description,
        )


@pytest.mark.parametrize(
    ("suffix", "kind"),
    [(".fits", ()), (".ecsv", ("--responses",)), (".parquet", ("--responses",)), (".hdf5", ())],
)
def test_parts_make_what_one_call_does(suffix, kind, folder, stamps):
    output = run(*MEASURE, "-o", f"out{suffix}", *kind)
    assert f"of {N_GAL} galaxies" in output
    assert not (folder / f"out{suffix}.parts").exists()
    table = read_catalog(f"out{suffix}")
    assert table["id"].tolist() == list(range(N_GAL))
    measured = {*(RESPONSES if kind else COLUMNS), *IMAGE_COLUMNS, *PSF_COLUMNS}
    assert set(table.colnames) == measured
    if kind:
        return
    variance = find_noise(cube_stamps(stamps)).variance
    shapes = measure_shapes(
        stamps.astype("f8"),
        fdnt_xp.Psf.from_image(star((SIZE, SIZE))),
        noise_variance=variance,
    ).to_table()
    for name in ("eta1", "e2", "flux", "snr", "flags", "masked_fraction"):
        np.testing.assert_allclose(table[name], shapes[name], rtol=1e-8, atol=1e-9)


def test_the_shape_of_the_psf_is_beside_that_of_each_galaxy(folder):
    """By the covariance of the Gaussians that the stars are."""
    rng = np.random.default_rng(8)
    e = rng.uniform(-0.2, 0.2, (N_GAL, 2))
    sigma = rng.uniform(1.4, 1.8, N_GAL)
    stars = [
        gaussian_image(gaussian_covariance(tuple(one), s), (SIZE, SIZE))
        for one, s in zip(e, sigma, strict=True)
    ]
    stars[9] *= np.nan
    fits.PrimaryHDU(np.stack(stars)).writeto("psfs.fits")
    run(*MEASURE[:3], "psfs.fits", *MEASURE[4:], "-o", "out.fits")
    table = read_catalog("out.fits")
    norm = np.linalg.norm(e, axis=-1)
    eta = e * (np.arctanh(norm) / norm)[:, None]
    size = sigma * (1.0 - norm**2) ** 0.25
    expected = {"psf_eta1": eta[:, 0], "psf_eta2": eta[:, 1], "psf_size": size}
    usable = np.arange(N_GAL) != 9
    for name, values in expected.items():
        # The stars' wings are cut by the edge of their images.
        np.testing.assert_allclose(table[name][usable], values[usable], atol=2e-4)
        assert np.isnan(table[name][9])
    assert table["flags"][9] == int(Flag.BAD_PSF)


@pytest.mark.parametrize(
    ("error", "kind"),
    [(KeyboardInterrupt(), ("--responses",)), (FdntError("the disc is full"), ())],
)
def test_an_interrupted_command_goes_on(error, kind, folder, monkeypatch):
    run(*MEASURE, *kind, "-o", "whole.fits")
    with monkeypatch.context() as patch:
        stop_in_part(patch, 1, error)
        code = 130 if isinstance(error, KeyboardInterrupt) else 1
        output = run(*MEASURE, *kind, "-o", "out.fits", code=code)
    assert "8 of 22 galaxies are in out.fits.parts, and the same command goes on" in output
    assert ("the disc is full" in output) is (code == 1)
    assert output.count("\n") == 1
    assert not Path("out.fits").exists()
    kept = Path("out.fits.parts")
    assert sorted(f.name for f in kept.iterdir()) == [*names_of(PARTS[:1]), "run.json"]
    before = (kept / names_of(PARTS)[0]).read_bytes()
    with monkeypatch.context() as patch:  # a second interrupt, later
        stop_in_part(patch, 2, error)
        run(*MEASURE, *kind, "-o", "out.fits", code=code)
    assert (kept / names_of(PARTS)[0]).read_bytes() == before
    with monkeypatch.context() as patch:
        stop_in_part(patch, 0, AssertionError("it is finished"))
        output = run(*MEASURE, *kind, "-o", "out.fits")
    assert "resumed    16 of them were measured before" in output
    assert not kept.exists()
    same_catalogs("out.fits", "whole.fits")


def test_an_interrupt_in_the_first_part_leaves_nothing(folder, monkeypatch):
    before = sorted(folder.iterdir())
    stop_in_part(monkeypatch, 0, KeyboardInterrupt())
    output = run(*MEASURE, "-o", "out.fits", code=130)
    assert output == "Interrupted: nothing unfinished was left behind.\n"
    assert sorted(folder.iterdir()) == before


@pytest.fixture
def begun(folder, monkeypatch):
    """The same, after a command that was interrupted in its second part."""
    with monkeypatch.context() as patch:
        stop_in_part(patch, 1, KeyboardInterrupt())
        run(*MEASURE, "-o", "out.fits", code=130)
    return folder


@pytest.mark.parametrize(
    ("options", "shown"),
    [
        (("--method", "fdnt-gl"), "--method fdnt-ft, and this has fdnt-gl"),
        (("--noise-variance", 1.0), "--noise-variance not given, and this has 1.0"),
        (("--dtype", "float32"), "--dtype float64, and this has float32"),
        (("--responses",), "--responses False, and this has True"),
    ],
)
def test_other_options_are_refused(options, shown, begun):
    before = sorted(begun.rglob("*"))
    for more in ((), ("--overwrite",)):
        output = run(*MEASURE, *options, "-o", "out.fits", *more, code=1)
        assert f"out.fits.parts holds a run with {shown}: give the same options, or " in output
        assert "remove out.fits.parts" in output
        assert output.count("\n") == 1
    assert sorted(begun.rglob("*")) == before


def test_another_image_of_the_same_name_is_refused(begun):
    os.utime("psf.fits", (1e9, 1e9))
    output = run(*MEASURE, "-o", "out.fits", code=1)
    assert "holds a run with psf.fits of 8640 bytes" in output
    assert "2001-09-09T01:46:40" in output


def test_what_is_in_the_way(folder):
    Path("out.fits.parts").mkdir()
    Path("out.fits.parts/mine.txt").write_text("mine")
    output = run(*MEASURE, "-o", "out.fits", code=1)
    assert "out.fits.parts is not empty, and no run of measure is in it" in output
    assert Path("out.fits.parts/mine.txt").read_text() == "mine"


def test_a_part_that_is_broken_is_named(begun):
    broken = Path("out.fits.parts") / names_of(PARTS)[0]
    broken.write_bytes(broken.read_bytes()[:100])
    output = run(*MEASURE, "-o", "out.fits", code=1)
    assert f"{broken} is not what was written: remove it" in output
    assert not Path("out.fits").exists()
    broken.unlink()
    run(*MEASURE, "-o", "out.fits")


def test_a_catalog_that_appears_meanwhile_is_kept(begun, monkeypatch):
    def appear(*_, **__):
        Path("out.fits").write_text("theirs")
        raise FdntError("late")

    with monkeypatch.context() as patch:
        patch.setattr(measure_run, "measure_rows", appear)
        run(*MEASURE, "-o", "out.fits", code=1)
    assert "out.fits exists" in run(*MEASURE, "-o", "out.fits", code=1)
    assert Path("out.fits").read_text() == "theirs"
    run(*MEASURE, "-o", "out.fits", "--overwrite")
    assert len(read_catalog("out.fits")) == N_GAL


_KILLED = """
import sys, time
from pathlib import Path
from fdnt_xp.app import parts
from fdnt_xp.app.cli import main

def write_part(table, path, write=parts._write_part):
    if "-0000000016" not in path.name:
        return write(table, path)
    path.with_name("." + path.stem + "-12345678.npz").write_bytes(b"half")
    Path("held").touch()
    time.sleep(60)

parts.PART, parts._write_part = 8, write_part
main(sys.argv[1:])
"""


def test_a_command_that_was_killed_goes_on(folder):
    run(*MEASURE, "-o", "whole.fits")
    inputs = sorted(folder.iterdir())
    command = [sys.executable, "-c", _KILLED, *map(str, MEASURE), "-o", "out.fits"]
    with subprocess.Popen(command, stderr=subprocess.PIPE) as process:
        deadline = time.monotonic() + 60
        while not Path("held").exists():
            assert process.poll() is None, process.stderr.read()
            assert time.monotonic() < deadline
            time.sleep(0.02)
        process.kill()
    Path("held").unlink()
    assert sorted(folder.iterdir()) == sorted([*inputs, folder / "out.fits.parts"])
    assert "resumed    8 of them" in run(*MEASURE, "-o", "out.fits")
    assert sorted(folder.iterdir()) == sorted([*inputs, folder / "out.fits"])
    same_catalogs("out.fits", "whole.fits")


def test_parts_outlive_the_catalog_that_is_made_of_them(folder, monkeypatch):
    def interrupt(self, table):
        self._file.write(b"half a catalog")
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(row_batches._FitsFile, "append", interrupt)
        output = run(*MEASURE, "-o", "out.fits", code=130)
    assert "22 of 22 galaxies are in out.fits.parts" in output
    kept = sorted(file.name for file in Path("out.fits.parts").iterdir())
    assert kept == [*names_of(PARTS), "run.json"]
    stop_in_part(monkeypatch, 0, AssertionError("it is finished"))
    assert "ms per galaxy" not in run(*MEASURE, "-o", "out.fits")
    assert len(read_catalog("out.fits")) == N_GAL


def test_more_processes_go_on_with_what_one_began(begun):
    """Parts stay as large as they were begun, and the rows in their order."""
    chosen = json.loads(Path("out.fits.parts/run.json").read_text())["choices"]
    assert chosen == {"part": 8}
    output = run(*MEASURE, "-o", "out.fits", "--jobs", 2)
    assert "resumed    8 of them" in output
    assert not Path("out.fits.parts").exists()
    run(*MEASURE, "-o", "whole.fits")
    same_catalogs("out.fits", "whole.fits")


# --- memory that is not there -------------------------------------------------------------


class OutOfMemoryError(RuntimeError):
    """What torch and CuPy call theirs."""


ERRORS = {
    "device": OutOfMemoryError("CUDA out of memory. Tried to allocate 2 GiB"),
    "host": MemoryError("Unable to allocate 2 GiB"),
    "torch on the CPU": RuntimeError("DefaultCPUAllocator: can't allocate memory"),
    "jax": RuntimeError("RESOURCE_EXHAUSTED: Out of memory while trying to allocate"),
}


@pytest.mark.parametrize("name", ERRORS)
def test_chunks_halve_until_there_is_memory(name, stamps):
    seen = []

    def method(part, psf, **options):
        seen.append(len(part))
        if len(part) > 5:
            raise ERRORS[name]
        return measure_shapes(part, psf, **options)

    options = {"backend": load_backend(), "noise_variance": 4e-8, "chunk": 16}
    source, psf = cube_stamps(stamps), star((SIZE, SIZE))
    with pytest.warns(FdntWarning) as caught:
        halved = measure_source(source, psf, method=method, **options)
    assert len(caught) == 1
    assert "no memory for 16 galaxies at a time: going on with half as many" in str(
        caught[0].message
    )
    assert seen == [16, 8, 4, 4, 4, 4, 4, 2]
    whole = measure_source(source, psf, **options)
    np.testing.assert_allclose(halved["eta1"], whole["eta1"], atol=1e-9)


def test_no_memory_for_a_single_galaxy():
    def fail(start, stop):
        raise MemoryError("not a byte")

    size = ChunkSize(4, load_backend())
    with (
        pytest.warns(FdntWarning, match="for 4 galaxies"),
        pytest.raises(FdntError, match="no memory for a single galaxy: not a byte"),
    ):
        list(size.each(0, 8, fail))


def test_other_errors_are_not_taken_for_it():
    def fail(start, stop):
        raise RuntimeError("something else")

    with pytest.raises(RuntimeError, match="something else"):
        list(ChunkSize(4, load_backend()).each(0, 8, fail))


@pytest.mark.parametrize("chunk", [0, -1])
def test_chunks_of_nothing(chunk, stamps, folder):
    source, psf = cube_stamps(stamps), star((SIZE, SIZE))
    with pytest.raises(RangeError, match=f"chunk = {chunk} "):
        measure_source(source, psf, backend=load_backend(), noise_variance=1.0, chunk=chunk)
    assert "is not in the range x>=1" in run(*MEASURE[:-1], chunk, "-o", "out.fits", code=2)


def test_more_processes_than_cores_are_warned_of(folder, monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0}, raising=False)
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    output = run(*MEASURE, "-o", "out.fits")
    assert "1 process of OMP_NUM_THREADS=3 threads are more than the 1 cores" in output
    monkeypatch.delenv("OMP_NUM_THREADS")
    assert "Warning" not in run(*MEASURE, "-o", "out.fits", "--overwrite")


def test_a_table_without_galaxies(folder, stamps):
    Table({"x": np.zeros(0), "y": np.zeros(0)}).write("none.ecsv")
    fits.PrimaryHDU(stamps[0]).writeto("image.fits")
    around = ("--positions", "none.ecsv", "--stamp-size", 16, "--noise-variance", 1e-8)
    for kind in ((), ("--responses",)):
        output = run(
            *("measure", "image.fits", "--psf", "psf.fits", *around, *kind),
            *("-o", "out.hdf5", "--overwrite"),
        )
        assert "measured   0 of 0" in output
        assert len(read_catalog("out.hdf5")) == 0
