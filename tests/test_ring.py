"""Ring tests: what is drawn, what is refused, what is written."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from click.testing import CliRunner

import fdnt_xp as fx
from fdnt_xp.app.cli import main
from fdnt_xp.app.gradient_figure import plot_gradients
from fdnt_xp.app.ring import parse_galaxy, parse_psf
from fdnt_xp.data.profiles import (
    TEST_GALAXIES,
    gaussian_psf,
    irregular,
    is_inversion_symmetric,
    moffat_psf,
    sersic,
)
from fdnt_xp.data.ring import ESTIMATORS, draw, draw_ring, ring_angles
from fdnt_xp.errors import FdntValueError, FdntWarning, RangeError
from fdnt_xp.flags import Flag
from fdnt_xp.shapes.methods import SHAPE_METHODS, register_shape_method, shape_method
from fdnt_xp.shear import add_shears

pytest.importorskip("galsim")

STAMP = 48


def galaxy():
    return sersic(0.5, 3.0, (0.3, 0.0))


def psf():
    return gaussian_psf(2.0)


@pytest.fixture(scope="module")
def result():
    return fx.ring_test(galaxy(), psf(), 0.04, n_angles=8, stamp_size=STAMP)


# --- what is drawn ----------------------------------------------------------------------


@pytest.mark.parametrize("eta", [(0.0, 0.0), (0.2, 0.0), (0.1, -0.15)])
def test_rotated_then_sheared(eta):
    """GalSim's images have the shapes of our own algebra."""
    angles = np.array([0.0, 0.4, 1.3])
    stamps = draw_ring(galaxy(), psf(), angles, eta, stamp_size=64, pixel=False)
    star = fx.Psf.from_image(draw(psf(), 64, pixel=False))
    turned = math.atanh(0.3) * np.stack([np.cos(2 * angles), np.sin(2 * angles)], axis=-1)
    wanted = add_shears(np.broadcast_to(np.array(eta), (3, 2)), turned)
    np.testing.assert_allclose(fx.measure_shapes(stamps, star).eta, wanted, atol=3e-6)


def test_angles():
    half, full = ring_angles(16, full_turn=False), ring_angles(16, full_turn=True)
    assert (len(half), len(full)) == (16, 32)
    np.testing.assert_allclose(np.diff(half), np.pi / 16)
    np.testing.assert_allclose(np.diff(full), np.pi / 16)
    assert full[-1] == pytest.approx(2 * np.pi - np.pi / 16)


def test_the_origin_is_in_the_middle_of_the_stamp_with_and_without_pixel():
    for pixel in (False, True):
        star = draw(gaussian_psf(2.0, (0.0, 0.0)), 31, pixel=pixel)
        assert np.unravel_index(np.argmax(star), star.shape) == (15, 15)
        assert np.sum(star) == pytest.approx(1.0, abs=1e-6)


def test_inversion_symmetry_is_seen():
    symmetric = {name: is_inversion_symmetric(make()) for name, make in TEST_GALAXIES.items()}
    assert symmetric == {"vb-spiral": True, "orthogonal": True, "torture": False}
    assert not is_inversion_symmetric(irregular(1))
    assert is_inversion_symmetric(galaxy().shift(1.3, -0.4))


def test_every_galaxy_has_unit_flux():
    for profile in (*(make() for make in TEST_GALAXIES.values()), irregular(3), galaxy(), psf()):
        assert profile.flux == pytest.approx(1.0, abs=1e-12)


def test_the_seed_makes_the_knots():
    assert irregular(1) == irregular(1)
    assert irregular(1) != irregular(2)


# --- what comes out ---------------------------------------------------------------------


def test_an_ellipse_has_no_bias(result):
    assert set(result.biases) == set(ESTIMATORS)
    assert result.n_gal == 8
    assert not result.full_turn
    assert result.n_failed == 0
    assert result.e == pytest.approx(0.3, abs=1e-4)
    assert abs(result.eg) < 1e-4
    assert result.g == math.tanh(0.02)
    for name in ("eg+cubic", "null-frozen", "null-eta"):
        assert abs(result.biases[name].m) < 3e-5, name
    for bias in result.biases.values():
        assert max(map(abs, bias.c)) < 1e-8
        assert abs(bias.m_cross) < 1e-6
        assert 0 <= bias.m_err < 1e-4
    # The third order of an ellipse, about g² R3/R1: there without the inversion.
    assert 5e-5 < abs(result.biases["eg"].m) < 5e-4


