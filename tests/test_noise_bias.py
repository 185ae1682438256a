"""Tests of noise bias: what is drawn, what is refused, what is written."""

from __future__ import annotations

import builtins
import importlib.util
import json
import math
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

import fdnt_xp as fx
from fdnt_xp.app.check import STYLES, parse_radius, plot_biases
from fdnt_xp.app.cli import main
from fdnt_xp.data.noise_bias import SYMMETRIES, NoiseBias, noise_bias
from fdnt_xp.data.noise_estimators import ESTIMATORS, Estimator
from fdnt_xp.data.other_codes import Found, NoisyStamps, fpfs_shear, turn_quarter
from fdnt_xp.data.versions import Population, draw_versions
from fdnt_xp.errors import FdntValueError, MissingExtraError, RangeError

pytest.importorskip("galsim")

N_GAL = 12
NOISELESS = 1e6
SHEAR = 0.03
needs_anacal = pytest.mark.skipif(
    importlib.util.find_spec("anacal") is None, reason="AnaCal is not installed"
)


@pytest.fixture(scope="module")
def versions():
    return draw_versions(Population(n_gal=N_GAL, shear=SHEAR, seed=3))


@pytest.fixture(scope="module")
def mixed():
    return draw_versions(Population(kind="mixed", radius=(1.3, 2.3), n_gal=N_GAL))


@pytest.fixture
def seen(monkeypatch):
    """The stamps that an estimator "spy" is given, which finds the shear 0."""
    stamps: list[NoisyStamps] = []

    def spy(batch, _settings):
        stamps.append(batch)
        return Found(g=np.zeros(2), sigma_g=0.3, n_used=len(batch.pixels))

    monkeypatch.setitem(ESTIMATORS, "spy", Estimator(text="", measure=spy))
    return stamps


# --- what is drawn ----------------------------------------------------------------------


def test_turned_galaxies_with_a_round_psf_are_turned_images():
    drawn = draw_versions(Population(n_gal=4, psf_e=0.0)).stamps
    # Shear -g on the turned galaxy is shear +g on the galaxy, turned.
    np.testing.assert_allclose(drawn[:, 1, 1], turn_quarter(drawn[:, 0, 0]), atol=2e-6)
    np.testing.assert_allclose(drawn[:, 1, 0], turn_quarter(drawn[:, 0, 1]), atol=2e-6)


def test_the_psf_is_not_turned_and_the_shear_has_its_sign(versions):
    star = fx.Psf.from_image(versions.psf_images[0])
    eta = np.stack(
        [
            [fx.measure_shapes(versions.stamps[:, turn, minus], star).eta for minus in (0, 1)]
            for turn in (0, 1)
        ]
    )
    # Without the PSF the turned galaxy has the opposite shape, but for the shear.
    np.testing.assert_allclose(eta[1, 0], -eta[0, 1], atol=1e-4)
    np.testing.assert_allclose(eta[1, 1], -eta[0, 0], atol=1e-4)
    assert np.mean(eta[:, 0] - eta[:, 1], axis=(0, 1)) == pytest.approx(
        [4 * SHEAR, 0], rel=0.3, abs=0.02
    )


def test_offsets_are_those_of_the_images(versions):
    star = fx.Psf.from_image(versions.psf_images[0])
    for turn in (0, 1):
        found = fx.measure_shapes(versions.stamps[:, turn, 0], star).centroid
        np.testing.assert_allclose(found - 23.5, versions.offsets[:, turn], atol=1e-3)


def test_mixed_galaxies_differ_in_flux_and_psf(mixed):
    flux = mixed.stamps.sum(axis=(-2, -1))
    assert 2.0 < flux.max() / flux.min() < 7.0
    assert len(mixed.psf_images) == 20
    assert len(np.unique(mixed.psf_of)) > 3


def test_the_same_seed_draws_the_same(versions):
    again = draw_versions(replace(versions.population))
    np.testing.assert_array_equal(again.stamps, versions.stamps)


@pytest.mark.parametrize(
    "wrong",
    [
        {"kind": "spiral"},
        {"radius": 0.0},
        {"radius": (2.0, 1.0)},
        {"radius": 20.0},
        {"psf_e": 0.9},
        {"shear": 0.0},
        {"shear": math.nan},
        {"n_gal": 1},
    ],
)
def test_refuses_what_cannot_be_drawn(wrong):
    with pytest.raises(FdntValueError, match=next(iter(wrong))):
        Population(**wrong)


# --- the noise --------------------------------------------------------------------------


