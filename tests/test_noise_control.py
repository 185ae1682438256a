"""The control variate of noise tests: the noise's second order, and of no mean."""

from __future__ import annotations

import math

import numpy as np
import pytest

import fdnt_xp as fx
from fdnt_xp.data.noise_control import KnownNoise, second_order
from fdnt_xp.shears.sample import NoiseOptions, make_sample
from images import eta_of, galaxies, gaussian_covariance, gaussian_image

E = np.array([[0.3, 0.1], [-0.2, 0.4], [0.0, 0.0], [0.5, -0.2]])
GAMMA = tuple(eta_of((0.03, -0.02)))
STAR = gaussian_image(gaussian_covariance((0.2, -0.1), 1.8), (48, 48))
PSF = fx.Psf.from_image(STAR)


def known(scale, seed, *, sign=1, softening=1.0, bound=0.0):
    """Return four galaxies with noise of S/N 15/scale, of one sign or the other."""
    clean = galaxies(E, centres=np.array([[0.3, -0.4], [0.0, 0.2], [-0.3, 0.1], [0.4, 0.4]]))
    sigma = scale * math.sqrt(np.mean(np.sum(clean**2, axis=(1, 2)))) / 15.0
    noise = sign * sigma * np.random.default_rng(seed).standard_normal(clean.shape)
    return KnownNoise(
        clean=clean,
        noise=noise,
        psf=PSF,
        variance=sigma**2,
        identifiers=np.arange(4) + 10 * seed,
        symmetry=np.full(4, 0 if sign > 0 else 4),
        seed=3,
        size=1.5,
        softening=softening,
        bound=bound,
    )


def measured(one):
    """Return v of the null's own statistic in the frame of GAMMA."""
    sample = make_sample(
        one.clean + one.noise,
        one.psf,
        statistic="frozen",
        weight=None,
        size=one.size,
        softening=one.softening,
        bound=one.bound,
        max_shear=0.1,
        padding=1,
        chunk_size=None,
        noise=NoiseOptions(
            noise_variance=one.variance,
            noise_power=None,
            isotropise=None,
            seed=one.seed,
            identifiers=one.identifiers,
            symmetry=one.symmetry,
        ),
    )
    return sample.evaluate([GAMMA])[0].v


def even_part(scale, seed, softening, bound):
    """Return the mean of v over both signs of the noise, and the control variate."""
    both = [known(scale, seed, sign=sign, softening=softening, bound=bound) for sign in (1, -1)]
    values = 0.5 * (measured(both[0]) + measured(both[1]))
    controls = [second_order(one, GAMMA) for one in both]
    np.testing.assert_allclose(controls[0], controls[1], rtol=1e-9, atol=1e-15)
    return values, controls[0]


@pytest.mark.parametrize(
    ("softening", "bound"), [(0.0, 0.0), (1.0, 0.0), (4.0, 0.0), (0.0, 3.0), (1.0, 3.0)]
)
def test_it_is_what_noise_does_at_second_order(softening, bound):
    # Between two draws all but the even orders of the noise cancels; what the control
    # leaves must be of fourth order.
    left = []
    for scale in (0.2, 0.1):
        (v1, c1), (v2, c2) = (even_part(scale, seed, softening, bound) for seed in (1, 2))
        effect, control = v1 - v2, c1 - c2
        assert np.max(np.abs(effect - control)) < 0.1 * np.max(np.abs(effect))
        left.append(np.max(np.abs(effect - control)))
    assert left[1] < left[0] / 10.0


def test_its_mean_is_zero():
    drawn = np.stack([second_order(known(1.0, seed), GAMMA) for seed in range(400)])
    error = np.std(drawn, axis=0) / math.sqrt(len(drawn))
    assert np.all(np.abs(np.mean(drawn, axis=0)) < 4.0 * error)
