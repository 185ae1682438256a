"""Simulated directories are what they say, and what is interrupted comes out the same."""

from __future__ import annotations

import builtins
import errno
import json
import math
import shlex
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
from astropy.io import fits
from click.testing import CliRunner

import fdnt_xp as fx
from fdnt_xp.app import great08_simulate
from fdnt_xp.app.cli import main
from fdnt_xp.data.catalog import read_catalog
from fdnt_xp.data.simulate import NOISE_SIGMA, draw_offsets, draw_pairs, draw_stamp
from fdnt_xp.errors import (
    CatalogError,
    FdntError,
    FdntValueError,
    FdntWarning,
    MissingExtraError,
    RangeError,
)
from fdnt_xp.great08 import populations, simulate
from fdnt_xp.great08.challenge import read_challenge
from fdnt_xp.great08.populations import PSFS, Condition, galaxy_table, seen_galaxies
from fdnt_xp.great08.sets import draw_set, make_simulation
from fdnt_xp.great08.simulate import begin_challenge, write_set
from fdnt_xp.great08.truth import read_truth

galsim = pytest.importorskip("galsim")

SMALL = {"grid": 2, "cell": 24}
"""For tests that do not look at the galaxies."""


def run(*arguments, code=0):
    """Run the command; return its output."""
    words = [w for a in arguments for w in (shlex.split(a) if isinstance(a, str) else [str(a)])]
    result = CliRunner().invoke(main, ["great08", "simulate", *words])
    assert result.exit_code == code, result.output
    return result.output


def simulated(folder, **options):
    """Simulate a challenge without the command line."""
    simulation = make_simulation(**{**SMALL, **options})
    for number in begin_challenge(folder, simulation):
        write_set(folder, simulation, number)
    return simulation