def test_noise_is_shared_by_the_versions(versions, seen):
    noise_bias(versions, 10.0, ["spy"], n_stamps=1, batch=N_GAL)
    plus, minus = seen[:2]
    noise = []
    for sign, stamps in enumerate((plus, minus)):
        clean = np.concatenate([versions.stamps[:, turn, sign] for turn in (0, 1, 0, 1)])
        noise.append((stamps.pixels - clean).reshape(len(SYMMETRIES), N_GAL, 48, 48))
    np.testing.assert_allclose(noise[0], noise[1], atol=1e-12)
    first = noise[0][0]
    assert np.std(first) == pytest.approx(math.sqrt(plus.variance), rel=0.02)
    for version, wanted in zip(
        noise[0][1:], (turn_quarter(first), -first, -turn_quarter(first)), strict=True
    ):
        np.testing.assert_allclose(version, wanted, atol=1e-12)
    assert plus.symmetry.reshape(4, N_GAL)[:, 0].tolist() == [0, 1, 4, 5]
    assert np.unique(plus.identifiers).tolist() == list(range(N_GAL))


def test_realisations_have_other_noise_and_other_identifiers(versions, seen):
    noise_bias(versions, 10.0, ["spy"], n_stamps=1, batch=N_GAL)
    assert not set(seen[0].identifiers) & set(seen[2].identifiers)
    assert not np.any(seen[0].pixels == seen[2].pixels)
    assert seen[0].seed != seen[2].seed


def test_snr_is_that_of_the_mean_galaxy(mixed, seen):
    noise_bias(mixed, 20.0, ["spy"], n_stamps=1, batch=N_GAL)
    mean = np.mean(np.sum(mixed.stamps**2, axis=(-2, -1)))
    assert math.sqrt(mean / seen[0].variance) == pytest.approx(20.0)


def test_counts(versions, seen):
    (result,) = noise_bias(versions, 10.0, ["spy"], n_stamps=8 * N_GAL * 3 - 1, batch=N_GAL)
    assert (result.n_batches, result.n_stamps, len(seen)) == (3, 24 * N_GAL, 6)
    assert result.m == -1.0  # nothing came back
    assert result.unused == 0.0


# --- what comes back --------------------------------------------------------------------


@pytest.mark.parametrize("name", ["null", "null-plain", "null-eta", "responses"])
def test_without_noise_there_is_no_bias(versions, name):
    (result,) = noise_bias(versions, NOISELESS, [name], n_stamps=1, batch=N_GAL, padding=2)
    # Responses are of second order in the shear.
    assert abs(result.m) < (3e-4 if name == "responses" else 1e-4)
    assert max(map(abs, result.c)) < 1e-6
    assert result.unused == 0.0
    assert 0.15 < result.sigma_g < 0.4


def test_shapes_of_few_galaxies_are_near(versions):
    (result,) = noise_bias(versions, 1000.0, ["shapes"], n_stamps=1, batch=N_GAL)
    assert abs(result.m) < 0.1  # their responsivity is that of a dozen galaxies


def test_regauss_is_known_to_be_off_by_per_cents(versions):
    (result,) = noise_bias(versions, 1000.0, ["hsm"], n_stamps=1, batch=N_GAL)
    assert 1e-3 < abs(result.m) < 0.1
    assert result.c[0] > 1e-4


@needs_anacal
def test_anacal_is_right_to_a_per_mille_or_two(versions, mixed):
    (result,) = noise_bias(versions, 1000.0, ["anacal"], n_stamps=1, batch=N_GAL)
    assert abs(result.m) < 2e-3
    (result,) = noise_bias(mixed, 1000.0, ["anacal"], n_stamps=1, batch=N_GAL)
    assert abs(result.m) < 5e-3


def test_without_anacal_it_says_what_to_install(monkeypatch):
    real = builtins.__import__

    def without(name, *arguments, **options):
        if name == "anacal":
            raise ImportError(name)
        return real(name, *arguments, **options)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(MissingExtraError, match="pip install"):
        fpfs_shear(None, np.zeros((1, 8, 8)))


def test_the_same_seed_gives_the_same(versions):
    first, again = (noise_bias(versions, 20.0, n_stamps=1, batch=N_GAL)[0] for _ in range(2))
    other = noise_bias(versions, 20.0, n_stamps=1, batch=N_GAL, seed=1)[0]
    assert (first.m, first.c) == (again.m, again.c)
    assert first.m != other.m


def test_cuts(versions, seen):
    cut = fx.Cut(quantity="snr", low=13.0)
    options = {"n_stamps": 1, "batch": N_GAL}
    results = noise_bias(versions, 15.0, ["null", "responses"], cut=cut, **options)
    assert all(0.02 < result.unused < 0.98 for result in results)
    assert results[0].cut == "snr 13.0 to None"
    (result,) = noise_bias(versions, 15.0, ["spy"], observed_cut=0.25, **options)
    assert result.unused == pytest.approx(0.25, abs=0.02)
    assert len(seen[0].pixels) == len(seen[0].psf_of) == len(seen[0].offsets)


