"""Tables for the docs from the JSON that pytest-benchmark writes, in units of the group's FFT.

    pytest benchmarks --benchmark-only --benchmark-json=bench.json
    python benchmarks/tables.py bench.json

Each row is a group, that is stamps, library and precision; the last column is what its FFT
took for a galaxy.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from pathlib import Path

import click

from fdnt_xp.errors import CatalogError

FLOOR = "fft"
N_GAL = 1024
"""Of a benchmark that does not say how many galaxies it took."""
KEPT = ("round", "plain", "frozen", "eta")
"""Parameters that say what was run, not where."""


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("json", help="written by --benchmark-json")
    content = json.loads(Path(parser.parse_args().json).read_text(encoding="utf-8"))
    for line in tables(content["benchmarks"]):
        click.echo(line)


def tables(benchmarks: list[dict]) -> Iterator[str]:
    """Yield a table for each file of benchmarks."""
    for file in dict.fromkeys(one["fullname"].partition("::")[0] for one in benchmarks):
        here = [one for one in benchmarks if one["fullname"].startswith(file + "::")]
        yield from table(here)
        yield ""


def table(benchmarks: list[dict]) -> Iterator[str]:
    groups: dict[str, dict[str, dict]] = {}
    for one in benchmarks:
        groups.setdefault(one["group"], {})[name_of(one)] = one
    floors = {name_of(one): None for one in benchmarks if name_of(one).endswith(FLOOR)}
    names = [name for name in dict.fromkeys(map(name_of, benchmarks)) if name not in floors]
    yield f"| | {' | '.join(names)} | FFT, µs |"
    yield "|---" * (len(names) + 2) + "|"
    for group, found in groups.items():
        floor = next((found[name] for name in floors if name in found), None)
        if floor is None:
            raise CatalogError(f"there is no FFT to compare with in the group {group!r}")
        unit = per_galaxy(floor)
        ratios = [in_units(found[name], unit) if name in found else "" for name in names]
        yield f"| {group} | {' | '.join(ratios)} | {1e6 * unit:.2g} |"


def in_units(one: dict, unit: float) -> str:
    ratio = per_galaxy(one) / unit
    return f"{ratio:.2g}" if ratio < 99.5 else f"{ratio:,.0f}"


def per_galaxy(one: dict) -> float:
    return one["stats"]["median"] / one["extra_info"].get("n_gal", N_GAL)


def name_of(one: dict) -> str:
    """Return `test_null[round-float64-numpy]` as `null round`: the group says where it ran."""
    name, _, parameters = one["name"].removesuffix("]").partition("[")
    rest = [p for p in parameters.split("-") if p in KEPT]
    return " ".join([name.removeprefix("test_").replace("_", " "), *rest])


if __name__ == "__main__":
    main()
