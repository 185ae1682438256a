"""Directories of GREAT08 measured: the right shears, whatever happens on the way."""

from __future__ import annotations

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table

import fdnt_xp
from challenges import CELL, N_SIDE, run, same_result, set_image, set_stamps, write_challenge
from conftest import selected_backends
from fdnt_xp.app import great08_run
from fdnt_xp.app.great08_measure import ESTIMATORS, MeasureOptions, SetResult, SetShear
from fdnt_xp.app.great08_run import measure_challenge
from fdnt_xp.app.noise import find_noise
from fdnt_xp.data.catalog import read_catalog
from fdnt_xp.data.images import write_image
from fdnt_xp.data.stamps import cube_stamps
from fdnt_xp.errors import CatalogError, FdntValueError, RangeError
from fdnt_xp.fourier.psf import Psf
from fdnt_xp.great08.submission import (
    COLUMNS,
    read_submission,
    submission_table,
    write_submission,
    write_text_submission,
)
from fdnt_xp.shapes.measure import measure_shapes
from fdnt_xp.shapes.methods import shape_method
from fdnt_xp.shears.from_shapes import shear_from_shapes
from fdnt_xp.shears.population import population_null
from fdnt_xp.shears.stacking import shear_from_stack
from images import star

TESTED = {backend.library for backend in selected_backends()}
NAMES = ("set0001", "set0002", "set0003")
NUMBERS = range(1, 4)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A directory of three sets that nobody changes, and a run over it with all estimators."""
    folder = tmp_path_factory.mktemp("great08")
    write_challenge(folder / "DIR", NUMBERS)
    options = MeasureOptions(estimators=tuple(ESTIMATORS))
    measure_challenge(folder / "DIR", folder / "ALL", options, cell=CELL)
    measure_challenge(folder / "DIR", folder / "NULL", MeasureOptions(), cell=CELL)
    return folder


@pytest.fixture
def folder(made, tmp_path, monkeypatch):
    """A working directory with a copy of the challenge, `DIR`."""
    shutil.copytree(made / "DIR", tmp_path / "DIR")
    monkeypatch.chdir(tmp_path)
    return tmp_path


MEASURE = ("measure", "DIR", "-o", "OUT", "--cell", CELL)


def times(out: Path, *names: str) -> list[int]:
    """Return when the files of sets were written."""
    files = [out / kind for name in names for kind in
             (f"catalogs/{name}.fits", f"sets/{name}.json")]  # fmt: skip
    return [file.stat().st_mtime_ns for file in files]


# --- what is measured -------------------------------------------------------------------


def test_the_rows_are_the_librarys_own(made):
    table = read_submission(made / "ALL" / "submission.ecsv")
    assert table.colnames == list(COLUMNS)
    assert table["set"].tolist() == [n for n in NUMBERS for _ in ESTIMATORS]
    assert table["estimator"].tolist() == 3 * list(ESTIMATORS)
    psf = Psf.from_image(star((CELL, CELL)))
    for number in NUMBERS:
        stamps = set_stamps(number).astype(np.float64)
        noise = {"noise_variance": find_noise(cube_stamps(set_stamps(number))).variance}
        cells = np.arange(N_SIDE**2)
        named = {"identifiers": 1_000_000 * number + cells, "seed": 0, **noise}
        expected = {
            "null": population_null(stamps, psf, **named),
            "null-eta": population_null(stamps, psf, statistic="eta", **named),
            "responsivity": shear_from_shapes(measure_shapes(stamps, psf, **noise), "lorentzian"),
            "stack": shear_from_stack(stamps, psf),
        }
        for name, estimate in expected.items():
            (row,) = table[(table["set"] == number) & (table["estimator"] == name)]
            # The same calls in the same process, but for galaxies measured in chunks.
            shear = {"g1": estimate.g[0], "g2": estimate.g[1]}
            errors = {"g1_err": estimate.g_err[0], "g2_err": estimate.g_err[1]}
            if estimate.g_err_noise is not None:
                errors["g1_err_noise"], errors["g2_err_noise"] = estimate.g_err_noise
            for column, value in (shear | errors).items():
                assert row[column] == pytest.approx(value, rel=1e-9, abs=1e-12), (name, column)
            assert (row["n_gal"], row["n_used"]) == (N_SIDE**2, estimate.n_used)


@pytest.mark.parametrize("name", NAMES)
def test_every_set_has_a_catalog(name, made):
    catalog = read_catalog(made / "ALL" / "catalogs" / f"{name}.fits")
    stamps = set_stamps(int(name[3:]))
    variance = find_noise(cube_stamps(stamps)).variance
    shapes = measure_shapes(
        stamps.astype(np.float64), Psf.from_image(star((CELL, CELL))), noise_variance=variance
    )
    np.testing.assert_allclose(catalog["eta1"], shapes.eta[:, 0], rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(catalog["x"][: N_SIDE + 1] // CELL, [*range(N_SIDE), 0])
    meta = catalog.meta
    assert (meta["METHOD"], meta["CELL"], meta["FDNTVER"]) == (
        "fdnt-ft",
        CELL,
        fdnt_xp.__version__,
    )
    assert (meta["IMAGE"], meta["PSFIMAGE"]) == (f"{name}.fit", "star.fit")
    assert meta["NOISEVAR"] == pytest.approx(variance, rel=1e-14)  # a card has 20 characters


def test_synthetic_noise_is_another_in_each_set(folder):
    write_image(set_image(1), "DIR/set0002.fit", overwrite=True)
    run(*MEASURE, "--estimator", "null", "--estimator", "responsivity")
    run(*MEASURE[:3], "OTHER", "--cell", CELL, "--seed", 1)
    table, other = (read_submission(f"{out}/submission.ecsv") for out in ("OUT", "OTHER"))
    null, shapes = (table[table["estimator"] == name] for name in ("null", "responsivity"))
    assert shapes["g1"][0] == shapes["g1"][1]
    assert null["g1"][0] != null["g1"][1]
    assert abs(null["g1"][0] - null["g1"][1]) < null["g1_err"][0]
    assert other["g1"][0] != null["g1"][0]


def test_other_methods_give_catalogs_and_their_responsivity(folder):
    output = run(*MEASURE, "--method", "gauss-1", code=1)
    assert "give --estimator responsivity" in output
    assert output.count("\n") == 1
    assert not (folder / "OUT").exists()
    run(*MEASURE, "--method", "gauss-1", "--estimator", "responsivity")
    catalog = read_catalog("OUT/catalogs/set0001.fits")
    assert catalog.meta["METHOD"] == "gauss-1"
    shapes = shape_method("gauss-1")(
        set_stamps(1).astype(np.float64),
        Psf.from_image(star((CELL, CELL))),
        noise_variance=catalog.meta["NOISEVAR"],
    )
    table = read_submission("OUT/submission.ecsv")
    assert table["g1"][0] == pytest.approx(shear_from_shapes(shapes, "lorentzian").g[0], rel=1e-9)


def test_given_noise_is_used(folder):
    run(*MEASURE, "--noise-variance", 3e-8)
    result = json.loads(Path("OUT/sets/set0001.json").read_text())
    assert (result["noise_variance"], result["noise_origin"]) == (3e-8, "given")
    assert read_catalog("OUT/catalogs/set0001.fits").meta["NOISEVAR"] == 3e-8


def test_chunks_change_nothing_but_rounding(folder, made):
    run(*MEASURE, "--estimator", "all", "--chunk", 10)
    first, second = (read_submission(f / "submission.ecsv") for f in (Path("OUT"), made / "ALL"))
    for column in ("g1", "g2", "g1_err"):
        np.testing.assert_allclose(first[column], second[column], rtol=1e-6, atol=1e-9)


@pytest.mark.skipif("torch" not in TESTED, reason="torch is not tested")
def test_torch_agrees(folder, made):
    run(*MEASURE, "--backend", "torch", "--device", "cpu")
    first, second = (read_submission(f / "submission.ecsv") for f in (Path("OUT"), made / "NULL"))
    for column in ("g1", "g2"):
        np.testing.assert_allclose(first[column], second[column], atol=1e-6)


# --- what is said -----------------------------------------------------------------------


def test_the_report(folder, made):
    output = run(*MEASURE).splitlines()
    assert output[0].split() == ["set", "estimator", "g1", "+-", "g2", "+-", "used"]
    table = read_submission(made / "NULL" / "submission.ecsv")
    for line, row in zip(output[1:4], table, strict=True):
        name, estimator, *numbers = line.split()
        assert (name, estimator) == (f"set{row['set']:04d}", "null")
        expected = [row[column] for column in ("g1", "g1_err", "g2", "g2_err", "n_used")]
        np.testing.assert_allclose([float(number) for number in numbers], expected, atol=5.1e-6)
    assert output[4] == "sets       3 measured, 0 failed"
    assert output[-2] == f"written    {folder / 'OUT' / 'submission.ecsv'}"
    assert output[-1] == f"next       fdnt-xp great08 score {folder / 'OUT'} --truth TRUTH"


def test_what_it_says_next_can_be_run(folder):
    truth = Table({"set": [1, 2, 3], "shear": [1, 2, 3], "g1": 3 * [0.0], "g2": 3 * [0.0]})
    truth.write("DIR/truth.ecsv")
    output = run(*MEASURE).splitlines()
    assert output[-1].startswith("next       fdnt-xp great08 score")
    run(*output[-1].split()[3:])


def test_what_is_finished_is_not_done_again(folder, monkeypatch):
    run(*MEASURE)
    monkeypatch.setattr(great08_run, "measure_set", pytest.fail)
    assert "0 measured, 3 before, 0 failed" in run(*MEASURE)


def test_quiet(folder):
    assert run(*MEASURE, "--quiet") == ""


def test_plain_text_is_as_the_challenge_took_it(made):
    lines = (made / "ALL" / "stack.txt").read_text().splitlines()
    table = read_submission(made / "ALL" / "submission.ecsv")
    table = table[table["estimator"] == "stack"]
    assert lines[0] == "# set g1 g2"
    numbers = np.loadtxt(made / "ALL" / "stack.txt")
    np.testing.assert_array_equal(numbers[:, 0], table["set"])
    np.testing.assert_allclose(numbers[:, 1], table["g1"], atol=5.1e-9)
    np.testing.assert_allclose(numbers[:, 2], table["g2"], atol=5.1e-9)


def test_warnings_say_which_set(folder):
    pixels = set_image(2) + np.float32(1e-3)
    write_image(pixels, "DIR/set0002.fit", overwrite=True)
    output = run(*MEASURE)
    assert output.count("Warning: ") == 1
    assert "Warning: set0002: the borders of the stamps are not at zero" in output


# --- what fails -------------------------------------------------------------------------


def test_an_estimator_that_fails_is_a_row_of_nan(folder):
    write_image(np.zeros_like(set_image(2)), "DIR/set0002.fit", overwrite=True)
    output = run(*MEASURE, "--noise-variance", 1e-8, "--estimator", "all")
    table = read_submission("OUT/submission.ecsv")
    failed = table[table["set"] == 2]
    assert np.isnan([failed[name] for name in ("g1", "g2", "g1_err", "g2_err")]).all()
    assert failed["n_used"].tolist() == 4 * [0]
    assert np.isfinite(table[table["set"] != 2]["g1"]).all()
    assert "no shear   set0002 responsivity: " in output
    assert "3 measured, 0 failed" in output
    result = json.loads(Path("OUT/sets/set0002.json").read_text())
    assert all(shear["g1"] is None and shear["failure"] for shear in result["shears"])
    assert np.loadtxt("OUT/null.txt")[:, 0].tolist() == [1, 2, 3]
    # It is finished: to do it again would fail again.
    assert "0 measured, 3 before" in run(*MEASURE, "--noise-variance", 1e-8, "--estimator", "all")


def test_a_truncated_image_is_reported_and_the_others_done(folder, made):
    whole = Path("DIR/set0002.fit").read_bytes()
    Path("DIR/set0002.fit").write_bytes(whole[: len(whole) // 2])
    output = run(*MEASURE, code=1)
    assert output.count("failed     ") == 1
    assert "failed     set0002: cannot read the image of a set " in output
    assert "truncated" in output
    assert read_submission("OUT/submission.ecsv")["set"].tolist() == [1, 3]
    before = times(Path("OUT"), "set0001", "set0003")
    Path("DIR/set0002.fit").write_bytes(whole)
    assert "1 measured, 2 before, 0 failed" in run(*MEASURE)
    assert times(Path("OUT"), "set0001", "set0003") == before
    same_result(Path("OUT"), made / "NULL")


def test_sets_without_image_or_psf_are_reported(folder):
    Path("DIR/set0002.fit").unlink()
    text = Path("DIR/psf_map.txt").read_text()
    Path("DIR/psf_map.txt").write_text(text.replace("set0003 star\n", ""))
    output = run(*MEASURE, "--quiet", code=1)
    assert output.splitlines() == [
        "failed     set0002: the image is missing",
        "failed     set0003: the PSF map names no PSF for it",
    ]
    assert read_submission("OUT/submission.ecsv")["set"].tolist() == [1]


def test_a_psf_that_is_not_there(folder):
    text = Path("DIR/psf_map.txt").read_text()
    Path("DIR/psf_map.txt").write_text(text.replace("set0003 star", "set0003 moon"))
    output = run(*MEASURE, "--quiet", code=1)
    assert output.startswith("failed     set0003: cannot read the PSF")
    assert output.count("\n") == 1


@pytest.mark.parametrize("what", ["catalog", "result"])
def test_a_full_disc_finishes_nothing(what, folder, made, monkeypatch):
    def full(*_, **__):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        if what == "catalog":
            patch.setattr(fits.HDUList, "writeto", full)
        else:
            patch.setattr(great08_run, "write_json", failing_for(great08_run.write_json, full))
        output = run(*MEASURE, code=1)
    assert "failed     set0002: " in output
    assert "No space left on device" in output
    assert list(Path("OUT/sets").iterdir()) == []
    assert "3 measured, 0 failed" in run(*MEASURE)
    same_result(Path("OUT"), made / "NULL")


def failing_for(write, full):
    """Return a writer that fails for sets, and works for the rest of a run."""

    def failing(content, path, *, overwrite):
        if "sets" in Path(path).parts:
            full()
        write(content, path, overwrite=overwrite)

    return failing


def test_what_was_not_foreseen_is_reported_too(folder, monkeypatch):
    def broken(one, options):
        raise MemoryError("no room")

    monkeypatch.setattr(great08_run, "measure_set", broken)
    output = run(*MEASURE, "--quiet", code=1).splitlines()
    for line, name in zip(output, NAMES, strict=True):
        assert line.startswith(
            f"failed     {name}: MemoryError: no room (test_great08_measure.py, "
        )
    assert len(read_submission("OUT/submission.ecsv")) == 0


# --- what is refused --------------------------------------------------------------------


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("--estimator", "all"),
        ("--seed", 1),
        ("--noise-variance", 1e-8),
        ("--chunk", 7),
        ("--dtype", "float32"),
    ],
)
def test_other_options_are_refused(option, value, folder, made):
    shutil.copytree(made / "NULL", "OUT")
    run_json = json.loads(Path("OUT/run.json").read_text())
    run_json["options"]["directory"] = str(folder / "DIR")
    Path("OUT/run.json").write_text(json.dumps(run_json))
    before = times(Path("OUT"), *NAMES)
    output = run(*MEASURE, option, value, code=1)
    assert f"holds a run with {option} " in output
    assert f"this has {'null,' if value == 'all' else value}" in output
    assert output.count("\n") == 1
    assert times(Path("OUT"), *NAMES) == before


def test_another_directory_is_refused(folder, made):
    shutil.copytree(made / "NULL", "OUT")
    output = run(*MEASURE, code=1)
    assert f"holds a run with DIR {made / 'DIR'}, and this has {folder / 'DIR'}" in output


@pytest.mark.parametrize(
    ("output", "message"),
    [
        ("full", "is not empty, and no run of great08 measure is in it"),
        ("DIR", "is not empty, and no run of great08 measure is in it"),
        ("full/old.txt", "cannot make the folder"),
        ("odd", "run.json is not that of a run"),
        ("worse", "cannot read"),
    ],
)
def test_folders_that_are_something_else(output, message, folder):
    for name, content in (("odd", "{}"), ("worse", "{"), ("full", None)):
        Path(name).mkdir()
        Path(name, "old.txt" if content is None else "run.json").write_text(content or "old")
    before = sorted(folder.rglob("*"))
    printed = run("measure", "DIR", "-o", output, "--cell", CELL, code=1)
    assert message in printed
    assert printed.count("\n") == 1
    assert sorted(folder.rglob("*")) == before


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("measure", "nowhere"), "nowhere does not exist"),
        (("measure", "DIR", "--method", "no"), "known are fdnt-ft"),
        (("measure", "DIR", "--noise-variance", 0), "noise_variance = 0"),
        (("measure", "DIR", "--device", "cuda"), "cpu only"),
        (("measure", "DIR", "--backend", "jax", "--dtype", "float32"), "64-bit integers"),
        (("measure", "DIR", "--estimator", "null", "--estimator", "null"), "each estimator once"),
        (("measure", "DIR", "--jobs", 2, "--scheduler", "tcp://no:1"), "not both"),
    ],
)
def test_what_cannot_be_measured(arguments, message, folder):
    output = run(*arguments, "-o", "OUT", code=1)
    assert output.startswith("Error: ")
    assert message in output
    assert output.count("\n") == 1
    assert not (folder / "OUT").exists()


def test_a_cell_that_does_not_fit_is_a_failure_of_each_set(folder):
    output = run("measure", "DIR", "-o", "OUT", "--quiet", "--cell", 50, code=1)
    assert output.count("is not a whole number of cells of 50 pixels") == 3


def test_another_version_is_warned_of(folder, made, monkeypatch):
    run(*MEASURE)
    monkeypatch.setattr(fdnt_xp, "__version__", "9.9")
    output = run(*MEASURE)
    assert f"was begun by fdnt_xp {read_version(made)}, and is continued by 9.9" in output


def read_version(made):
    return json.loads((made / "NULL" / "run.json").read_text())["begun"]["FDNTVER"]


def test_options_are_checked():
    with pytest.raises(FdntValueError, match="known are null, null-eta, responsivity, stack"):
        MeasureOptions(estimators=("nil",))
    with pytest.raises(FdntValueError, match="each estimator once"):
        MeasureOptions(estimators=())
    with pytest.raises(RangeError):
        MeasureOptions(noise_variance=-1.0)


def test_a_result_that_was_changed_is_an_error(folder):
    run(*MEASURE)
    for content in ("", "[]", "{}"):
        Path("OUT/sets/set0002.json").write_text(content)
        output = run(*MEASURE, code=1)
        assert output.startswith("Error: ")
        assert "set0002.json" in output


def test_results_come_back_from_json():
    shears = (
        SetShear(estimator="null", g1=0.1, g2=0.2, g1_err=0.3, g2_err=0.4, n_used=5),
        SetShear(estimator="stack", failure="no shape"),
    )
    result = SetResult(
        number=3, name="set0003", n_gal=6, n_measured=5, noise_variance=None, noise_err=None,
        noise_origin="stamp borders", seconds=1.5, warnings=("a", "b"), shears=shears,
    )  # fmt: skip
    again = SetResult.from_dict(json.loads(json.dumps(result.to_dict())))
    assert again.shears[0] == shears[0]
    assert np.isnan(again.shears[1].g1)
    assert again.shears[1].failure == "no shape"
    assert (again.warnings, again.noise_variance, again.n_gal) == (("a", "b"), None, 6)


# --- killed, interrupted, shared out ----------------------------------------------------

_HOLD = """
import sys, time
from pathlib import Path
from fdnt_xp.app.cli import main
from fdnt_xp.data.row_batches import _FitsFile