def test_where_no_shear_is_found_there_is_no_bias(versions, monkeypatch):
    def fails(_stamps, _settings):
        raise FdntValueError("no null")

    monkeypatch.setitem(ESTIMATORS, "fails", Estimator(text="", measure=fails))
    (result,) = noise_bias(versions, 10.0, ["fails"], n_stamps=1, batch=N_GAL)
    assert math.isnan(result.m)
    assert result.unused == 1.0
    again = NoiseBias.from_dict(json.loads(json.dumps(result.to_dict(), allow_nan=False)))
    assert math.isnan(again.m)
    assert math.isnan(again.c[1])


def test_results_survive_json(versions, mixed, seen):
    for drawn in (versions, mixed):
        (result,) = noise_bias(drawn, 10.0, ["spy"], n_stamps=1, batch=N_GAL, observed_cut=0.1)
        assert NoiseBias.from_dict(json.loads(json.dumps(result.to_dict()))) == result


# --- what is refused --------------------------------------------------------------------


def test_an_unknown_estimator_lists_the_known(versions):
    with pytest.raises(FdntValueError, match="no estimator nil; known are null, null-plain"):
        noise_bias(versions, 10.0, ["nil"])
    with pytest.raises(FdntValueError, match="no estimator given"):
        noise_bias(versions, 10.0, [])
    with pytest.raises(FdntValueError, match="twice"):
        noise_bias(versions, 10.0, ["null", "null"])


@pytest.mark.parametrize(
    "wrong",
    [
        {"snr": 0.0},
        {"snr": math.inf},
        {"snr": math.nan},
        {"n_stamps": 0},
        {"batch": 1},
        {"observed_cut": 1.0},
    ],
)
def test_numbers_out_of_range(versions, wrong):
    with pytest.raises(RangeError, match=next(iter(wrong))):
        noise_bias(versions, **{"snr": 10.0, **wrong})


def test_codes_that_cannot_cut(versions):
    with pytest.raises(FdntValueError, match="shapes, hsm cannot cut"):
        noise_bias(versions, 10.0, ["null", "shapes", "hsm"], cut=fx.Cut(quantity="snr", low=5.0))


# --- the command ------------------------------------------------------------------------


def run(*arguments, code=0):
    result = CliRunner().invoke(main, ["check", *map(str, arguments)])
    assert result.exit_code == code, result.output
    return result.output


SMALL = ("--galaxies", 8, "--batch", 8, "--stamps", 1)


def test_the_command_writes_numbers_and_a_figure(tmp_path):
    output, figure = tmp_path / "check.json", tmp_path / "check.png"
    files = ("-o", output, "--plot", figure)
    said = run(
        "--snr", "20,50", "--estimator", "null,hsm", "--estimator", "responses", *SMALL, *files
    )  # fmt: skip
    rows = [NoiseBias.from_dict(row) for row in json.loads(output.read_text())]
    assert [(row.snr, row.estimator) for row in rows] == [
        (snr, name) for snr in (20.0, 50.0) for name in ("null", "hsm", "responses")
    ]
    assert figure.read_bytes().startswith(b"\x89PNG")
    assert said.count("responses") == 2
    assert "exists" in run(*SMALL, *files, code=1)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("--estimator", "null,nil"), "no estimator nil; known are"),
        (("--snr", "10,x"), "--snr must be numbers"),
        (("--snr", "-1"), "snr"),
        (("--radius", "1,2,3"), "--radius must be"),
        (("-o", "check.txt"), "suffix"),
        (("--plot", "check.txt"), "suffix"),
    ],
)
def test_what_the_command_refuses_is_one_line(arguments, says):
    said = run(*arguments, code=1)
    assert said.startswith("Error: ")
    assert says in said
    assert said.count("\n") == 1


def test_radii():
    assert parse_radius(None, "exp") == 2.3
    assert parse_radius(None, "mixed") == (1.3, 2.3)
    assert parse_radius("1.5", "exp") == 1.5
    assert parse_radius("1,2", "mixed") == (1.0, 2.0)


def test_every_estimator_has_a_look():
    assert list(STYLES) == list(ESTIMATORS)


def test_the_figure_leaves_out_what_is_not_there(versions, seen):
    (result,) = noise_bias(versions, 10.0, ["spy"], n_stamps=1, batch=N_GAL)
    figure = plot_biases([result, replace(result, m=math.nan, estimator="null", snr=20.0)])
    assert len(figure.axes) == 3
    figure.canvas.draw()
