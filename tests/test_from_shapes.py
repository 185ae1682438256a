"""The shear of galaxies that were sheared exactly, and what is refused."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from array_api_extra.testing import assert_close

import fdnt_xp as fx
from fdnt_xp.errors import FdntTypeError, FdntValueError, FdntWarning, ShapeMismatchError
from fdnt_xp.flags import Flag
from fdnt_xp.shapes.results import ShapeResult
from fdnt_xp.shear import add_shears, eta_from_reduced_shear
from fdnt_xp.shears.from_shapes import shear_from_eta
from fdnt_xp.shears.weights import ShapeWeight

WEIGHTS = ["uniform", ShapeWeight.gaussian(1.5), "lorentzian"]


def vector(length, angle):
    return length * np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def lensed(g, lengths=(0.0, 0.2, 0.5, 0.9), n_angle=32):
    """Return ellipses in rings, lensed by g (2,)."""
    angle = 0.1 + np.linspace(0.0, 2.0 * np.pi, n_angle, endpoint=False)
    ring = np.concatenate([vector(length, angle) for length in lengths])
    return add_shears(eta_from_reduced_shear(np.asarray(g)[None, :]), ring)


def result(eta, to_xp=np.asarray, dtype="float64", *, eg=None, cov=None, flags=None):
    """Return a ShapeResult that holds these shapes."""
    n = len(eta)
    blank = ShapeResult.unmeasured(to_xp(np.zeros((n, 2, 2)), dtype))
    return replace(
        blank,
        eta=to_xp(eta, dtype),
        eg=to_xp(np.zeros(n) if eg is None else eg, dtype),
        eta_cov=to_xp(np.full((n, 2, 2), np.nan) if cov is None else cov, dtype),
        flags=to_xp(np.zeros(n, dtype=np.int32) if flags is None else flags, "int32"),
    )


# --- the shear comes back ------------------------------------------------------------


@pytest.mark.parametrize("weight", WEIGHTS, ids=["uniform", "gaussian", "lorentzian"])
def test_exact_to_fifth_order(weight):
    direction = vector(1.0, 2.1)
    error = [
        np.linalg.norm(
            fx.shear_from_shapes(result(lensed(g * direction)), weight).g - g * direction
        )
        for g in (0.02, 0.04, 0.08)
    ]
    assert error[0] < 40 * 0.02**5
    np.testing.assert_allclose([error[1] / error[0], error[2] / error[1]], 32.0, rtol=0.1)


@pytest.mark.parametrize("weight", WEIGHTS, ids=["uniform", "gaussian", "lorentzian"])
def test_the_linear_estimate_is_off_by_the_cube(weight):
    g = np.array([0.03, 0.04])
    linear = fx.shear_from_shapes(result(lensed(g)), weight, cubic=False)
    full = fx.shear_from_shapes(result(lensed(g)), weight)
    assert linear.cubic is None
    expected = g * (1.0 - full.cubic * 0.05**2)
    np.testing.assert_allclose(linear.g, expected, rtol=0, atol=40 * 0.05**5)


@pytest.mark.parametrize("angle", [0.0, 0.7, np.pi / 2, 2.5, np.pi])
def test_both_components_on_every_library(angle, xp, dtype, to_xp):
    g = vector(0.03, angle)
    estimate = fx.shear_from_shapes(result(lensed(g), to_xp, dtype))
    atol = 1e-8 if dtype == xp.float64 else 3e-7
    assert_close(estimate.g, to_xp(g, dtype), atol=atol, rtol=0, xp=xp)
    assert estimate.g_err.dtype == dtype
    assert (estimate.n_used, estimate.n_excluded) == (128, 0)
    assert estimate.method == "responsivity"


@pytest.mark.parametrize("degrees", [45.0, 90.0, 17.0])
def test_rotating_the_galaxies_rotates_the_shear(degrees):
    rng = np.random.default_rng(1)
    eta = 0.4 * rng.normal(size=(50, 2)) + [0.2, 0.1]
    eg = 0.2 * rng.uniform(-1, 1, 50)
    cov = np.zeros((50, 2, 2)) + 0.01 * np.eye(2) + 0.004 * rng.uniform(size=(50, 1, 1))
    two_beta = np.radians(2 * degrees)
    turn = np.array([[np.cos(two_beta), -np.sin(two_beta)], [np.sin(two_beta), np.cos(two_beta)]])
    first = fx.shear_from_shapes(result(eta, eg=eg, cov=cov), "lorentzian")
    turned = result(eta @ turn.T, eg=eg, cov=turn @ cov @ turn.T)
    second = fx.shear_from_shapes(turned, "lorentzian")
    np.testing.assert_allclose(second.g, turn @ first.g, atol=1e-13)
    if degrees == 90.0:
        np.testing.assert_allclose(second.g_err, first.g_err, atol=1e-13)
        np.testing.assert_allclose(second.g_err_noise, first.g_err_noise, atol=1e-13)
    if degrees == 45.0:
        np.testing.assert_allclose(second.g_err, first.g_err[::-1], atol=1e-13)


def test_galaxies_with_gradients():
    # Shapes that answer along their axis by 1/(1 - EG): the model of B10 (26) to (31).
    g, eg = 1e-4, 0.1
    angle = np.linspace(0.0, 2.0 * np.pi, 64, endpoint=False)
    along, across = 2 * g * np.cos(angle), -2 * g * np.sin(angle)
    length = 0.6 + along / (1.0 - eg)
    turned = angle + across / np.tanh(0.6)
    shapes = result(vector(1.0, turned) * length[:, None], eg=np.full(64, eg))
    for weight in WEIGHTS:
        right = fx.shear_from_shapes(shapes, weight).g
        np.testing.assert_allclose(right, [g, 0.0], atol=1e-6 * g + 1e-9)
    wrong = fx.shear_from_shapes(shapes, use_eg=False).g
    assert wrong[0] / g - 1.0 > 0.03


def test_galaxy_weights_multiply():
    one, two = lensed([0.02, 0.0]), lensed([0.0, -0.03])
    weight = np.repeat([1.0, 0.0], len(one))
    both = result(np.concatenate([one, two]))
    estimate = fx.shear_from_shapes(both, galaxy_weight=weight)
    alone = fx.shear_from_shapes(result(one))
    np.testing.assert_allclose(estimate.g, alone.g, rtol=1e-12, atol=1e-16)
    np.testing.assert_allclose(estimate.g_err, alone.g_err, rtol=1e-12)
    assert estimate.n_used == len(one)
    scaled = fx.shear_from_shapes(both, galaxy_weight=1e6 * weight)
    np.testing.assert_allclose(scaled.g, alone.g, rtol=1e-12, atol=1e-16)


def test_copies_of_galaxies_count_as_weights():
    eta = lensed([0.02, 0.01])
    count = np.arange(len(eta)) % 4
    repeated = fx.shear_from_shapes(result(np.repeat(eta, count, axis=0)))
    weighted = fx.shear_from_shapes(result(eta), galaxy_weight=1.0 * count)
    np.testing.assert_allclose(weighted.g, repeated.g, rtol=1e-12)


def test_bare_shapes_give_the_same():
    eta, eg = lensed([0.02, 0.01]), np.linspace(-0.1, 0.1, 128)
    bare = shear_from_eta(eta, "lorentzian", eg=eg)
    full = fx.shear_from_shapes(result(eta, eg=eg), "lorentzian")
    np.testing.assert_array_equal(bare.g, full.g)
    np.testing.assert_array_equal(bare.g_err, full.g_err)
    assert bare.g_err_noise is None
    cov = np.broadcast_to(0.01 * np.eye(2), (128, 2, 2))
    bare = shear_from_eta(eta, "lorentzian", eg=eg, eta_cov=cov)
    full = fx.shear_from_shapes(result(eta, eg=eg, cov=cov), "lorentzian")
    np.testing.assert_array_equal(bare.g_err_noise, full.g_err_noise)
    with pytest.raises(ShapeMismatchError, match=r"eta_cov must have the shape \(128, 2, 2\)"):
        shear_from_eta(eta, eta_cov=cov[:5])


@pytest.mark.parametrize("weight", ["uniform", "lorentzian"])
def test_the_orientations_at_hand_are_taken_off(weight):
    # Pairs at 90 degrees have no mean shape, but their response depends on where they point.
    rng, g = np.random.default_rng(11), np.array([0.04, -0.02])
    left = {True: [], False: []}
    for _ in range(60):
        size, angle = rng.uniform(0.2, 1.6, 40), rng.uniform(0.0, 2.0 * np.pi, 40)
        pairs = size[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        eta = add_shears(eta_from_reduced_shear(g[None, :]), np.concatenate([pairs, -pairs]))
        for orientations, found in left.items():
            found.append(shear_from_eta(eta, weight, orientations=orientations).g - g)
    with_them, without = (np.sqrt(np.mean(np.square(left[one]))) for one in (True, False))
    # What remains is of the next order in g.
    assert with_them < 0.15 * without
    for found in left.values():
        error = np.std(found, axis=0) / np.sqrt(60)
        assert np.all(np.abs(np.mean(found, axis=0)) < 4.0 * error)


def test_the_error_follows_what_is_taken_off():
    rng, g = np.random.default_rng(12), np.array([0.05, 0.0])
    estimates = []
    for _ in range(300):
        eta = add_shears(eta_from_reduced_shear(g[None, :]), 0.5 * rng.normal(size=(200, 2)))
        estimates.append(shear_from_eta(eta, "lorentzian"))
    scatter = np.std([one.g for one in estimates], axis=0)
    stated = np.sqrt(np.mean([one.g_err**2 for one in estimates], axis=0))
    np.testing.assert_allclose(stated, scatter, rtol=0.15)  # 300 draws tell it to 4 %


# --- errors --------------------------------------------------------------------------


@pytest.fixture(scope="module")
def trials():
    """Estimates of 400 samples of 200 noisy galaxies with unequal weights."""
    rng = np.random.default_rng(7)
    sigma = 0.15
    estimates = []
    for _ in range(400):
        intrinsic = 0.3 * rng.normal(size=(200, 2))
        eta = add_shears(eta_from_reduced_shear(np.array([[0.1, -0.05]])), intrinsic)
        eta = eta + sigma * rng.normal(size=eta.shape)
        shapes = result(eta, cov=np.broadcast_to(sigma**2 * np.eye(2), (200, 2, 2)))
        estimates.append(
            fx.shear_from_shapes(shapes, "lorentzian", galaxy_weight=rng.uniform(0.2, 1.0, 200))
        )
    return estimates


def test_the_error_is_the_scatter_of_samples(trials):
    scatter = np.std([e.g for e in trials], axis=0, ddof=1)
    predicted = np.mean([e.g_err for e in trials], axis=0)
    np.testing.assert_allclose(predicted / scatter, 1.0, atol=0.1)  # 400 samples: 3.5 %


def test_the_error_from_noise_is_the_scatter_under_noise():
    rng = np.random.default_rng(3)
    sigma = np.array([[0.04, 0.015], [0.015, 0.02]])
    factor = np.linalg.cholesky(sigma @ sigma.T)
    eta = lensed([0.1, 0.03])
    cov = np.broadcast_to(sigma @ sigma.T, (len(eta), 2, 2))
    predicted = fx.shear_from_shapes(result(eta, cov=cov), "lorentzian").g_err_noise
    g = [
        shear_from_eta(eta + rng.normal(size=eta.shape) @ factor.T, "lorentzian").g
        for _ in range(800)
    ]
    np.testing.assert_allclose(predicted / np.std(g, axis=0, ddof=1), 1.0, atol=0.1)


def test_noise_that_is_not_known_is_nan(to_xp, to_np):
    estimate = fx.shear_from_shapes(result(lensed([0.01, 0.0]), to_xp))
    assert np.all(np.isnan(to_np(estimate.g_err_noise)))
    assert np.all(np.isfinite(to_np(estimate.g_err)))


def test_the_estimate_as_numbers(to_xp):
    cov = np.broadcast_to(0.01 * np.eye(2), (128, 2, 2))
    estimate = fx.shear_from_shapes(result(lensed([0.03, -0.01]), to_xp, cov=cov))
    row = estimate.to_dict()
    assert json.loads(json.dumps(row)) == row
    assert row["g1"] == pytest.approx(0.03, abs=1e-8)
    assert row["g2"] == pytest.approx(-0.01, abs=1e-8)
    assert {"g1_err", "g2_err", "g1_err_noise", "g2_err_noise"} <= set(row)
    assert (row["n_used"], row["method"]) == (128, "responsivity")
    host = estimate.to_numpy()
    np.testing.assert_allclose(
        host.eta, 2 * np.arctanh(np.hypot(*host.g)) / np.hypot(*host.g) * host.g
    )


# --- galaxies and calls that cannot be used ------------------------------------------


def test_unmeasured_galaxies_change_nothing(to_xp, to_np):
    eta, bad = lensed([0.02, 0.01]), np.zeros(128, dtype=np.int32)
    good = fx.shear_from_shapes(result(eta, to_xp))
    bad[[3, 70]] = int(Flag.SINGULAR)
    bad[5] = int(Flag.SIZE_AT_BOUND)  # information: it is measured
    kept = bad & int(Flag.SINGULAR) == 0
    poisoned, weight = eta.copy(), np.ones(128)
    poisoned[[3, 70]] = np.nan
    weight[3] = np.nan  # as a weight from its S/N would be
    mixed = fx.shear_from_shapes(result(poisoned, to_xp, flags=bad), galaxy_weight=to_xp(weight))
    alone = fx.shear_from_shapes(result(eta[kept], to_xp))
    assert (mixed.n_used, mixed.n_excluded) == (126, 0)
    np.testing.assert_allclose(to_np(mixed.g), to_np(alone.g), rtol=1e-13)
    np.testing.assert_allclose(to_np(mixed.g_err), to_np(alone.g_err), rtol=1e-13)
    assert good.n_used == 128


def test_galaxies_without_response_are_left_out_and_counted(to_xp, to_np):
    eta, eg = lensed([0.02, 0.01]), np.zeros(128)
    eg[[1, 9, 30]] = [1.0, np.nan, 3.0]
    with pytest.warns(FdntWarning, match="3 of 128 galaxies left out"):
        estimate = fx.shear_from_shapes(result(eta, to_xp, eg=eg))
    alone = fx.shear_from_shapes(result(np.delete(eta, [1, 9, 30], axis=0), to_xp))
    assert (estimate.n_used, estimate.n_excluded) == (125, 3)
    np.testing.assert_allclose(to_np(estimate.g), to_np(alone.g), rtol=1e-13)
    assert fx.shear_from_shapes(result(eta, to_xp, eg=eg), use_eg=False).n_used == 128


def test_too_few_galaxies(to_xp):
    eta = lensed([0.02, 0.01])
    failed = np.full(128, int(Flag.DID_NOT_CONVERGE), dtype=np.int32)
    with pytest.raises(FdntValueError, match="no measured galaxy of 128; their flags say why"):
        fx.shear_from_shapes(result(eta, to_xp, flags=failed))
    with pytest.raises(FdntValueError, match="no measured galaxy of 0"):
        fx.shear_from_shapes(result(eta[:0], to_xp))
    with pytest.raises(FdntValueError, match="1 usable galaxies"):
        fx.shear_from_shapes(result(eta[:1], to_xp))
    with pytest.raises(FdntValueError, match="0 usable galaxies"):
        fx.shear_from_shapes(result(eta, to_xp), galaxy_weight=to_xp(np.zeros(128)))
    with (
        pytest.raises(FdntValueError, match=r"0 usable galaxies \(128 left out"),
        pytest.warns(FdntWarning, match="128 of 128"),
    ):
        fx.shear_from_shapes(result(eta, to_xp, eg=np.full(128, 1.2)))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -1.0])
def test_bad_galaxy_weights(bad, to_xp):
    weight = np.ones(128)
    weight[[4, 8]] = bad
    with pytest.raises(FdntValueError, match="finite and not negative; it is not for 2 galaxies"):
        fx.shear_from_shapes(result(lensed([0.0, 0.0]), to_xp), galaxy_weight=to_xp(weight))


def test_bad_calls():
    eta = lensed([0.0, 0.0])
    with pytest.raises(FdntTypeError, match="not ndarray; see measure_shapes"):
        fx.shear_from_shapes(eta)
    with pytest.raises(ShapeMismatchError, match="galaxy_weight must have the shape"):
        fx.shear_from_shapes(result(eta), galaxy_weight=np.ones(3))
    with pytest.raises(ShapeMismatchError, match="eta must have the shape"):
        shear_from_eta(eta.T)
    with pytest.raises(ShapeMismatchError, match="eg must have the shape"):
        shear_from_eta(eta, eg=np.zeros(3))
    with pytest.raises(FdntValueError, match="eta must be finite"):
        shear_from_eta(np.full((4, 2), np.nan))


def test_no_shear_gives_such_a_mean():
    # All shapes alike: no isotropic population has this mean.
    with pytest.raises(FdntValueError, match="no shear gives this mean shape"):
        shear_from_eta(np.broadcast_to([0.95, 0.0], (9, 2)), "gaussian")
    with pytest.raises(FdntValueError, match="it must be below 1"):
        shear_from_eta(np.broadcast_to([3.0, 0.0], (9, 2)), "lorentzian", cubic=False)
    # A weight that falls so fast that galaxies lose in weight what they gain in length.
    with pytest.raises(FdntValueError, match="do not follow the shear"):
        shear_from_eta(np.broadcast_to([1.2, 0.0], (9, 2)), "gaussian")