def hold():
    Path("held").touch()
    time.sleep(60)

def append(self, table, append=_FitsFile.append):
    append(self, table)
    if "set0002" in str(self._file.name) and sys.argv[1] == "catalog":
        hold()

def replace(self, target, replace=Path.replace):
    if str(target).endswith("sets/set0002.json") and sys.argv[1] == "result":
        hold()
    return replace(self, target)

_FitsFile.append, Path.replace = append, replace
main(sys.argv[2:])
"""


def run_and_stop(where: str, number: int) -> int:
    """Run the command in a process of its own, stop it within set 2; return its exit code."""
    arguments = ["great08", *map(str, MEASURE)]
    process = subprocess.Popen(
        [sys.executable, "-c", _HOLD, where, *arguments],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    deadline = time.monotonic() + 60
    while not Path("held").exists():
        assert process.poll() is None, "it ended too early"
        assert time.monotonic() < deadline
        time.sleep(0.02)
    process.send_signal(number)
    return process.wait(timeout=20)


@pytest.mark.parametrize("where", ["catalog", "result"])
def test_a_run_that_was_killed_is_resumed(where, folder, made):
    assert run_and_stop(where, signal.SIGKILL) == -signal.SIGKILL
    out = Path("OUT")
    assert [file.name for file in (out / "sets").glob("set*")] == ["set0001.json"]
    before = times(out, "set0001")
    assert "2 measured, 1 before, 0 failed" in run(*MEASURE)
    assert times(out, "set0001") == before
    same_result(out, made / "NULL")


def test_an_interrupt_leaves_nothing_unfinished(folder, made):
    assert run_and_stop("catalog", signal.SIGINT) == 130
    assert [file.name for file in Path("OUT/catalogs").iterdir()] == ["set0001.fits"]
    assert [file.name for file in Path("OUT/sets").iterdir()] == ["set0001.json"]
    run(*MEASURE)
    same_result(Path("OUT"), made / "NULL")


def test_processes_give_the_same(folder, made, monkeypatch):
    Path("DIR/set0004.fit").write_bytes(b"no FITS")
    with Path("DIR/psf_map.txt").open("a") as file:
        file.write("set0004 star\n")
    output = run(*MEASURE, "--jobs", 2, code=1)
    assert "3 measured, 1 failed" in output
    assert "failed     set0004: cannot read" in output
    same_result(Path("OUT"), made / "NULL")


# --- submissions on disk ----------------------------------------------------------------


def rows(*sets: int) -> list[dict[str, object]]:
    numbers = {"g1": 0.01, "g2": np.nan, "g1_err": 0.1, "g2_err": 0.2, "n_gal": 7, "n_used": 6}
    numbers |= {"g1_err_noise": 0.05, "g2_err_noise": np.nan}
    return [{"set": number, "estimator": "null", **numbers} for number in sets]


@pytest.mark.parametrize("sets", [(), (2, 5)])
def test_submissions_come_back(sets, tmp_path):
    table = submission_table(rows(*sets))
    write_submission(table, tmp_path / "a.ecsv")
    again = read_submission(tmp_path / "a.ecsv")
    assert again.colnames == list(COLUMNS)
    for name, (_, description) in COLUMNS.items():
        np.testing.assert_array_equal(again[name], table[name])
        assert again[name].dtype.kind == table[name].dtype.kind
        assert again[name].description == description
    with pytest.raises(CatalogError, match="exists"):
        write_submission(table, tmp_path / "a.ecsv")
    write_submission(table, tmp_path / "a.ecsv", overwrite=True)


def test_what_is_no_submission(tmp_path):
    with pytest.raises(CatalogError, match=r"must be \.ecsv"):
        write_submission(submission_table(rows(1)), tmp_path / "a.fits")
    with pytest.raises(CatalogError, match=r"must be \.ecsv"):
        read_submission(tmp_path / "a.txt")
    with pytest.raises(CatalogError, match="does not exist"):
        read_submission(tmp_path / "a.ecsv")
    Table({"set": [1], "gamma1": [0.1]}).write(tmp_path / "b.ecsv")
    with pytest.raises(CatalogError, match="no column estimator, g1, g2; it has set, gamma1"):
        read_submission(tmp_path / "b.ecsv")
    with pytest.raises(CatalogError, match="set 1 by 'null' more than once"):
        write_submission(submission_table(rows(1, 2, 1)), tmp_path / "c.ecsv")
    assert not (tmp_path / "c.ecsv").exists()


def test_plain_text_of_an_estimator(tmp_path):
    table = submission_table(rows(2, 5))
    with pytest.raises(FdntValueError, match="no estimator 'stack'; it has null"):
        write_text_submission(table, "stack", tmp_path / "a.txt")
    write_text_submission(table, "null", tmp_path / "a.txt")
    assert (tmp_path / "a.txt").read_text() == "# set g1 g2\n2 0.01000000 nan\n5 0.01000000 nan\n"
    with pytest.raises(CatalogError, match="exists"):
        write_text_submission(table, "null", tmp_path / "a.txt")