def contents(folder):
    """Return all files of a directory, by name."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def pixels(folder, number):
    return fits.getdata(folder / f"set000{number}.fit")


# --- what is on disk --------------------------------------------------------------------


@pytest.mark.parametrize("branch", ["low-noise", "real-noise"])
def test_it_is_read_back(tmp_path, branch):
    simulation = simulated(tmp_path, branch=branch, n_sets=9, seed=3, oversampling=3)
    challenge = read_challenge(tmp_path)
    assert [one.number for one in challenge.sets] == list(range(1, 10))
    assert (challenge.missing, challenge.unmapped) == ((), ())
    truth = read_truth(tmp_path / "truth.ecsv")
    for one, row in zip(challenge.sets, truth, strict=True):
        drawn = draw_set(simulation, one.number)
        stamps = one.read_stamps()
        assert stamps.shape == (4, 24, 24)
        np.testing.assert_array_equal(stamps[1], drawn.image[:24, 24:])
        np.testing.assert_array_equal(stamps[2], drawn.image[24:, :24])
        assert one.psf.stem == row["psf"] == simulation.condition(one.number).psf
        star, oversampling = one.read_psf()
        assert (star.shape, oversampling) == ((72, 72), 3.0)
        assert (row["g1"], row["g2"]) == simulation.shear(one.number)
        assert row["shear"] == simulation.shear_number(one.number)
        galaxies = read_catalog(tmp_path / "truth" / f"{one.name}.ecsv")
        assert galaxies.colnames == drawn.truth.colnames
        assert all(np.all(galaxies[name] == drawn.truth[name]) for name in galaxies.colnames)
        assert all(column.description for column in galaxies.itercols())


def test_the_header_says_how_the_image_is_divided(tmp_path):
    simulated(tmp_path, n_sets=1)
    header = fits.getheader(tmp_path / "set0001.fit")
    assert (header["BITPIX"], header["CELL"], header["NX"], header["NY"]) == (-32, 24, 2, 2)
    record = json.loads((tmp_path / "great08.json").read_text())
    assert record["parameters"]["seed"] == 1
    assert record["versions"]["galsim"] == galsim.__version__


def test_psf_by_formula(tmp_path):
    """Both kinds are the same PSF; as GalSim has it, turned and stretched where they should be."""
    options = {"branch": "real-noise", "n_sets": 9}
    for kind in ("star", "moffat"):
        simulated(tmp_path / kind, psf_kind=kind, oversampling=4, **options)
    stars, formulae = (read_challenge(tmp_path / kind).sets for kind in ("star", "moffat"))
    for star, formula in zip(stars, formulae, strict=True):
        assert formula.psf.suffix == ".moffat"
        assert formula.read_psf()[1] == 4.0
        np.testing.assert_allclose(formula.read_psf()[0], star.read_psf()[0], atol=1e-12)
    shapes = {}
    for one in stars:
        shape = galsim.hsm.FindAdaptiveMom(galsim.Image(one.read_psf()[0])).observed_shape
        shapes[one.psf.stem] = np.array([shape.g1, shape.g2])
    assert shapes.keys() == PSFS.keys()
    # The pixel and the round weight take a little of the shape.
    np.testing.assert_allclose(shapes["psf_fiducial"], [-0.019, -0.007], atol=1e-3)
    np.testing.assert_allclose(shapes["psf_rotated"], -shapes["psf_fiducial"], atol=1e-5)
    np.testing.assert_allclose(shapes["psf_elongated"], 2 * shapes["psf_fiducial"], atol=3e-4)


# --- random numbers ---------------------------------------------------------------------


def test_one_seed_one_directory(tmp_path):
    for name, seed in (("a", 5), ("b", 5), ("c", 6)):
        simulated(tmp_path / name, n_sets=2, seed=seed)
    first, again, other = (contents(tmp_path / name) for name in "abc")
    assert first == again
    assert first.keys() == other.keys()
    same = {name for name in first if first[name] == other[name]}
    assert same == {"psf_fiducial.fit", "psf_map.txt"}
    assert np.all(pixels(tmp_path / "a", 1) != pixels(tmp_path / "a", 2))


def test_a_set_depends_on_the_seed_and_its_number_alone(tmp_path):
    simulated(tmp_path / "a", n_sets=2)
    simulated(tmp_path / "b", n_sets=3)
    np.testing.assert_array_equal(pixels(tmp_path / "a", 2), pixels(tmp_path / "b", 2))


def test_processes_do_not_matter(tmp_path):
    run("--sets 3 --grid 2 --cell 24 -q -o", tmp_path / "one")
    run("--sets 3 --grid 2 --cell 24 -q --jobs 2 -o", tmp_path / "two")
    assert contents(tmp_path / "one") == contents(tmp_path / "two")


# --- shears -----------------------------------------------------------------------------


def test_shears_fill_the_disc():
    simulation = make_simulation(n_sets=4000, max_shear=0.04)
    g = np.array([simulation.shear(number) for number in range(1, 4001)])
    square = np.sum(g**2, axis=1) / 0.04**2
    assert square.max() <= 1
    # Uniform in the disc: |g|² is uniform on (0, max²), and no direction is preferred.
    assert abs(square.mean() - 0.5) < 4 / math.sqrt(12 * 4000)
    assert abs(np.mean(square > 0.25) - 0.75) < 4 * math.sqrt(0.75 * 0.25 / 4000)
    assert np.all(np.abs(g.mean(axis=0)) < 4 * 0.02 / math.sqrt(4000))
    assert len(np.unique(g, axis=0)) == 4000


def test_every_low_noise_set_has_its_shear_unless_told():
    simulation = make_simulation()
    assert (simulation.n_sets, simulation.n_shears, simulation.snr) == (15, 15, 200)
    assert [simulation.shear_number(n) for n in range(1, 16)] == list(range(15))
    shared = make_simulation(n_shears=5)
    assert [shared.shear_number(n) for n in range(1, 16)] == [0, 1, 2, 3, 4] * 3
    assert len({shared.shear(n) for n in range(1, 16)}) == 5
    assert shared.shear(1) == simulation.shear(1)


def test_real_noise_has_every_condition_with_every_shear():
    simulation = make_simulation("real-noise")
    numbers = range(1, simulation.n_sets + 1)
    pairs = {(simulation.condition(n).name, simulation.shear_number(n)) for n in numbers}
    assert len(pairs) == simulation.n_sets == 27
    assert len({name for name, _ in pairs}) == 9
    conditions = simulation.conditions
    assert {one.snr for one in conditions} == {10, 20, 40}
    assert {one.size_ratio for one in conditions} == {1.22, 1.4, 1.6}
    assert {one.psf for one in conditions} == PSFS.keys()
    assert {one.galaxies for one in conditions} == {"single", "aligned", "askew"}
    assert {one.snr for one in make_simulation("real-noise", snr=30).conditions} == {15, 30, 60}
    for one in conditions[1:]:  # each differs from the first in one thing
        changed = [name for name, value in vars(one).items() if value != vars(conditions[0])[name]]
        assert len(changed) == 2  # and in its name


# --- galaxies ---------------------------------------------------------------------------

LOW = Condition(name="low", snr=200.0)
ALIGNED = Condition(name="aligned", snr=20.0, galaxies="aligned")
ASKEW = Condition(name="askew", snr=20.0, galaxies="askew")


def population(condition, n_gal=2000, shear=(0.03, -0.02), seed=2):
    """Return pairs and the truth table of a set."""
    rng = np.random.default_rng(seed)
    pairs = draw_pairs(rng, n_gal)
    return pairs, galaxy_table(rng, pairs, condition, shear)


@pytest.mark.parametrize("number", [1, 2, 5, 9])
def test_signal_to_noise_and_noise(number):
    """From the image: with next to no noise, and with next to nothing else."""
    simulation = make_simulation("real-noise", n_sets=9, **SMALL)
    n = 0.5 if number == 2 else 1.0
    bright = draw_set(replace(simulation, snr=1e7), number).image.astype(np.float64)
    cells = bright.reshape(2, 24, 2, 24).swapaxes(1, 2).reshape(4, -1)
    snr = np.sqrt(np.sum(cells**2, axis=1)) / NOISE_SIGMA
    np.testing.assert_allclose(snr, n * 1e7, rtol=1e-6)
    # The noise does not depend on the galaxies.
    dark = draw_set(replace(simulation, snr=1e-6), number).image
    seen = draw_set(replace(simulation, snr=20.0), number).image
    snr = np.sqrt(np.sum((seen - dark).astype(np.float64) ** 2)) / NOISE_SIGMA / 2
    assert snr == pytest.approx(20 * n, rel=1e-4)
    assert dark.std() == pytest.approx(NOISE_SIGMA, rel=4 / math.sqrt(2 * dark.size))
    assert abs(dark.mean()) < 4 * NOISE_SIGMA / 48


def test_noise_is_white():
    dark = draw_set(make_simulation(grid=4, cell=64, snr=1e-6), 1).image.astype(np.float64)
    for shifted in (np.roll(dark, 1, axis=0), np.roll(dark, 1, axis=1), np.roll(dark, 64, axis=0)):
        assert abs(np.mean(dark * shifted)) < 4 * NOISE_SIGMA**2 / 256


def test_noise_is_new_in_each_set_and_with_each_seed():
    simulation = make_simulation(grid=2, cell=64, snr=1e-6)
    first = draw_set(simulation, 1).image.astype(np.float64)
    for other in (draw_set(simulation, 2), draw_set(replace(simulation, seed=2), 1)):
        assert abs(np.mean(first * other.image)) < 4 * NOISE_SIGMA**2 / 128


@pytest.mark.parametrize("condition", [LOW, ALIGNED, ASKEW], ids=lambda one: one.name)
def test_pairs_are_the_same_galaxy_turned(condition):
    pairs, table = population(condition)
    first, second = (np.flatnonzero(pairs.turned == turned) for turned in (False, True))
    first, second = (rows[np.argsort(pairs.number[rows])] for rows in (first, second))
    np.testing.assert_array_equal(table["pair"][first], np.arange(1000))
    np.testing.assert_array_equal(table["pair"][second], np.arange(1000))
    assert np.all(table["kind"][first] == table["kind"][second])
    shapes = ["intrinsic_g"] + (["bulge_g"] if condition is not LOW else [])
    for name in shapes:
        shape = table[f"{name}1"] + 1j * table[f"{name}2"]
        np.testing.assert_allclose(shape[second], -shape[first], atol=1e-15)
    if condition is not LOW:
        way = table["bulge_dx"] + 1j * table["bulge_dy"]
        np.testing.assert_allclose(way[second], 1j * way[first], atol=1e-15)
    # At random cells: neither side by side nor in order.
    assert np.mean(pairs.turned[:1000]) == pytest.approx(0.5, abs=0.08)
    assert np.mean(np.abs(np.diff(table["pair"])) <= 1) < 0.02


def test_half_of_each_kind_in_one_image():
    _, table = population(LOW)
    assert sum(table["kind"] == "exp") == sum(table["kind"] == "dev") == 1000


def test_centroids_are_uniform_in_a_disc_of_one_pixel():
    simulation = make_simulation(grid=20, cell=24, snr=20)
    table = draw_set(simulation, 1).truth
    row, column = np.divmod(np.arange(400), 20)
    x, y = table["x"] - (24 * column + 11.5), table["y"] - (24 * row + 11.5)
    square = np.asarray(x**2 + y**2)
    assert square.max() <= 1
    assert abs(square.mean() - 0.5) < 4 / math.sqrt(12 * 400)
    assert max(abs(np.mean(x)), abs(np.mean(y))) < 4 * 0.5 / math.sqrt(400)


@pytest.mark.parametrize("condition", [LOW, ALIGNED, ASKEW], ids=lambda one: one.name)
def test_galaxies_have_unit_flux_and_their_centroid_in_the_middle(condition):
    _, table = population(condition, n_gal=8)
    for seen in seen_galaxies(table, condition, (0.03, -0.02)):
        assert seen.flux == pytest.approx(1.0)
        assert (seen.centroid.x, seen.centroid.y) == pytest.approx((0.0, 0.0), abs=1e-12)


def test_light_is_where_the_truth_says():
    """Under a weight that follows it, to a tenth of what centroids are spread over."""
    simulation = make_simulation("real-noise", n_sets=9, grid=4, cell=48, snr=1e4)
    drawn = draw_set(simulation, 9)
    cells = drawn.image.astype(np.float64).reshape(4, 48, 4, 48).swapaxes(1, 2).reshape(16, 48, 48)
    number = np.arange(16)
    for i, stamp in enumerate(cells):
        moments = galsim.hsm.FindAdaptiveMom(galsim.Image(stamp, xmin=0, ymin=0))
        x, y = drawn.truth["x"][i] - number[i] % 4 * 48, drawn.truth["y"][i] - number[i] // 4 * 48
        # The bulge is seen more than the disc, and up to three times 0.3 pixels off it.
        assert math.hypot(moments.moments_centroid.x - x, moments.moments_centroid.y - y) < 0.25


@pytest.mark.parametrize("galaxies", ["single", "aligned"])
@pytest.mark.parametrize("ratio", [1.22, 1.4, 1.6])
def test_widths_have_the_ratio(ratio, galaxies):
    """As GalSim measures it on a drawn image of round galaxies."""
    condition = Condition(name="", snr=20.0, size_ratio=ratio, galaxies=galaxies)
    _, table = population(condition, n_gal=4)
    for name in ("intrinsic_g1", "intrinsic_g2", "bulge_g1", "bulge_g2"):
        if name in table.colnames:
            table[name][:] = 0.0
    PSFS["psf_round"] = (0.0, 0.0)
    try:
        seen = list(seen_galaxies(table, replace(condition, psf="psf_round"), (0.0, 0.0)))
    finally:
        del PSFS["psf_round"]
    for one in seen:
        image = one.drawImage(nx=401, ny=401, scale=0.05, method="no_pixel")
        # The transform ends where it is 1e-3.
        assert image.calculateFWHM() == pytest.approx(ratio * 2.85, rel=3e-3)


def test_aligned_components_are_alike():
    _, table = population(ALIGNED)
    for i in (1, 2):
        np.testing.assert_allclose(table[f"bulge_g{i}"], table[f"intrinsic_g{i}"], atol=1e-15)
    assert not np.any(table["bulge_dx"])
    assert not np.any(table["bulge_dy"])
    assert set(table["kind"]) == {"exp+dev"}


def test_askew_components_are_not():
    n_pairs = 1000
    pairs, table = population(ASKEW, n_gal=2 * n_pairs)
    disc = table["intrinsic_g1"] + 1j * table["intrinsic_g2"]
    bulge = table["bulge_g1"] + 1j * table["bulge_g2"]
    np.testing.assert_allclose(np.abs(bulge), np.abs(disc), rtol=1e-12)
    one = ~pairs.turned  # the others repeat them
    angle = np.degrees(0.5 * np.angle(bulge[one] / disc[one]))
    error = 1 / math.sqrt(2 * n_pairs)
    # Angles beyond 90 degrees, 4.5 sigma, come back from the other side: none.
    assert np.std(angle) == pytest.approx(populations.MISALIGNMENT, rel=4 * error)
    assert abs(np.mean(angle)) < 4 * populations.MISALIGNMENT / math.sqrt(n_pairs)
    for name in ("bulge_dx", "bulge_dy"):
        assert np.std(table[name][one]) == pytest.approx(populations.DISPLACEMENT, rel=4 * error)
        assert abs(np.mean(table[name][one])) < 4 * populations.DISPLACEMENT / math.sqrt(n_pairs)


def test_askew_components_are_drawn_so():
    """The drawn image is that of disc and bulge where the table has them."""
    shear = galsim.Shear(g1=0.03, g2=-0.02)
    _, table = population(ASKEW, n_gal=2)
    row = table[0]
    disc = galsim.Exponential(half_light_radius=row["half_light_radius"], flux=0.5)
    bulge = galsim.DeVaucouleurs(half_light_radius=row["bulge_half_light_radius"], flux=0.5)
    disc = disc.shear(g1=row["intrinsic_g1"], g2=row["intrinsic_g2"])
    bulge = bulge.shear(g1=row["bulge_g1"], g2=row["bulge_g2"])
    galaxy = disc + bulge.shift(row["bulge_dx"], row["bulge_dy"])
    galaxy = galaxy.shift(-0.5 * row["bulge_dx"], -0.5 * row["bulge_dy"]).shear(shear)
    psf = galsim.Moffat(beta=3, fwhm=2.85, trunc=5.7).shear(g1=-0.019, g2=-0.007)
    expected = galsim.Convolve([galaxy, psf]).drawImage(nx=48, ny=48, scale=1.0).array
    seen = next(iter(seen_galaxies(table, ASKEW, (0.03, -0.02))))
    stamp, flux = draw_stamp(seen, 48, (0.0, 0.0), 20.0)
    np.testing.assert_allclose(stamp / flux, expected, atol=2e-4 * expected.max())


@pytest.mark.parametrize("condition", [LOW, ASKEW], ids=lambda one: one.name)
def test_drawn_to_a_ten_thousandth_of_the_peak(condition):
    """Beside transforms ten times longer; GalSim's own default accuracy is 5e-3 of the flux."""
    tight = galsim.GSParams(
        folding_threshold=5e-4, maxk_threshold=1e-4, kvalue_accuracy=1e-6, maximum_fft_size=32768
    )
    _, table = population(condition, n_gal=8)
    offsets = draw_offsets(np.random.default_rng(0), 8)
    quick, exact = (
        [
            draw_stamp(seen, 64, offset, 200.0)[0]
            for seen, offset in zip(
                seen_galaxies(table, condition, (0.03, -0.02), gsparams=gsparams),
                offsets,
                strict=True,
            )
        ]
        for gsparams in (None, tight)
    )
    for one, other in zip(quick, exact, strict=True):
        assert np.abs(one - other).max() < 1.2e-4 * other.max()


