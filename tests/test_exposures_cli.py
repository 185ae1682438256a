"""`fdnt-xp measure-exposures`: from MEDS files to one shape for each object."""

from __future__ import annotations

import pickle
from contextlib import chdir
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from astropy.io import fits
from click.testing import CliRunner

from fdnt_xp.app import exposures as module
from fdnt_xp.app.cli import main
from fdnt_xp.app.parts import Rows
from fdnt_xp.data.catalog import read_catalog
from fdnt_xp.flags import FAILED, Flag
from meds_files import SIGMA, SMALL, G, MedsObject, drawn_cutouts, objects_of, write_meds

SKY = np.array([[40.0, -1.0], [40.1, -1.1], [40.2, -1.2], [40.3, -1.3]])
SAME = ("g1", "g2", "eta1_var", "eta12_cov", "u", "v", "size", "flux", "snr", "flags", "n_used")


@pytest.fixture(scope="module")
def cutouts():
    return drawn_cutouts()


@pytest.fixture(scope="module")
def made(cutouts, tmp_path_factory):
    """Return a MEDS file of four objects, of which the third has no cutouts."""
    path = tmp_path_factory.mktemp("meds") / "tile.fits"
    return write_meds(path, objects_of(cutouts), ra=SKY[:, 0], dec=SKY[:, 1])


@pytest.fixture(scope="module")
def expected(made):
    """Return its catalog."""
    with chdir(made.parent):
        said = run(made.name, "-o", "catalog.fits")
        return said, read_catalog("catalog.fits")


@pytest.fixture
def folder(made, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "tile.fits").write_bytes(made.read_bytes())
    return tmp_path


def run(*arguments, code=0):
    result = CliRunner().invoke(main, ["measure-exposures", *(str(one) for one in arguments)])
    assert result.exit_code == code, result.output
    assert "Traceback" not in result.output
    return result.output


def catalog(*arguments):
    run(*arguments, "-o", "out.fits", "--overwrite", "--quiet")
    return read_catalog("out.fits")


def test_one_true_shape_of_all_exposures(expected):
    said, table = expected
    assert "measured   3 of 4 galaxies" in said
    assert "NO_EXPOSURE" in said
    assert table["id"].tolist() == [100, 101, 102, 103]
    np.testing.assert_array_equal(table["ra"], SKY[:, 0])
    np.testing.assert_array_equal(table["dec"], SKY[:, 1])
    assert table["dec"].unit == "deg"
    assert table["n_exposures"].tolist() == [3, 2, 0, 3]
    assert table["n_used"].tolist() == [3, 2, 0, 3]
    assert table["flags"][2] == int(Flag.NO_EXPOSURE)
    assert np.isnan(table["g1"]).tolist() == [False, False, True, False]
    there = [0, 1, 3]
    for i in (0, 1):
        np.testing.assert_allclose(table[f"g{i + 1}"][there], G[there, i], atol=2e-5)
    for name in ("u", "v"):
        np.testing.assert_allclose(table[name][there], 0.0, atol=1e-4)
    assert table.meta["CUTOUTS"] == "all"
    assert table.meta["NOISESRC"] == "weight map"
    assert all(column.description for column in table.itercols())


def test_the_psf_of_an_object_is_the_mean_of_those_that_count(expected, cutouts):
    _, table = expected
    assert np.isnan(table["psf_eta1"]).tolist() == [False, False, True, False]
    # PSFs of g1 = 0, 0.05, 0.10 with g2 = -0.03, exposures of nearly the same S/N.
    eta = [2 * np.arctanh(np.hypot(g1, 0.03)) / np.hypot(g1, 0.03) for g1 in (0.0, 0.05, 0.1)]
    mean = np.mean([[0.0, -0.03 * eta[0]], [0.05 * eta[1], -0.03 * eta[1]]], axis=0)
    assert table["psf_eta1"][1] == pytest.approx(mean[0], abs=0.002)
    assert table["psf_eta2"][1] == pytest.approx(mean[1], abs=0.002)
    assert table["psf_size"][1] == pytest.approx(1.7 * 0.263, rel=0.01)


