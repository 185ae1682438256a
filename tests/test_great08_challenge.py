"""Directories of the challenge are read as they are, and what is wrong with one is said."""

from __future__ import annotations

import json

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table

from fdnt_xp.errors import CatalogError, FdntError, RangeError, ShapeMismatchError
from fdnt_xp.great08.challenge import read_challenge, set_name, set_number
from fdnt_xp.great08.moffat import MoffatPsf, read_moffat, write_moffat
from fdnt_xp.great08.truth import read_truth

N_X, N_Y, CELL = 4, 3, 40
PIXELS = np.arange(N_X * N_Y * CELL**2, dtype=np.float32).reshape(N_Y * CELL, N_X * CELL)
STAR = np.random.default_rng(0).uniform(1.0, 2.0, (9, 11))


@pytest.fixture
def folder(tmp_path):
    """Two sets, each with its PSF, as an astronomer would have them."""
    for number in (1, 2):
        fits.writeto(tmp_path / f"set000{number}.fit", PIXELS + number)
        fits.writeto(tmp_path / f"psf_{number}.fit", STAR * number)
    (tmp_path / "psf_map.txt").write_text("set psf\nset0001 psf_1\nset0002 psf_2\n")
    return tmp_path


def _map(folder, text):
    (folder / "psf_map.txt").write_text(text)


# --- the directory ----------------------------------------------------------------------


def test_what_is_read(folder):
    challenge = read_challenge(folder)
    assert challenge.directory == folder
    assert (challenge.missing, challenge.unmapped) == ((), ())
    assert [(one.number, one.name) for one in challenge.sets] == [(1, "set0001"), (2, "set0002")]
    for one in challenge.sets:
        stamps = one.read_stamps()
        assert stamps.dtype == np.float32
        assert stamps.dtype.isnative
        assert stamps.shape == (N_X * N_Y, CELL, CELL)
        for i, stamp in enumerate(stamps):
            y, x = i // N_X * CELL, i % N_X * CELL
            np.testing.assert_array_equal(
                stamp, PIXELS[y : y + CELL, x : x + CELL] + np.float32(one.number)
            )
        psf, oversampling = one.read_psf()
        np.testing.assert_array_equal(psf, STAR * one.number)
        assert oversampling == 1.0


@pytest.mark.parametrize(
    "text",
    [
        "1 psf_1\n2 psf_2\n",
        "set0001 psf_1\nset0002 psf_2",
        "# by hand\n\nset_name psf_name\n  set0002.fit\tpsf_2.fit \n\n# half\n0001 psf_1.fit\n",
        "SET PSF\r\nset1 psf_1\r\nset2.fits psf_2.fit\r\n",
    ],
)
def test_spellings_of_the_map(folder, text):
    _map(folder, text)
    sets = read_challenge(folder).sets
    assert [(one.number, one.psf.name) for one in sets] == [(1, "psf_1.fit"), (2, "psf_2.fit")]


def test_psfs_in_a_folder_of_their_own(folder):
    (folder / "psf").mkdir()
    (folder / "psf_1.fit").rename(folder / "psf" / "psf_1.fits")
    (folder / "psf_2.fit").rename(folder / "psf" / "psf_2.fit")
    _map(folder, "1 psf_1\n2 psf_2.fit\n")
    sets = read_challenge(folder).sets
    assert [one.psf.relative_to(folder / "psf").name for one in sets] == ["psf_1.fits", "psf_2.fit"]
    np.testing.assert_array_equal(sets[1].read_psf()[0], 2 * STAR)


def test_a_map_of_another_name(folder):
    (folder / "psf_map.txt").rename(folder / "which.dat")
    with pytest.raises(CatalogError, match=r"PSF map .*psf_map.txt: No such file"):
        read_challenge(folder)
    assert len(read_challenge(folder, psf_map="which.dat").sets) == 2


def test_sets_that_are_missing_and_sets_without_a_psf(folder):
    fits.writeto(folder / "set0012.fit", PIXELS)
    _map(folder, "set psf\n2 psf_2\n7 psf_1\n3 psf_1\n")
    challenge = read_challenge(folder)
    assert [one.number for one in challenge.sets] == [2]
    assert challenge.missing == (3, 7)
    assert challenge.unmapped == ("set0001", "set0012")


def test_what_is_no_set_is_passed_by(folder):
    for name in ("set0003.txt", "settings.fit", ".set0004-0a1b2c3d.fit", "psf0005.fit", "9.fit"):
        (folder / name).touch()
    assert [one.number for one in read_challenge(folder).sets] == [1, 2]
    assert read_challenge(folder).unmapped == ()


