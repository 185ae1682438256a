"""Noise biases the null of galaxies seen through an elliptical PSF, unless it is made round."""

from __future__ import annotations

import pytest

from fdnt_xp.data.noise_bias import noise_bias
from fdnt_xp.data.versions import Population, draw_versions

SIGNIFICANT = 4.0


@pytest.fixture(scope="module")
def biases():
    versions = draw_versions(Population(kind="exp", radius=2.3, psf_e=0.1, n_gal=512, seed=1))
    found = noise_bias(versions, 10.0, ["null", "null-plain"], n_stamps=49_152, batch=512)
    return {bias.estimator: bias for bias in found}


def test_noise_as_it_is_biases(biases):
    plain = biases["null-plain"]
    assert plain.m > SIGNIFICANT * plain.m_err
    # It follows neither the shear nor the frame without the PSF: leakage with the sign of -e.
    assert plain.c[0] < -SIGNIFICANT * plain.c_err[0]


def test_noise_made_round_does_not(biases):
    made_round = biases["null"]
    assert abs(made_round.m) < SIGNIFICANT * made_round.m_err
    for c, err in zip(made_round.c, made_round.c_err, strict=True):
        assert abs(c) < SIGNIFICANT * err


def test_the_test_could_tell(biases):
    assert biases["null"].m_err < 0.25 * biases["null-plain"].m


def test_making_it_round_costs_little(biases):
    assert biases["null"].sigma_g < 1.03 * biases["null-plain"].sigma_g