def test_large_objects_are_measured_one_at_a_time_and_alike(folder, expected, monkeypatch):
    monkeypatch.setattr(module, "_PIXELS", {True: 1, False: 1})
    table = catalog("tile.fits")
    for name in ("id", *SAME):
        np.testing.assert_allclose(table[name], expected[1][name], rtol=1e-6, atol=1e-8)


def test_an_interrupted_command_goes_on(folder, expected, monkeypatch):
    measure, done = module._measure_chunk, []

    def measure_or_stop(files, rows, *options):
        done.append(rows)
        if len(done) == 2:
            raise KeyboardInterrupt
        return measure(files, rows, *options)

    monkeypatch.setattr(module, "_measure_chunk", measure_or_stop)
    command = ("tile.fits", "-o", "out.fits", "--chunk", 2)
    assert "2 of 4 galaxies are in out.fits.parts" in run(*command, code=130)
    assert "holds a run with --cutouts all, and this has first" in run(
        *command, "--cutouts", "first", code=1
    )
    assert "resumed    2 of them were measured before" in run(*command)
    assert done[1:] == [slice(2, 4)] * 2
    assert not (folder / "out.fits.parts").exists()
    table = read_catalog("out.fits")
    for name in ("id", *SAME):
        np.testing.assert_allclose(table[name], expected[1][name], rtol=1e-6, atol=1e-8)


def test_other_processes_can_measure_a_part(folder, expected):
    inputs = module.ExposureInputs(files=("tile.fits",)).absolute()
    job = partial(module.measure_part, inputs=inputs, settings=module.ExposureSettings())
    table = pickle.loads(pickle.dumps(job))(Rows(2, 4), report=None)
    assert table["id"].tolist() == [102, 103]
    np.testing.assert_allclose(table["g1"], expected[1]["g1"][2:], atol=1e-8)


def test_all_but_the_first_cutout(folder, cutouts):
    table = catalog("tile.fits", "--cutouts", "epochs")
    assert table["n_exposures"].tolist() == [2, 1, 0, 2]
    np.testing.assert_allclose(table["g1"][[0, 1, 3]], G[[0, 1, 3], 0], atol=2e-5)


def test_bands_are_files_of_the_same_objects(folder, cutouts, expected):
    first = {row: cutouts[row][:1] for row in (0, 1)}
    second = {row: [replace(c, image=2 * c.image) for c in cutouts[row][1:]] for row in (0, 3)}
    for name, part in (("g", first), ("r", second)):
        write_meds(folder / f"{name}.fits", objects_of(part))
    table = catalog("g.fits", "r.fits")
    assert "ra" not in table.colnames
    assert table["n_exposures"].tolist() == [3, 1, 0, 2]
    np.testing.assert_allclose(table["g1"][[0, 1, 3]], G[[0, 1, 3], 0], atol=2e-5)
    np.testing.assert_array_equal(np.isnan(table["flux_1"]), [False, True, True, False])
    assert table["flux_1"][0] == pytest.approx(2 * table["flux_0"][0], rel=0.01)
    # In chunks, some of which have objects of one band only.
    single = catalog("g.fits", "r.fits", "--chunk", 1)
    assert single.colnames == table.colnames
    for name in (*SAME, "flux_0", "flux_1"):
        np.testing.assert_allclose(single[name], table[name], rtol=1e-6, atol=1e-8)


def test_one_broken_object_stops_nothing(folder, expected):
    with fits.open("tile.fits", mode="update") as hdus:
        start = hdus["object_data"].data["start_row"][0]
        for first in start[:3]:
            hdus["image_cutouts"].data[first + SMALL * 20 + 20] = np.nan
        hdus["object_data"].data["dudcol"][1, :2] = np.nan
    table = catalog("tile.fits")
    assert ((np.asarray(table["flags"]) & int(FAILED)) != 0).tolist() == [True, True, True, False]
    assert table["n_used"].tolist() == [0, 0, 0, 3]
    np.testing.assert_allclose(table["g1"][3], expected[1]["g1"][3], atol=1e-8)