@pytest.mark.parametrize(
    ("branch", "number", "psf_kind"), [("low-noise", 1, "star"), ("real-noise", 9, "moffat")]
)
def test_the_shear_comes_back(tmp_path, branch, number, psf_kind):
    """From the directory, by the population null; the pairs have no shape of their own.

    What 48 pixels cut off the wings of 64 galaxies is worth a few 1e-4, as much as the noise.
    """
    options = {"n_sets": 9, "grid": 8, "cell": 48, "snr": 2e4, "oversampling": 2, "seed": 4}
    simulation = make_simulation(branch, psf_kind=psf_kind, **options)
    begin_challenge(tmp_path, simulation)
    write_set(tmp_path, simulation, number)
    challenge = read_challenge(tmp_path)
    assert [one.number for one in challenge.sets] == [number]
    assert len(challenge.missing) == 8
    star, oversampling = challenge.sets[0].read_psf()
    psf = fx.Psf.from_image(star, oversampling=oversampling)
    found = fx.population_null(challenge.sets[0].read_stamps().astype(np.float64), psf)
    row = read_truth(tmp_path / "truth.ecsv")[number - 1]
    assert np.hypot(row["g1"], row["g2"]) > 0.01  # or nothing would be tested
    np.testing.assert_allclose(found.g, [row["g1"], row["g2"]], atol=5e-4)


