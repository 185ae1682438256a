"""The noise bias of the population null, to a few 1e-4 in m at S/N 20 and 15, to 1e-3 at 10.

    python benchmarks/noise_bias.py noise-bias.json                        # all, for an hour or two
    python benchmarks/noise_bias.py noise-bias.json --kind exp --snr 15,20
    python benchmarks/noise_bias.py noise-bias.json --kind exp --stamps 20000

Each result is in the file as soon as it is there, and is not computed again: an interrupted
run goes on where it was. Another `--seed` adds results of other galaxies with other noise.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Iterator
from itertools import product
from pathlib import Path

# Before NumPy loads: small transforms are slower on many threads than on one.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import click

from fdnt_xp.app.backends import BACKENDS, DTYPES, load_backend
from fdnt_xp.app.check import table_header, table_row
from fdnt_xp.app.numbers import write_json
from fdnt_xp.data.noise_bias import NoiseBias, noise_bias
from fdnt_xp.data.versions import Population, draw_versions

POPULATIONS = tuple(product(("exp", "dev"), (1.3, 2.3), (0.02, 0.10), (0.02, 0.05)))
"""Kind, half-light radius in pixels, e1 of the PSF, applied g."""
M_ERR = {20.0: 2.5e-4, 15.0: 4e-4, 10.0: 1e-3}
"""What the error of m is to be, by S/N."""
SCATTER = {
    ("exp", 20.0): 0.045,
    ("exp", 15.0): 0.12,
    ("exp", 10.0): 0.45,
    ("dev", 20.0): 0.04,
    ("dev", 15.0): 0.09,
    ("dev", 10.0): 0.27,
}
"""Error of m from n stamps, times sqrt(n), as measured for the null with its control."""


def main() -> None:
    options = parse()
    done = read(options.output)
    to_array = load_backend(options.backend, options.device, options.dtype).from_numpy
    click.echo(table_header())
    for population, snrs in wanted(options):
        alike = (options.seed, options.padding, options.bound, population)
        known = {
            (r.estimator, r.snr)
            for r in done
            if (r.seed, r.padding, r.bound, r.population) == alike
        }
        missing = [
            (snr, name)
            for snr, name in product(snrs, options.estimator)
            if (name, snr) not in known
        ]
        versions = draw_versions(population) if missing else None
        for snr, name in missing:
            (result,) = noise_bias(
                versions,
                snr,
                [name],
                n_stamps=options.stamps or stamps_for(population.kind, snr),
                # A batch has a shear of its own, and the bias of a ratio, 1/batch, is in it: at
                # S/N 10 1e-3 for 256 galaxies.
                batch=256 if snr > 10.0 else 1024,
                padding=options.padding,
                bound=options.bound,
                seed=options.seed,
                to_array=to_array,
                quiet=False,
            )
            done.append(result)
            write_json([row.to_dict() for row in done], options.output, overwrite=True)
            click.echo(table_row(result))


def wanted(options: argparse.Namespace) -> Iterator[tuple[Population, list[float]]]:
    """Yield what is to be drawn, each with a seed of its own, and the S/N."""
    for number, (kind, radius, e, g) in enumerate(POPULATIONS):
        chosen = (kind in options.kind, radius in options.radius, e in options.psf_e)
        if all(chosen) and g in options.shear:
            yield (
                Population(
                    kind=kind,
                    radius=radius,
                    psf_e=e,
                    shear=g,
                    n_gal=options.galaxies,
                    seed=1000 * options.seed + number,
                ),
                options.snr,
            )


def stamps_for(kind: str, snr: float) -> int:
    return round((SCATTER[kind, snr] / M_ERR[snr]) ** 2)


def read(path: str) -> list[NoiseBias]:
    if not Path(path).exists():
        return []
    return [NoiseBias.from_dict(row) for row in json.loads(Path(path).read_text(encoding="utf-8"))]


def parse() -> argparse.Namespace:
    def numbers(text: str) -> list[float]:
        return [float(part) for part in text.split(",")]

    def names(text: str) -> list[str]:
        return text.split(",")

    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("output", help="JSON file that results are added to")
    parser.add_argument("--kind", type=names, default=["exp", "dev"])
    parser.add_argument("--radius", type=numbers, default=[1.3, 2.3])
    parser.add_argument("--psf-e", type=numbers, default=[0.02, 0.10])
    parser.add_argument("--shear", type=numbers, default=[0.02, 0.05])
    parser.add_argument("--snr", type=numbers, default=list(M_ERR))
    parser.add_argument("--estimator", type=names, default=["null"])
    parser.add_argument("--galaxies", type=int, default=1024)
    parser.add_argument("--stamps", type=int, help="of each result [default: for errors as above]")
    parser.add_argument("--padding", type=int, default=1)
    parser.add_argument("--bound", type=float, default=0.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--backend", choices=list(BACKENDS), default="numpy")
    parser.add_argument("--device")
    parser.add_argument("--dtype", choices=DTYPES, default="float64")
    return parser.parse_args()


if __name__ == "__main__":
    main()
