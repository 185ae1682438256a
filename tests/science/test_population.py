"""GREAT08's low-noise population: nearly every galaxy is measured, at its own root."""

from __future__ import annotations

import numpy as np
import pytest

import fdnt_xp as fx
from fdnt_xp.data.simulate import great08_image
from fdnt_xp.shear import eta_from_reduced_shear

CELL = 64


@pytest.fixture(scope="module")
def population():
    field = great08_image(n_x=50, n_y=40, cell=CELL, snr=200.0, seed=1)
    stamps = field.image.reshape(40, CELL, 50, CELL).transpose(0, 2, 1, 3).reshape(-1, CELL, CELL)
    g = np.stack([np.asarray(field.truth["g1"]), np.asarray(field.truth["g2"])], axis=-1)
    shapes = fx.measure_shapes(stamps, fx.Psf.from_image(field.psf_image), noise_variance=1000.0**2)
    return shapes, eta_from_reduced_shear(g)


def test_nearly_every_galaxy_is_measured_at_its_own_root(population):
    shapes, eta = population
    near = np.linalg.norm(shapes.eta - eta, axis=1) < 0.3  # False for NaN
    assert np.mean(shapes.measured) >= 0.995
    assert np.mean(near) >= 0.995


def test_the_most_elongated_are_not_lost(population):
    # Losing the most elongated 2 % would bias the shear by 5 %.
    shapes, eta = population
    norm = np.linalg.norm(eta, axis=1)
    elongated = norm > np.quantile(norm, 0.98)
    near = np.linalg.norm(shapes.eta - eta, axis=1) < 0.3
    assert np.mean(near[elongated]) >= 0.85
    assert np.mean(shapes.measured[elongated]) >= 0.95


def test_errors_are_those_predicted(population):
    shapes, eta = population
    error = np.sqrt(np.stack([shapes.eta_cov[:, 0, 0], shapes.eta_cov[:, 1, 1]], axis=-1))
    pull = ((shapes.eta - eta) / error)[shapes.measured]
    # The median of |x| is 0.6745 for unit variance; 2000 galaxies fix it to 2 %.
    assert np.median(np.abs(pull)) / 0.6745 == pytest.approx(1.0, abs=0.06)