# --- interrupted, refused, broken -------------------------------------------------------


def test_going_on_is_as_if_never_stopped(tmp_path, monkeypatch):
    simulated(tmp_path / "whole", n_sets=3)
    draw = simulate.draw_set

    def interrupted(simulation, number):
        if number == 2:
            raise KeyboardInterrupt
        return draw(simulation, number)

    monkeypatch.setattr(simulate, "draw_set", interrupted)
    arguments = ("--sets 3 --grid 2 --cell 24 -o", tmp_path / "broken")
    assert "nothing unfinished was left behind" in run(*arguments, code=130)
    challenge = read_challenge(tmp_path / "broken")
    assert [one.number for one in challenge.sets] == [1]
    assert challenge.missing == (2, 3)

    drawn = []
    monkeypatch.setattr(
        simulate, "draw_set", lambda s, number: drawn.append(number) or draw(s, number)
    )
    output = run(*arguments)
    assert drawn == [2, 3]
    assert "finished   1 sets were there already" in output
    assert "drawn      2 sets" in output
    assert contents(tmp_path / "broken") == contents(tmp_path / "whole")
    assert "drawn " not in run(*arguments)
    assert drawn == [2, 3]


def test_killed_and_begun_again(tmp_path):
    """A real process, killed without warning while it draws."""
    options = ["--sets", "3", "--grid", "16", "--cell", "48", "-o"]
    command = [sys.executable, "-c", "from fdnt_xp.app.cli import main; main()"]
    process = subprocess.Popen([*command, "great08", "simulate", *options, tmp_path / "broken"])
    try:
        deadline = time.monotonic() + 120
        while not (tmp_path / "broken" / "set0001.fit").exists():
            assert process.poll() is None
            assert time.monotonic() < deadline
            time.sleep(0.01)
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    left = [one.number for one in read_challenge(tmp_path / "broken").sets]
    assert 1 in left
    assert 3 not in left
    for name in ("broken", "whole"):
        run(*options, tmp_path / name)
    assert contents(tmp_path / "broken") == contents(tmp_path / "whole")


