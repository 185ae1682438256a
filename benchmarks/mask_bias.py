"""What missing pixels do to the population null, by kind of hole and treatment.

    python benchmarks/mask_bias.py mask-bias.json                 # all, an hour
    python benchmarks/mask_bias.py mask-bias.json --holes column --treatment fill --snr 20

Exponential galaxies of half-light radius 2.3 pixels, PSF of e = 0.10, g = 0.02, as in
`noise_bias.py`, whose control variate makes the errors small. Results are added to the file as
they come, and are not computed again.
"""

from __future__ import annotations

import argparse
import json
import math
import os
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from scipy import ndimage

from fdnt_xp.app.numbers import write_json
from fdnt_xp.data.noise_control import KnownNoise, second_order
from fdnt_xp.data.versions import Population, draw_versions
from fdnt_xp.fourier.missing import fill_missing
from fdnt_xp.fourier.psf import Psf
from fdnt_xp.shapes.gl_fit import filled, fit_laguerre
from fdnt_xp.shears.sample import NoiseOptions, default_size, make_sample

HOLES = ("random 1 %", "random 5 %", "cosmic ray", "column", "far column", "corner")
TREATMENTS = ("zero", "neighbours", "opposite", "fourfold", "laguerre", "fill")
BATCH, STEP = 512, 0.02
FOOTPRINT = 5.0  # of the weight as it is on the image, as the null has it
SYMMETRY = np.repeat([0, 1, 4, 5], BATCH)


