"""Checks with the user's own PSF: drawn as it is, noise as it is, and verdicts that can be bad."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from astropy.io import fits
from click.testing import CliRunner

from fdnt_xp.app.cli import main
from fdnt_xp.app.psf_check import Verdict, conclusions, plot_verdicts, stamp_size, table_row
from fdnt_xp.data import noise_bias as noise_bias_module
from fdnt_xp.data.calibration import Calibration, _calibration, error_calibration
from fdnt_xp.data.coloured_noise import coloured_stamps
from fdnt_xp.data.noise_bias import NoiseBias, noise_bias
from fdnt_xp.data.noise_power import measure_noise_power
from fdnt_xp.data.own_psf import psf_of_image
from fdnt_xp.data.versions import Population, draw_versions
from fdnt_xp.errors import FdntValueError, RangeError, ShapeMismatchError

galsim = pytest.importorskip("galsim")

SIZE = 48


def moffat():
    return galsim.Moffat(beta=3, fwhm=2.85).shear(e1=0.1, e2=0.05)


def image(profile, oversampling=1, n=64, offset=(0.3, 0.2)):
    drawn = profile.drawImage(
        nx=n * oversampling,
        ny=n * oversampling,
        scale=1.0 / oversampling,
        offset=offset,
        method="no_pixel",
        dtype=float,
    )
    return drawn.array


def with_pixel(profile):
    return galsim.Convolve([profile, galsim.Pixel(1.0)])


@pytest.fixture(scope="module")
def own():
    return psf_of_image(image(with_pixel(moffat()), 3), oversampling=3)


@pytest.fixture(scope="module")
def versions(own):
    population = Population(radius=(1.3, 2.4), psf_e=0.0, n_gal=32, psf_image="psf.fits")
    return draw_versions(population, own.profile)


# --- the PSF ----------------------------------------------------------------------------


@pytest.mark.parametrize("oversampling", [1, 3])
def test_galaxies_are_those_behind_the_profile_of_the_image(oversampling):
    psf = psf_of_image(7.0 * image(with_pixel(moffat()), oversampling), oversampling=oversampling)
    assert psf.well_sampled
    galaxy = galsim.Exponential(half_light_radius=2.0).shear(g1=0.2)
    seen, expected = (
        galsim.Convolve([galaxy, one]).drawImage(nx=48, ny=48, scale=1.0, method="no_pixel")
        for one in (psf.profile, with_pixel(moffat()))
    )
    # The image ends where the Moffat does not, and one pixel to a pixel is coarse.
    atol = {1: 2e-3, 3: 4e-4}[oversampling] * np.max(expected.array)
    np.testing.assert_allclose(seen.array, expected.array, atol=atol)


def test_the_pixel_is_put_on_where_it_is_missing():
    bare = psf_of_image(image(moffat(), 3), oversampling=3, pixel=True)
    whole = psf_of_image(image(with_pixel(moffat()), 3), oversampling=3)
    one, other = (
        psf.profile.drawImage(nx=32, ny=32, scale=1.0, method="no_pixel").array
        for psf in (bare, whole)
    )
    np.testing.assert_allclose(one, other, atol=1e-3 * np.max(other))


def test_a_coarse_image_is_told_from_a_fine_one():
    narrow = galsim.Moffat(beta=3, fwhm=1.2)
    assert not psf_of_image(image(narrow)).well_sampled
    assert psf_of_image(image(narrow, 4), oversampling=4).well_sampled


def test_large_psfs_have_large_stamps(own):
    assert stamp_size(own) == SIZE
    assert stamp_size(replace(own, half_light_radius=4.0)) == 96


@pytest.mark.parametrize(
    ("pixels", "options", "error"),
    [
        (np.ones((3, 16, 16)), {}, ShapeMismatchError),
        (np.ones((4, 16)), {}, ShapeMismatchError),
        (np.full((16, 16), np.nan), {}, FdntValueError),
        (-np.ones((16, 16)), {}, FdntValueError),
        (np.ones((16, 16)), {"oversampling": 0.0}, RangeError),
    ],
)
def test_images_that_are_no_psf(pixels, options, error):
    with pytest.raises(error):
        psf_of_image(pixels, **options)


# --- noise ------------------------------------------------------------------------------


def spectrum():
    k = 2.0 * np.pi * np.fft.fftfreq(SIZE)
    return np.exp(-0.5 * k[:, None] ** 2 - 0.3 * k[None, :] ** 2)


def test_correlated_noise_has_its_spectrum_and_is_told(versions, monkeypatch):
    seen = []
    spy = replace(
        noise_bias_module.ESTIMATORS["null"],
        measure=lambda stamps, _: seen.append(stamps) or noise_bias_module.Found(
            g=np.zeros(2), sigma_g=1.0, n_used=1
        ),
    )  # fmt: skip
    monkeypatch.setitem(noise_bias_module.ESTIMATORS, "spy", spy)
    noise_bias(versions, 20.0, ["spy"], n_stamps=1, batch=64, power=5.0 * spectrum())
    noise = np.concatenate([one.pixels - one.clean for one in seen[::2]])
    told = seen[0].power
    assert np.mean(told) == pytest.approx(seen[0].variance)
    measured = measure_noise_power(noise)
    assert measured.variance == pytest.approx(np.mean(told), rel=0.02)
    low = (slice(0, 6), slice(0, 6))
    assert np.mean(measured.power[low]) == pytest.approx(np.mean(told[low]), rel=0.1)
    assert np.all(seen[0].symmetry % 4 == 0)


def test_stamps_of_it_know_no_opposite_edge():
    stamps = coloured_stamps(np.random.default_rng(3), 1000, 2.0 * spectrum())
    # A lag of one pixel within a stamp, and the same around its edge.
    near = np.mean(stamps[:, :, 0] * stamps[:, :, 1])
    around = np.mean(stamps[:, :, 0] * stamps[:, :, -1])
    assert near > 0.2 * np.mean(stamps**2)
    assert abs(around) < 0.02 * np.mean(stamps**2)
    again = measure_noise_power(stamps)
    np.testing.assert_allclose(again.variance, 2.0 * np.mean(spectrum()), rtol=0.02)


def test_the_estimators_take_the_spectrum(versions):
    for estimator in ("null", "responses"):
        (bias,) = noise_bias(versions, 200.0, [estimator], n_stamps=1, batch=16, power=spectrum())
        assert abs(bias.m) < 0.02
        assert not bias.control


# --- errors -----------------------------------------------------------------------------


@pytest.mark.parametrize("power", [None, spectrum()], ids=["white", "correlated"])
def test_errors_are_right_for_bright_galaxies(versions, power):
    seen = error_calibration(versions, 100.0, n_stamps=1200, power=power)
    assert seen.n_stamps == 1280
    assert seen.lost == 0.0
    assert seen.shapes_failed == 0.0
    # Known to 12 and 10 %.
    assert seen.shear_ratio == pytest.approx(1.0, abs=3.0 * seen.shear_ratio_err)
    assert seen.shape_ratio == pytest.approx(1.0, abs=0.25)


def test_wrong_errors_are_seen():
    rng = np.random.default_rng(2)
    shears = rng.standard_normal((50, 10, 2)) + rng.standard_normal((50, 1, 2))
    pulls = 2.0 * rng.standard_normal((3000, 2))
    pulls[:20] = np.nan
    seen = _calibration(shears, np.full((500, 2), 0.8), pulls, 0.1, 0.2)
    assert seen.shear_ratio == pytest.approx(1.25, abs=0.1)
    assert seen.shape_ratio == pytest.approx(2.0, abs=0.1)
    assert seen.shape_ratio_err == pytest.approx(0.03, rel=0.2)


def test_calibration_refuses(versions):
    with pytest.raises(RangeError, match="snr"):
        error_calibration(versions, -1.0)
    with pytest.raises(RangeError, match="n_stamps"):
        error_calibration(versions, 10.0, n_stamps=0)
    two = replace(versions, psf_images=np.tile(versions.psf_images, (2, 1, 1)))
    with pytest.raises(FdntValueError, match="one PSF, not 2"):
        error_calibration(two, 10.0)


# --- verdicts ---------------------------------------------------------------------------

GOOD = Verdict(
    bias=NoiseBias(
        estimator="null",
        population=Population(psf_image="psf.fits"),
        snr=20.0,
        m=2e-4,
        m_err=1e-4,
        c=(1e-5, -1e-5),
        c_err=(1e-5, 1e-5),
        sigma_g=0.2,
        unused=0.0,
        n_stamps=1000,
        n_batches=20,
        seconds_per_stamp=1e-3,
        seed=0,
    ),
    calibration=Calibration(
        shear_ratio=1.01,
        shear_ratio_err=0.03,
        shape_ratio=0.98,
        shape_ratio_err=0.03,
        shapes_failed=0.0,
        lost=0.0,
        n_stamps=1000,
    ),
    flux=1234.0,
)


def changed(part, **values):
    return replace(GOOD, **{part: replace(getattr(GOOD, part), **values)})


@pytest.mark.parametrize(
    ("verdict", "says"),
    [
        (GOOD, "fine"),
        (changed("bias", m_err=1e-3), "nothing wrong is seen; |m| < 0.0022"),
        (changed("bias", m=-8e-3, m_err=1e-3), "do not trust: m is -0.0080"),
        (changed("bias", m=-8e-3, m_err=1e-3, n_batches=2), "nothing wrong is seen"),
        (changed("bias", m=np.nan), "no shear can be found"),
        (changed("bias", c=(0.0, 1e-3)), "c2 is +1.0e-03"),
        (changed("calibration", shear_ratio=1.4), "scatters by 1.40 of its error"),
        (changed("calibration", lost=0.05), "5.0 % are lost"),
    ],
)
def test_what_is_said(verdict, says):
    assert says in verdict.text
    assert verdict.text in table_row(verdict)
    assert json.loads(json.dumps(verdict.to_dict()))["verdict"] == verdict.text


def test_conclusions():
    bad = changed("bias", m=-8e-3, m_err=1e-3, snr=10.0)
    high = changed("bias", snr=50.0)
    assert next(iter(conclusions([high, GOOD]))).endswith("nothing wrong down to S/N 20")
    assert next(iter(conclusions([bad, GOOD, high]))).endswith("do not trust it below S/N 20")
    assert next(iter(conclusions([bad]))).endswith("do not trust it at S/N 10 or below")
    wrong = changed("calibration", shapes_failed=0.3)
    assert list(conclusions([wrong, high]))[1].endswith("from S/N 50")
    assert "at all S/N" in list(conclusions([wrong]))[1]
    figure = plot_verdicts([bad, GOOD, high, wrong])
    assert len(figure.axes) == 4
    figure.canvas.draw()


# --- the command ------------------------------------------------------------------------


def run(*arguments, code=0):
    result = CliRunner().invoke(main, ["check", *map(str, arguments)])
    assert result.exit_code == code, result.output
    return result.output


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    fits.PrimaryHDU(image(with_pixel(moffat()))).writeto("psf.fits")
    blank = 10.0 * np.random.default_rng(1).standard_normal((6 * SIZE, 6 * SIZE))
    fits.PrimaryHDU(blank).writeto("white.fits")
    fits.PrimaryHDU(blank + 1000.0).writeto("sky.fits")
    fits.PrimaryHDU(blank + np.roll(blank, 1, axis=1)).writeto("correlated.fits")
    return tmp_path


SMALL = ("--psf", "psf.fits", "--galaxies", 8, "--batch", 8, "--stamps", 1)


def test_the_command_writes_numbers_and_a_figure(folder):
    files = ("-o", "check.json", "--plot", "check.png")
    said = run(*SMALL, "--snr", "80", "--noise-variance", 100.0, *files)
    rows = json.loads((folder / "check.json").read_text())
    assert [row["population"]["kind"] for row in rows] == ["exp", "dev"]
    assert rows[0]["population"]["psf_image"] == "psf.fits"
    assert (folder / "check.png").read_bytes().startswith(b"\x89PNG")
    assert "half-light radius 1.8" in said
    # Of S/N 80 in noise of 10 a pixel: more than 500, as light is spread over some pixels.
    assert 500.0 < rows[0]["flux"] < 10_000.0
    assert "exists" in run(*SMALL, *files, code=1)


def test_noise_images(folder):
    common = (*SMALL, "--kind", "exp", "--snr", "100", "--overwrite", "-o", "check.json")
    run(*common, "--noise-image", "correlated.fits")
    (row,) = json.loads((folder / "check.json").read_text())
    assert not row["control"]
    assert row["flux"] > 1000.0


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("--noise-variance", 1.0, "--oversampling", 2), "--oversampling, --noise-variance"),
        ((*SMALL, "--kind", "mixed"), "--kind mixed has PSFs of its own"),
        ((*SMALL, "--noise-variance", 1, "--noise-image", "white.fits"), "not both"),
        ((*SMALL, "--noise-variance", -1), "noise_variance"),
        ((*SMALL, "--snr", "10,x"), "--snr must be numbers"),
        (("--psf", "none.fits"), "does not exist"),
        ((*SMALL, "--oversampling", -1), "oversampling"),
        ((*SMALL, "--psf", "sky.fits"), "the PSF is the image of one star"),
    ],
)
def test_what_the_command_refuses_is_one_line(folder, arguments, says):
    said = run(*arguments, code=1)
    assert said.startswith("Error: ")
    assert says in said
    assert said.count("\n") == 1