def test_names_and_numbers():
    assert set_name(7) == "set0007"
    assert set_name(12345) == "set12345"
    for text in ("7", "0007", "set7", "set0007", "SET0007.FIT", " set0007.fits "):
        assert set_number(text) == 7
    for text in ("", "set", "7a", "psf7", "-7", "7.5", "set0007.txt"):
        assert set_number(text) is None


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("set psf\n", "names no set"),
        ("", "names no set"),
        ("set psf\nset0001 psf_1\nset0001 psf_2\n", "set 1 more than once"),
        ("set psf\nset0001\n", "line 2 of the PSF map .* not 'set0001'"),
        ("set psf\nset0001 psf_1 twice\n", "line 2"),
        ("set psf\none psf_1\n", "line 2 .* not 'one psf_1'"),
    ],
)
def test_bad_maps(folder, text, match):
    _map(folder, text)
    with pytest.raises(CatalogError, match=match):
        read_challenge(folder)


def test_a_map_that_is_no_text(folder):
    (folder / "psf_map.txt").write_bytes(b"\xff\xfe\x00\xd8")
    with pytest.raises(CatalogError, match="it is not text"):
        read_challenge(folder)


def test_bad_directories(folder, tmp_path_factory):
    with pytest.raises(CatalogError, match="does not exist"):
        read_challenge(folder / "nowhere")
    with pytest.raises(CatalogError, match="is not a folder"):
        read_challenge(folder / "psf_map.txt")
    with pytest.raises(CatalogError, match="no image of a set"):
        read_challenge(tmp_path_factory.mktemp("empty"))
    (folder / "set1.fits").touch()
    with pytest.raises(CatalogError, match="are both set 1"):
        read_challenge(folder)


def test_a_psf_that_may_be_either_file(folder):
    write_moffat(MoffatPsf(beta=3, fwhm=2.85), folder / "psf_1.moffat")
    with pytest.raises(CatalogError, match=r"may be psf_1\.fit, psf_1\.moffat: .* suffix"):
        read_challenge(folder)
    _map(folder, "1 psf_1.moffat\n2 psf_2\n")
    assert read_challenge(folder).sets[0].psf.name == "psf_1.moffat"


# --- sets that cannot be read -----------------------------------------------------------


def test_one_bad_image_does_not_spoil_the_others(folder):
    image = folder / "set0001.fit"
    image.write_bytes(image.read_bytes()[:-5000])
    bad, good = read_challenge(folder).sets
    with pytest.raises(CatalogError, match=r"set0001\.fit.*truncated"):
        bad.read_stamps()
    assert good.read_stamps().shape == (12, CELL, CELL)


@pytest.mark.parametrize("content", [b"", b"not FITS at all" * 400])
def test_an_image_that_is_none(folder, content):
    (folder / "set0001.fit").write_bytes(content)
    with pytest.raises(CatalogError, match=r"set0001\.fit"):
        read_challenge(folder).sets[0].read_stamps()


def test_the_wrong_grid(folder):
    with pytest.raises(ShapeMismatchError, match=r"set0001\.fit: .*160 x 120 .* cells of 64"):
        read_challenge(folder, cell=64).sets[0].read_stamps()


def test_a_psf_that_is_not_there(folder):
    (folder / "psf_2.fit").unlink()
    good, bad = read_challenge(folder).sets
    good.read_psf()
    with pytest.raises(CatalogError, match=r"cannot read the PSF: .*psf_2\.fit does not exist"):
        bad.read_psf()


def test_a_finer_star(folder):
    with fits.open(folder / "psf_1.fit", mode="update") as hdus:
        hdus[0].header["OVERSAMP"] = 4
    assert read_challenge(folder).sets[0].read_psf()[1] == 4.0


@pytest.mark.parametrize("value", ["four", 0, -2.0, True])
def test_a_bad_oversampling(folder, value):
    with fits.open(folder / "psf_1.fit", mode="update") as hdus:
        hdus[0].header["OVERSAMP"] = value
    with pytest.raises(CatalogError, match=r"OVERSAMP of .*psf_1\.fit"):
        read_challenge(folder).sets[0].read_psf()


# --- the size of a cell -----------------------------------------------------------------


def test_cells_are_what_is_known_of_them(folder):
    assert {one.cell for one in read_challenge(folder).sets} == {40}
    (folder / "great08.json").write_text(json.dumps({"parameters": {"cell": 20}}))
    assert {one.cell for one in read_challenge(folder).sets} == {20}
    assert len(read_challenge(folder).sets[0].read_stamps()) == 48
    assert {one.cell for one in read_challenge(folder, cell=10).sets} == {10}


def test_an_image_that_says_otherwise(folder):
    with fits.open(folder / "set0001.fit", mode="update") as hdus:
        hdus[0].header["CELL"] = 20
    with pytest.raises(CatalogError, match="cells have 20 pixels, but 40 were given"):
        read_challenge(folder).sets[0].read_stamps()
    assert len(read_challenge(folder, cell=20).sets[0].read_stamps()) == 48