def test_any_direction_and_sign():
    estimators = ["eg+cubic", "null-frozen"]
    for eta in ((-0.04, 0.0), (0.0, 0.04), (0.02, -0.03)):
        ring = fx.ring_test(
            galaxy(), psf(), eta, n_angles=8, stamp_size=STAMP, estimators=estimators, errors=False
        )
        assert ring.delta_eta == eta
        assert list(ring.biases) == estimators
        for bias in ring.biases.values():
            assert abs(bias.m) < 5e-5
            assert abs(bias.m_cross) < 1e-5
            assert bias.m_err is None
            assert bias.c_err is None


def test_half_rings_show_a_ring_with_too_few_angles():
    """e = 0.8 on eight angles: the half-ring of four is not isotropic, and the error says so."""
    ring = fx.ring_test(
        sersic(0.5, 3.0, (0.8, 0.0)),
        psf(),
        0.1,
        n_angles=8,
        stamp_size=STAMP,
        estimators=["eg+cubic"],
    )
    more = fx.ring_test(
        sersic(0.5, 3.0, (0.8, 0.0)),
        psf(),
        0.1,
        n_angles=24,
        stamp_size=STAMP,
        estimators=["eg+cubic"],
    )
    few, many = ring.biases["eg+cubic"], more.biases["eg+cubic"]
    assert many.m_err < 0.5 * few.m_err
    assert abs(few.m - many.m) < few.m_err


def test_json_round_trip(result):
    again = fx.RingResult.from_dict(json.loads(json.dumps(result.to_dict())))
    assert again == result


def test_another_library():
    torch = pytest.importorskip("torch")
    names = ["eg", "null-frozen"]
    rings = [
        fx.ring_test(
            galaxy(), psf(), n_angles=8, stamp_size=STAMP, estimators=names, to_array=to_array
        )
        for to_array in (np.asarray, torch.asarray)
    ]
    for name in names:
        assert rings[0].biases[name].m == pytest.approx(rings[1].biases[name].m, abs=1e-7)


# --- what is refused --------------------------------------------------------------------


@pytest.mark.parametrize("eta", [0.0, 0.6, float("nan"), (0.0, 0.0), (0.5, 0.5)])
def test_shears_out_of_range(eta):
    with pytest.raises(RangeError, match="delta_eta"):
        fx.ring_test(galaxy(), psf(), eta)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"n_angles": 4}, "n_angles = 4"),
        ({"n_angles": 17}, "even"),
        ({"stamp_size": 8}, "stamp_size = 8"),
        ({"estimators": ["eg", "magic"]}, "no estimator magic; known are raw, eg"),
        ({"estimators": []}, "no estimator given"),
        ({"method": "magic"}, "no shape method 'magic'; known are fdnt-ft"),
        ({"delta_eta": (0.1, 0.1, 0.1)}, "a number or"),
    ],
)
def test_bad_arguments(arguments, message):
    with pytest.raises(FdntValueError, match=message):
        fx.ring_test(galaxy(), psf(), **arguments)


def test_galaxies_without_a_shape_are_told(monkeypatch):
    def blind(stamps, psf, **options):
        stamps = np.array(stamps)
        stamps[2] = np.nan
        return fx.measure_shapes(stamps, psf, **options)

    monkeypatch.setitem(SHAPE_METHODS, "blind", blind)
    with pytest.warns(FdntWarning, match="1 of 24 galaxies of the rings have no shape"):
        ring = fx.ring_test(
            galaxy(), psf(), n_angles=8, stamp_size=STAMP, method="blind", estimators=["eg"]
        )
    assert ring.n_failed == 1
    assert ring.method == "blind"
    assert abs(ring.biases["eg"].m) > 1e-3


def test_registry(monkeypatch):
    monkeypatch.setattr("fdnt_xp.shapes.methods.SHAPE_METHODS", dict(SHAPE_METHODS))
    assert shape_method("fdnt-ft") is fx.measure_shapes

    def other(stamps, psf, **options):
        return fx.ShapeResult.unmeasured(stamps)

    register_shape_method("other", other)
    register_shape_method("other", other)
    assert shape_method("other") is other
    assert int(shape_method("other")(np.zeros((1, 16, 16)), None).flags[0]) == Flag.NO_ATTEMPT
    with pytest.raises(FdntValueError, match="belongs to another"):
        register_shape_method("fdnt-ft", other)