def test_what_a_killed_process_left_is_nothing(tmp_path):
    simulation = simulated(tmp_path, n_sets=1)
    half = (tmp_path / "set0001.fit").read_bytes()[:4000]
    (tmp_path / "set0001.fit").unlink()
    leftovers = [tmp_path / ".set0001-0a1b2c3d.fit", tmp_path / "truth" / ".set0001-0a1b2c3d.ecsv"]
    for path in leftovers:
        path.write_bytes(half)
    with pytest.raises(CatalogError, match="no image of a set"):
        read_challenge(tmp_path)
    list(great08_simulate.run_simulate(str(tmp_path), simulation))
    assert not any(path.exists() for path in leftovers)
    assert len(read_challenge(tmp_path).sets[0].read_stamps()) == 4


@pytest.mark.parametrize("what", ["image", "truth", "map"])
def test_a_full_disk(tmp_path, monkeypatch, what):
    """Half a file is written, then the disk is full: nothing of it stays, and one can go on."""
    simulated(tmp_path / "whole", n_sets=2)
    write, write_table = fits.PrimaryHDU.writeto, simulate.write_catalog
    write_text = type(tmp_path).write_text

    def full(path):
        path.write_bytes(b"SIMPLE" * 100)
        raise OSError(errno.ENOSPC, "No space left on device")

    def image(hdu, path, *rest, **options):
        return full(path) if "set0002" in path.name else write(hdu, path, *rest, **options)

    def table(rows, path, **options):
        if path.name != "set0002.ecsv":
            return write_table(rows, path, **options)
        with simulate.new_file(path, **options) as temporary:
            return full(temporary)

    def text(path, content, **options):
        return full(path) if "psf_map" in path.name else write_text(path, content, **options)

    with monkeypatch.context() as patch:
        patch.setattr(fits.PrimaryHDU, "writeto", image) if what == "image" else None
        patch.setattr(simulate, "write_catalog", table) if what == "truth" else None
        patch.setattr(type(tmp_path), "write_text", text) if what == "map" else None
        output = run("--sets 2 --grid 2 --cell 24 -o", tmp_path / "full", code=1)
    assert "No space left on device" in output
    assert "Traceback" not in output
    present = contents(tmp_path / "full")
    assert not [name for name in present if "/." in f"/{name}"]
    assert ("set0001.fit" in present) == (what != "map")
    assert "set0002.fit" not in present
    whole = contents(tmp_path / "whole")
    assert all(whole[name] == content for name, content in present.items())
    run("--sets 2 --grid 2 --cell 24 -o", tmp_path / "full")
    assert contents(tmp_path / "full") == whole