@pytest.mark.parametrize("text", ["{", "[]", "{}", '{"parameters": {}}'])
def test_bad_parameters(folder, text):
    (folder / "great08.json").write_text(text)
    with pytest.raises(CatalogError, match=r"cell size from .*great08\.json"):
        read_challenge(folder)
    assert read_challenge(folder, cell=40).sets


@pytest.mark.parametrize("cell", ["64", 64.5, True, None])
def test_bad_cells_in_the_parameters(folder, cell):
    (folder / "great08.json").write_text(json.dumps({"parameters": {"cell": cell}}))
    with pytest.raises(CatalogError, match="not a number of pixels"):
        read_challenge(folder)


def test_a_cell_too_small(folder):
    with pytest.raises(RangeError, match="cell = 4"):
        read_challenge(folder, cell=4)


# --- analytic PSFs ----------------------------------------------------------------------


def test_a_moffat_is_drawn_with_the_pixel(folder):
    galsim = pytest.importorskip("galsim")
    psf = MoffatPsf(beta=3.0, fwhm=2.85, g=(-0.019, -0.007), trunc=5.7)
    write_moffat(psf, folder / "psf_1a.moffat")
    _map(folder, "1 psf_1a\n2 psf_2\n")
    star, oversampling = read_challenge(folder).sets[0].read_psf()
    assert star.shape == (CELL * oversampling, CELL * oversampling)
    assert star.sum() == pytest.approx(1.0)
    profile = galsim.Moffat(beta=3.0, fwhm=2.85, trunc=5.7).shear(g1=-0.019, g2=-0.007)
    # Every second sample of those half as fine lies on the pixels of an odd image.
    fine = psf.draw(41, 3)[1::3, 1::3]
    drawn = profile.drawImage(nx=41, ny=41, scale=1.0).array
    # GalSim ends the transform at 1e-3 unless told otherwise: 1e-4 of the peak.
    np.testing.assert_allclose(fine * 9, drawn, atol=2e-4 * drawn.max())


def test_a_moffat_goes_to_disk_and_back(tmp_path):
    psf = MoffatPsf(beta=2.5, fwhm=3.1, g=(0.1, -0.2), trunc=9.25)
    write_moffat(psf, tmp_path / "a.moffat")
    assert read_moffat(tmp_path / "a.moffat") == psf
    with pytest.raises(CatalogError, match="exists"):
        write_moffat(psf, tmp_path / "a.moffat")
    with pytest.raises(CatalogError, match=r"must be \.moffat"):
        write_moffat(psf, tmp_path / "a.txt")


def test_shapes_may_be_distortions(tmp_path):
    """e = 2g/(1+g²), by hand: g = 0.5 is e = 0.8."""
    (tmp_path / "a.moffat").write_text("# ours\nfwhm 3 of the round\nbeta 3.5\n\ne1 0.48\ne2 -0.64")
    psf = read_moffat(tmp_path / "a.moffat")
    assert psf.g == pytest.approx((0.3, -0.4))
    assert (psf.beta, psf.fwhm, psf.trunc) == (3.5, 3.0, 0.0)


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("", "no Moffat profile: it has no beta"),
        ("beta 3", "it has no fwhm"),
        ("beta 3\nfwhm 3\ng1 0.1", "it has no g2"),
        ("beta 3\nfwhm 3\ne1 0.1\ne2 0\ng1 0.1\ng2 0", "both g and e"),
        ("beta 3\nfwhm 3\ne1 0.8\ne2 0.6", "not below 1"),
        ("beta 3\nfwhm 3\ng1 0.8\ng2 0.7", r"\|g\|"),
        ("beta 1\nfwhm 3", "beta = 1"),
        ("beta nan\nfwhm 3", "beta = nan"),
        ("beta 3\nfwhm 0", "fwhm = 0"),
        ("beta 3\nfwhm 3\ntrunc 1.2", r"trunc = 1\.2"),
        ("beta 3\nseeing 3", "line 2 .* 'seeing 3'"),
        ("beta three\nfwhm 3", "line 1"),
        ("beta\nfwhm 3", "line 1"),
        ("beta 3\nbeta 3\nfwhm 3", "line 2"),
    ],
)
def test_bad_moffats(tmp_path, text, match):
    (tmp_path / "a.moffat").write_text(text)
    with pytest.raises(CatalogError, match=match):
        read_moffat(tmp_path / "a.moffat")


def test_a_moffat_that_is_not_there(tmp_path):
    with pytest.raises(CatalogError, match="No such file"):
        read_moffat(tmp_path / "a.moffat")


# --- the truth --------------------------------------------------------------------------


