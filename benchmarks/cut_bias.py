"""Bias of cuts, of responses, and of a noise power that is wrong: figures of docs/noise.md.

python benchmarks/cut_bias.py            # all, half an hour
python benchmarks/cut_bias.py power      # or: cuts, responses, sizes, power
"""

from __future__ import annotations

import os
import sys
from dataclasses import replace
from itertools import product

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

import fdnt_xp as fx
from fdnt_xp.data import noise_estimators
from fdnt_xp.data.noise_bias import NoiseBias, noise_bias
from fdnt_xp.data.versions import Population, Versions, draw_versions


def say(what: str, bias: NoiseBias) -> None:
    print(
        f"{what:34} m = {1e3 * bias.m:+.2f} ± {1e3 * bias.m_err:.2f} e-3   c1 = "
        f"{1e4 * bias.c[0]:+.2f} ± {1e4 * bias.c_err[0]:.2f} e-4   unused {bias.unused:.3f}",
        flush=True,
    )


def cuts() -> None:
    """Galaxies of fluxes over a factor of 6 about S/N 15, 40 % of them removed."""
    drawn = draw_versions(Population(radius=2.3, psf_e=0.1, shear=0.05, n_gal=1024, seed=21))
    fluxes = 6.0 ** np.random.default_rng(5).uniform(-0.6, 0.4, 1024)
    versions = replace(drawn, stamps=drawn.stamps * fluxes[:, None, None, None, None])
    hard = fx.Cut(quantity="snr", low=15.0)
    soft = replace(hard, width=1.5)
    for what, name, n_stamps, options in (
        ("no cut", "null", 65_536, {}),
        ("as seen", "null", 98_304, {"observed_cut": 0.4}),
        ("in the frame, hard", "null", 400_000, {"cut": hard}),
        ("in the frame, soft", "null", 100_000, {"cut": soft}),
        ("in the frame, soft, responses", "responses", 100_000, {"cut": soft}),
    ):
        batch = 2048 if "cut" in options else 1024
        (bias,) = noise_bias(versions, 23.0, [name], n_stamps=n_stamps, batch=batch, **options)
        say(what, bias)


def responses() -> None:
    """Responses at S/N 15 to better than 1e-3; the control does nothing for them."""
    versions = draw_versions(Population(radius=2.3, psf_e=0.1, shear=0.02, n_gal=1024, seed=41))
    options = {"n_stamps": 458_752, "batch": 2048, "control": False}
    (bias,) = noise_bias(versions, 15.0, ["responses"], **options)
    say("responses", bias)


def sizes() -> None:
    """Error of the shear of one galaxy at S/N 15, by size and bound of the null's weight.

    1.46 pixels is what would suit the PSF.
    """
    for kind, radius in product(("exp", "dev"), (1.3, 2.3)):
        versions = draw_versions(
            Population(kind=kind, radius=radius, psf_e=0.02, shear=0.02, n_gal=1024, seed=4)
        )
        clean = versions.stamps[:, :, 0].reshape(-1, *versions.stamps.shape[-2:])
        sigma = np.sqrt(np.mean(np.sum(versions.stamps**2, axis=(-2, -1)))) / 15.0
        stamps = np.concatenate([clean] * 3)
        stamps = stamps + sigma * np.random.default_rng(1).standard_normal(stamps.shape)
        psf = fx.Psf.from_image(versions.psf_images[0])
        for size, bound in ((None, 0.0), (None, 3.0), (1.46, 0.0)):
            null = fx.population_null(stamps, psf, noise_variance=sigma**2, size=size, bound=bound)
            error = np.sqrt(len(stamps) * np.mean(null.g_err**2))
            print(f"{kind} {radius}: null, size={size}, bound={bound:g}: {error:.4f}", flush=True)
        (bias,) = noise_bias(versions, 15.0, ["hsm"], n_stamps=16_384, batch=1024, seed=5)
        error = bias.sigma_g / (1.0 + bias.m)
        print(
            f"{kind} {radius}: REGAUSS {bias.sigma_g:.4f}, over its 1 + m {error:.4f}", flush=True
        )


def power() -> None:
    """The null at S/N 15, told of a noise power that is wrong by some factor."""
    versions = draw_versions(Population(radius=2.3, psf_e=0.1, shear=0.05, n_gal=1024, seed=31))
    for factor in (1.0, 1.0 / 1.3, 1.1):
        say(f"told {factor:.2f} of the noise power", told(versions, factor))


def told(versions: Versions, factor: float) -> NoiseBias:
    null = noise_estimators.ESTIMATORS["null"]

    def measure(stamps, settings):
        return null.measure(replace(stamps, variance=factor * stamps.variance), settings)

    noise_estimators.ESTIMATORS["told"] = replace(null, measure=measure)
    (bias,) = noise_bias(versions, 15.0, ["told"], n_stamps=49_152)
    return bias


if __name__ == "__main__":
    parts = {"cuts": cuts, "responses": responses, "sizes": sizes, "power": power}
    for part in sys.argv[1:] or parts:
        parts[part]()