def test_a_directory_with_other_parameters_is_refused(tmp_path):
    simulated(tmp_path, n_sets=1)
    before = contents(tmp_path)
    output = run("--sets 1 --grid 2 --cell 24 --seed 7 --snr 100 -o", tmp_path, code=1)
    error = next(line for line in output.splitlines() if line.startswith("Error: "))
    assert "was begun with other parameters: snr = 200.0 (now 100.0), seed = 1 (now 7)" in error
    assert contents(tmp_path) == before


def test_a_directory_of_something_else_is_refused(tmp_path):
    (tmp_path / "set0001.fit").write_bytes(b"precious")
    with pytest.raises(CatalogError, match=r"not empty .* set0001\.fit but no great08\.json"):
        simulated(tmp_path)
    assert contents(tmp_path) == {"set0001.fit": b"precious"}
    with pytest.raises(CatalogError, match="cannot make the folder"):
        simulated(tmp_path / "set0001.fit")


@pytest.mark.parametrize("text", ["{", "[]", "{}"])
def test_a_broken_record_is_refused(tmp_path, text):
    simulated(tmp_path, n_sets=1)
    (tmp_path / "great08.json").write_text(text)
    with pytest.raises(CatalogError, match=r"cannot read .*great08\.json"):
        simulated(tmp_path, n_sets=1)