def _truth():
    return Table(
        {
            "set": [3, 1, 2],
            "shear": [0, 4, 0],
            "g1": [0.01, -0.02, 0.01],
            "g2": [0.03, 0.04, 0.03],
            "psf": ["a", "b", "c"],
        }
    )


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("truth.ecsv", "ascii.ecsv"),
        ("truth.fits", "fits"),
        ("truth.csv", "ascii.csv"),
        ("truth.txt", "ascii.basic"),
        ("truth.dat", "ascii.commented_header"),
    ],
)
def test_formats_of_the_truth(tmp_path, name, kind):
    _truth().write(tmp_path / name, format=kind)
    truth = read_truth(tmp_path / name)
    assert truth.colnames == ["set", "shear", "g1", "g2", "psf"]
    assert truth["set"].tolist() == [1, 2, 3]
    assert truth["shear"].tolist() == [4, 0, 0]
    assert truth["g1"].tolist() == [-0.02, 0.01, 0.01]
    assert truth["g2"].tolist() == [0.04, 0.03, 0.03]
    assert [str(psf) for psf in truth["psf"]] == ["b", "c", "a"]
    assert truth["set"].dtype == truth["shear"].dtype == np.int64


def test_sets_by_name_and_shears_by_value(tmp_path):
    lines = ["set g1 g2", "set0002 0.01 0.02", "set0001.fit 0.03 0", "set0003 0.01 0.02"]
    (tmp_path / "truth.txt").write_text("\n".join(lines))
    truth = read_truth(tmp_path / "truth.txt")
    assert truth["set"].tolist() == [1, 2, 3]
    assert truth["shear"].tolist() == [1, 0, 0]
    for format_ in ("ascii.ecsv", "fits"):
        path = tmp_path / ("a.ecsv" if format_ == "ascii.ecsv" else "a.fits")
        Table.read(tmp_path / "truth.txt", format="ascii").write(path, format=format_)
        assert read_truth(path)["set"].tolist() == [1, 2, 3]


def test_other_names_are_asked_for_not_guessed(tmp_path):
    table = Table({"set_id": [1, 2], "gamma1": [0.1, 0.2], "gamma2": [0.0, 0.1], "g2": [9.0, 9.0]})
    table.write(tmp_path / "truth.ecsv")
    with pytest.raises(
        CatalogError, match=r"no column 'set', 'g1'; it has set_id, gamma1, gamma2, g2.*columns"
    ):
        read_truth(tmp_path / "truth.ecsv")
    columns = {"set": "set_id", "g1": "gamma1", "g2": "gamma2"}
    truth = read_truth(tmp_path / "truth.ecsv", columns=columns)
    assert truth.colnames == ["set", "shear", "g1", "g2"]
    assert truth["g2"].tolist() == [0.0, 0.1]
    with pytest.raises(CatalogError, match="no column 'group'"):
        read_truth(tmp_path / "truth.ecsv", columns=columns | {"shear": "group"})


def test_text_without_names(tmp_path):
    (tmp_path / "truth.txt").write_text("1 0.01 0.02\n2 0.03 0.04\n")
    columns = {"set": "col1", "g1": "col2", "g2": "col3"}
    assert read_truth(tmp_path / "truth.txt", columns=columns)["g1"].tolist() == [0.01, 0.03]


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"set": [1, 1, 2]}, "set 1 more than once"),
        ({"set": [1, 2, 2.5]}, "set 2.5"),
        ({"set": ["set0001", "psf", "set0003"]}, "a set psf"),
        ({"g1": [0.0, np.nan, 0.0]}, "set 1 .* not finite"),
        ({"g2": ["a", "b", "c"]}, "'g2' .* does not hold numbers"),
        ({"shear": [0, 0, 1]}, "root shear 0 with different shears"),
        ({"shear": [0.5, 1, 0.5]}, "numbers of root shears"),
    ],
)
def test_bad_truths(tmp_path, change, match):
    table = _truth()
    for name, values in change.items():
        table[name] = values
    table.write(tmp_path / "truth.ecsv")
    with pytest.raises(CatalogError, match=match):
        read_truth(tmp_path / "truth.ecsv")


def test_missing_values_are_not_shears(tmp_path):
    (tmp_path / "truth.csv").write_text("set,g1,g2\n1,0.1,\n2,0.1,0.2\n")
    with pytest.raises(CatalogError, match=r"set 1 .* not finite"):
        read_truth(tmp_path / "truth.csv")


def test_truths_that_cannot_be_read(tmp_path):
    with pytest.raises(CatalogError, match="does not exist"):
        read_truth(tmp_path / "truth.ecsv")
    with pytest.raises(CatalogError, match="is a folder"):
        read_truth(tmp_path)
    for name in ("a.ecsv", "a.fits", "a.txt"):
        (tmp_path / name).write_bytes(b"\x00\xff" * 100)
        with pytest.raises(FdntError, match=name):
            read_truth(tmp_path / name)