def holes(kind: str, rng: np.random.Generator, n: int, size: int) -> np.ndarray:
    """Return masks (n, size, size) of one kind; those of one place are the same for all."""
    mask = np.zeros((n, size, size), dtype=bool)
    middle = size // 2
    if kind.startswith("random"):
        return rng.uniform(size=mask.shape) < float(kind.split()[1]) / 100.0
    if kind == "cosmic ray":  # five to eight pixels in a line with a kink, within 10 of the middle
        for one in mask:
            y, x = rng.integers(middle - 10, middle + 10, 2)
            dy, dx = rng.uniform(-1, 1, 2)
            steps = np.arange(8)
            one[np.rint(y + dy * steps).astype(int), np.rint(x + dx * steps).astype(int)] = True
    elif kind == "column":
        mask[:, :, middle + 2] = True
    elif kind == "far column":
        mask[:, :, middle + 8] = True
    elif kind == "corner":
        mask[:, : size // 3, : size // 3] = True
    return mask


def treated(
    stamps: np.ndarray,
    mask: np.ndarray,
    treatment: str,
    psf: Psf,
    variance: float,
    noise: np.ndarray,
    size: float,
) -> np.ndarray:
    """Return stamps with something in their holes; `noise` is more of it, of unit variance."""
    if treatment == "neighbours":
        there = (~mask).astype(float)
        sums, weights = (ndimage.gaussian_filter(a, (0, 1, 1)) for a in (stamps * there, there))
        return np.where(mask, sums / np.maximum(weights, 1e-12), stamps)
    if treatment == "opposite":
        across = np.where(mask, 0.0, stamps)[:, ::-1, ::-1]
        return np.where(mask, across, stamps)
    if treatment == "laguerre":
        ivar = np.where(mask, 0.0, 1.0 / variance)
        stamps = np.where(mask, 0.0, stamps)
        fit = fit_laguerre(stamps, ivar, order=12, chunk_size=256)
        model = filled(stamps, ivar, fit)
        # Pixels without noise would be another kind of hole.
        model = model + np.where(mask, math.sqrt(variance) * noise, 0.0)
        instead = treated(stamps, mask, "fill", psf, variance, noise, size)
        return np.where(np.isnan(model), instead, model)
    if treatment == "fourfold":
        mask = np.any([np.rot90(mask, k, axes=(1, 2)) for k in range(4)], axis=0)
    if treatment == "fill":
        # As the null does: what is far from the middle does not matter, and is not filled.
        stamps = np.where(mask, 0.0, stamps)
        x = np.arange(mask.shape[-1]) - 0.5 * (mask.shape[-1] - 1)
        footprint = FOOTPRINT * math.hypot(size, 3.0 / psf.largest_kmax)
        near = x[:, None] ** 2 + x**2 <= footprint**2
        parts = range(0, len(stamps), 256)
        return np.concatenate(
            [fill_missing(stamps[i : i + 256], mask[i : i + 256] & near, psf) for i in parts]
        )
    return np.where(mask, 0.0, stamps)


def turned(images: np.ndarray) -> np.ndarray:
    return np.rot90(images, -1, axes=(-2, -1))


def measure(kind: str, treatment: str, snr: float, n_stamps: int) -> dict[str, Any]:
    """Return m and c with their errors."""
    population = Population(kind="exp", radius=2.3, psf_e=0.1, shear=0.02, n_gal=1024)
    versions = draw_versions(population)
    psf = Psf.from_image(versions.psf_images[0])
    sigma = math.sqrt(np.mean(np.sum(versions.stamps**2, axis=(-2, -1)))) / snr
    gamma = 2.0 * math.atanh(population.shear)
    whole = versions.stamps[:, 0, 0]
    size = default_size(whole, psf, noise_variance=sigma**2)
    means, slopes = [], []
    for number in range(max(2, math.ceil(n_stamps / (8 * BATCH)))):
        rng = np.random.default_rng([7, number, HOLES.index(kind)])
        rows = (number * BATCH + np.arange(BATCH)) % population.n_gal
        noise = sigma * rng.standard_normal((BATCH, *versions.stamps.shape[-2:]))
        noise = np.concatenate([noise, turned(noise), -noise, -turned(noise)])
        mask = holes(kind, rng, BATCH, noise.shape[-1])
        # Holes in places of their own turn with the galaxy, as all else but the PSF.
        random = kind.startswith("random") or kind == "cosmic ray"
        mask = np.concatenate([mask, turned(mask) if random else mask] * 2)
        more = rng.standard_normal((BATCH, *versions.stamps.shape[-2:]))
        more = np.concatenate([more, turned(more), -more, -turned(more)])
        names = number * BATCH + np.tile(np.arange(BATCH), 4)
        pair = []
        for minus, sign in enumerate((1.0, -1.0)):
            clean = np.concatenate([versions.stamps[rows, turn, minus] for turn in (0, 1)] * 2)
            known = KnownNoise(
                clean=clean,
                noise=noise,
                psf=psf,
                variance=sigma**2,
                identifiers=names,
                symmetry=SYMMETRY,
                seed=1,
                size=size,
                softening=1.0,
            )
            sample = make_sample(
                treated(clean + noise, mask, treatment, psf, sigma**2, more, size),
                psf,
                statistic="frozen",
                weight=None,
                size=size,
                softening=1.0,
                max_shear=0.1,
                padding=1,
                chunk_size=None,
                noise=NoiseOptions(
                    noise_variance=sigma**2,
                    noise_power=None,
                    isotropise=None,
                    seed=1,
                    identifiers=names,
                    symmetry=SYMMETRY,
                ),
            )
            true = (sign * gamma, 0.0)
            (v,) = sample.evaluate([true])
            pair.append(np.mean(v.v - second_order(known, true), axis=0))
            if number == 0:
                ends = sample.evaluate([(true[0] + s, 0.0) for s in (STEP, -STEP)])
                slopes.append(np.mean(ends[0].v[:, 0] - ends[1].v[:, 0]) / (2.0 * STEP))
        means.append(pair)
    g = -0.5 * np.array(means) / np.mean(slopes)
    m = (g[:, 0, 0] - g[:, 1, 0]) / (2.0 * population.shear)
    c = 0.5 * (g[:, 0] + g[:, 1])
    root = math.sqrt(len(m))
    return {
        "holes": kind,
        "treatment": treatment,
        "snr": snr,
        "n_stamps": 8 * BATCH * len(m),
        "m": float(np.mean(m)),
        "m_err": float(np.std(m, ddof=1)) / root,
        "c": np.mean(c, axis=0).tolist(),
        "c_err": (np.std(c, axis=0, ddof=1) / root).tolist(),
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("output", help="JSON file that results are added to")
    parser.add_argument("--holes", nargs="*", default=HOLES, choices=HOLES)
    parser.add_argument("--treatment", nargs="*", default=TREATMENTS, choices=TREATMENTS)
    parser.add_argument("--snr", nargs="*", type=float, default=[200.0, 20.0])
    parser.add_argument("--stamps", type=int, default=65_536, help="of each result")
    options = parser.parse_args()
    path = Path(options.output)
    done = json.loads(path.read_text(encoding="utf-8")) if path.exists() else []
    for snr in options.snr:
        for kind in options.holes:
            for treatment in options.treatment:
                if any(
                    (row["holes"], row["treatment"], row["snr"]) == (kind, treatment, snr)
                    for row in done
                ):
                    continue
                row = measure(kind, treatment, snr, options.stamps)
                done.append(row)
                write_json(done, options.output, overwrite=True)
                c = ", ".join(
                    f"{1e4 * a:+.2f} ± {1e4 * b:.2f}"
                    for a, b in zip(row["c"], row["c_err"], strict=True)
                )
                print(
                    f"{snr:5g}  {kind:10}  {treatment:10}  m = {1e3 * row['m']:+.2f} ± "
                    f"{1e3 * row['m_err']:.2f} e-3   c = {c} e-4",
                    flush=True,
                )


if __name__ == "__main__":
    main()