def test_other_versions_are_warned_of(tmp_path):
    simulated(tmp_path, n_sets=1)
    path = tmp_path / "great08.json"
    record = json.loads(path.read_text())
    record["versions"]["galsim"] = "1.0"
    path.write_text(json.dumps(record))
    with pytest.warns(FdntWarning, match=r"drawn with .*galsim 1\.0"):
        simulated(tmp_path, n_sets=1)


@pytest.mark.parametrize(
    ("options", "error", "match"),
    [
        ({"branch": "no-noise"}, FdntValueError, "branch must be low-noise or real-noise"),
        ({"psf_kind": "airy"}, FdntValueError, "psf_kind must be star or moffat"),
        ({"grid": 3}, FdntValueError, "grid must be even, not 3"),
        ({"grid": 0}, FdntValueError, "grid must be even"),
        ({"cell": 4}, RangeError, "cell = 4"),
        ({"snr": 0.0}, RangeError, "snr = 0"),
        ({"snr": math.nan}, RangeError, "snr = nan"),
        ({"seed": -1}, RangeError, "seed = -1"),
        ({"n_sets": 0}, RangeError, "n_sets = 0"),
        ({"n_shears": 0}, RangeError, "n_shears = 0"),
        ({"max_shear": 0.5}, RangeError, "max_shear"),
        ({"max_shear": -0.1}, RangeError, "max_shear"),
        ({"oversampling": 0}, RangeError, "oversampling = 0"),
    ],
)
def test_bad_simulations(options, error, match):
    with pytest.raises(error, match=match):
        make_simulation(**options)


def test_bad_options_are_one_line(tmp_path):
    output = run("--grid 3 -o", tmp_path / "a", code=1)
    assert output == "Error: galaxies come in pairs: grid must be even, not 3\n"
    assert "jobs = 0" in run("--jobs 0 --sets 1 --grid 2 -o", tmp_path / "a", code=1)
    assert "low-noise" in run("--branch none -o", tmp_path / "a", code=2)
    assert not (tmp_path / "a").exists()


def test_report_and_quiet(tmp_path):
    arguments = "--sets 2 --grid 2 --cell 24 --branch real-noise -o"
    lines = run(arguments, tmp_path / "a").splitlines()
    assert lines[0] == "simulating 2 sets of 4 galaxies, real-noise, S/N 20, 1 shears"
    assert lines[-1] == f"written    {tmp_path / 'a'}"
    assert run(arguments, tmp_path / "b", "-q") == ""


def test_a_worker_that_fails_ends_it(tmp_path, monkeypatch):
    monkeypatch.setattr(
        great08_simulate, "_draw_one", lambda *_, **__: great08_simulate.Failure("it died")
    )
    with pytest.raises(FdntError, match="set 1 could not be drawn: it died"):
        list(great08_simulate.run_simulate(str(tmp_path), make_simulation(n_sets=2, **SMALL)))


def test_without_galsim_the_extra_is_named(tmp_path, monkeypatch):
    real = builtins.__import__

    def without(name, *rest):
        if name == "galsim":
            raise ImportError(name)
        return real(name, *rest)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(MissingExtraError, match=r"fdnt-xp\[sim\]"):
        simulated(tmp_path / "new")
    assert not (tmp_path / "new").exists()