@pytest.mark.parametrize(
    "text",
    ["", "spiral", "sersic", "sersic:1", "sersic:1,2,x", "sersic:9,2,0", "sersic:1,2,1",
     "sersic:1,-2,0", "sersic:1,inf,0"],
)  # fmt: skip
def test_galaxies_that_are_not_understood(text):
    with pytest.raises(FdntValueError):
        parse_galaxy(text)


@pytest.mark.parametrize(
    "text", ["gaussian", "gaussian:1,2", "moffat:3,4,0", "moffat:1,4,0,0", "gaussian:0,0,0",
             "gaussian:2,0.8,0.8", "airy:1,2,3"],
)  # fmt: skip
def test_psfs_that_are_not_understood(text):
    with pytest.raises(FdntValueError):
        parse_psf(text)


def test_names_of_the_command_line():
    assert parse_galaxy("torture") == TEST_GALAXIES["torture"]()
    assert parse_galaxy("sersic:0.5,3,0.3") == galaxy()
    assert parse_psf("gaussian:2,0.1,0.05") == psf()
    assert parse_psf("moffat:3,4,0.1,0.05") == moffat_psf(3.0, 4.0)


# --- the command ------------------------------------------------------------------------


def run(*arguments, code=0):
    done = CliRunner().invoke(main, [str(argument) for argument in arguments])
    assert done.exit_code == code, done.output
    assert "Traceback" not in done.output
    return done.output


RING = ("ring", "--galaxy", "sersic:0.5,3,0.3", "--angles", 8, "--stamp", STAMP)


def test_command(tmp_path, monkeypatch):
    pytest.importorskip("matplotlib")
    monkeypatch.chdir(tmp_path)
    output = run(*RING, "--delta-eta", 0.04, "-o", "ring.json", "--plot", "ring.png")
    assert "8 angles over pi" in output
    assert all(f"\n{name} " in output for name in ESTIMATORS)
    written = json.loads((tmp_path / "ring.json").read_text(encoding="utf-8"))
    assert (written.pop("galaxy"), written.pop("psf")) == (*RING[2:3], "gaussian:2,0.1,0.05")
    assert abs(fx.RingResult.from_dict(written).biases["null-eta"].m) < 1e-4
    assert (tmp_path / "ring.png").read_bytes().startswith(b"\x89PNG")
    assert sorted(file.name for file in tmp_path.iterdir()) == ["ring.json", "ring.png"]
    assert "exists" in run(*RING, "-o", "ring.json", code=1)
    assert "exists" in run(*RING, "--plot", "ring.png", code=1)
    run(*RING, "-o", "ring.json", "--overwrite", "--backend", "numpy", "--dtype", "float64")


def test_command_refuses(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert "known are vb-spiral" in run("ring", "--galaxy", "cloud", code=1)
    assert "known are gaussian" in run("ring", "--psf", "cloud", code=1)
    assert "no shape method" in run(*RING, "--method", "magic", code=1)
    assert "must be .json" in run(*RING, "-o", "ring.txt", code=1)
    assert "known figure format" in run(*RING, "--plot", "ring.doc", code=1)
    assert list(tmp_path.iterdir()) == []


FIGURE = ("figure", "ellipticity-gradient", "--points", 2, "--stamp", 64, "--padding", 1)


def test_figure(tmp_path, monkeypatch):
    pytest.importorskip("matplotlib")
    monkeypatch.chdir(tmp_path)
    output = run(*FIGURE, "--angles", 8, "--table", "numbers.json")
    rows = json.loads((tmp_path / "numbers.json").read_text(encoding="utf-8"))
    assert [row["galaxy"] for row in rows[::2]] == list(TEST_GALAXIES)
    assert [row["psf_hlr"] for row in rows] == [2.0, 6.0] * 3
    assert output.count("vb-spiral") == 2
    figure = plot_gradients(rows, 0.02)
    assert len([axes for axes in figure.axes if axes.get_xlabel().startswith("PSF")]) == 3
    assert (tmp_path / "ellipticity-gradient.png").stat().st_size > 10_000
    assert "exists" in run(*FIGURE, code=1)
    assert "known catalog format" in run(
        *FIGURE, "-o", "other.png", "--table", "numbers.txt", code=1
    )