def test_an_exposure_with_missing_pixels(folder, cutouts):
    gappy = replace(
        cutouts[0][1], image=cutouts[0][1].image.copy(), bmask=cutouts[0][1].bmask.copy()
    )
    gappy.image[20, 20], gappy.bmask[20, 20] = 1e6, 4
    one = MedsObject(id=1, number=1, cutouts=[cutouts[0][0], gappy])
    write_meds(folder / "gappy.fits", [one])
    for method, used, flags in (("fdnt-ft", 1, 0), ("fdnt-hybrid", 2, int(Flag.FILLED))):
        row = catalog("gappy.fits", "--method", method)[0]
        assert (row["n_exposures"], row["n_used"], row["flags"]) == (2, used, flags)
        np.testing.assert_allclose([row["g1"], row["g2"]], G[0], atol=1e-4)
        assert row["masked_fraction"] == pytest.approx(1 / SMALL**2 / 2)
    row = catalog("gappy.fits", "--bad-bits", 3)[0]
    assert row["masked_fraction"] == 0
    assert not abs(row["g1"] - G[0, 0]) < 0.01


def test_a_psf_and_a_variance_that_are_given(folder, cutouts):
    plain = [replace(c, weight=None, bmask=None, seg=None) for c in cutouts[0][:1]]
    write_meds(folder / "plain.fits", [MedsObject(id=1, cutouts=plain)])
    fits.PrimaryHDU(cutouts[0][0].psf).writeto("psf.fits")
    table = catalog("plain.fits", "--psf", "psf.fits", "--noise-variance", SIGMA**2)
    assert table.meta["PSFIMAGE"] == "psf.fits"
    assert table["g1"][0] == pytest.approx(G[0, 0], abs=2e-5)
    silent = catalog("plain.fits", "--psf", "psf.fits")
    assert np.isnan(silent["snr"][0])
    assert np.isfinite(silent["g1"][0])


def test_no_objects_make_an_empty_catalog(folder, cutouts):
    write_meds(folder / "none.fits", objects_of({})[:2])
    with fits.open("tile.fits") as hdus:
        hdus["object_data"].data = hdus["object_data"].data[:0]
        hdus.writeto("empty.fits")
    assert len(catalog("empty.fits")) == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("no.fits",), "cannot read the MEDS file: no.fits does not exist"),
        (("text.fits",), "cannot read the MEDS file text.fits"),
        (("image.fits",), "image.fits is no MEDS file: it has no extension object_data and no"),
        (("tile.fits", "other.fits"), "other.fits is of other objects than tile.fits"),
        (("tile.fits", "--noise-variance", 1.0), "give no noise variance"),
        (("tile.fits", "--psf", "no.fits"), "cannot read the PSF image: no.fits does not exist"),
        (("tile.fits", "-o", "tile.fits", "--overwrite"), "tile.fits is an input"),
        (("tile.fits", "-o", "image.fits"), "image.fits exists"),
        (("tile.fits", "-o", "c.txt"), "the suffix of c.txt"),
    ],
)
def test_what_is_refused(arguments, message, folder):
    (folder / "text.fits").write_text("no MEDS file\n" * 300)
    fits.PrimaryHDU(np.ones((9, 9))).writeto("image.fits")
    with fits.open("tile.fits") as hdus:
        hdus["object_data"].data["id"] += 1
        hdus.writeto("other.fits")
    before = sorted(folder.iterdir())
    output = () if "-o" in arguments else ("-o", "c.fits")
    said = run(*arguments, *output, code=1)
    assert said.startswith("Error: ")
    assert message in said
    assert said.count("\n") == 1
    assert sorted(folder.iterdir()) == before
