"""Small directories laid out as GREAT08's, of Gaussian galaxies in Gaussian noise."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from click.testing import CliRunner

from fdnt_xp.app.cli import main
from fdnt_xp.data.catalog import read_catalog
from fdnt_xp.data.images import write_image
from images import galaxies, star

CELL = 36
N_SIDE = 6
SIGMA = 1e-4
"""Of the noise of a pixel; the flux of a galaxy is 1, its S/N about 800."""


def write_challenge(folder: Path, numbers: range) -> Path:
    """Make a directory with these sets, all behind one PSF."""
    folder.mkdir()
    write_image(star((CELL, CELL)), folder / "star.fit")
    for number in numbers:
        write_image(set_image(number), folder / f"set{number:04d}.fit")
    lines = ["set psf", *(f"set{number:04d} star" for number in numbers)]
    (folder / "psf_map.txt").write_text("\n".join(lines) + "\n")
    return folder


def set_image(number: int) -> np.ndarray:
    """Return the image of a set, float32."""
    stamps = set_stamps(number)
    rows = stamps.reshape(N_SIDE, N_SIDE, CELL, CELL).transpose(0, 2, 1, 3)
    return rows.reshape(N_SIDE * CELL, N_SIDE * CELL)


def set_stamps(number: int) -> np.ndarray:
    """Return the stamps of a set, along x first, float32."""
    rng = np.random.default_rng(number)
    n = N_SIDE**2
    stamps = galaxies(rng.uniform(-0.3, 0.3, (n, 2)), (CELL, CELL))
    return (stamps + SIGMA * rng.standard_normal(stamps.shape)).astype(np.float32)


def run(*arguments, code: int = 0) -> str:
    """Run `fdnt-xp great08` and return what it printed, stdout and stderr together."""
    result = CliRunner().invoke(main, ["great08", *map(str, arguments)])
    assert result.exit_code == code, result.output
    assert "Traceback" not in result.output
    return result.output


def same_result(out: Path, reference: Path) -> None:
    """Check that two runs say the same to the last digit, and that nothing else is there."""
    files = {str(file.relative_to(out)) for file in out.rglob("*") if file.is_file()}
    assert files == {
        str(file.relative_to(reference)) for file in reference.rglob("*") if file.is_file()
    }
    assert (out / "submission.ecsv").read_text() == (reference / "submission.ecsv").read_text()
    names = [file.stem for file in (reference / "sets").iterdir()]
    for name in names:
        catalogs = [read_catalog(path / "catalogs" / f"{name}.fits") for path in (out, reference)]
        assert catalogs[0].colnames == catalogs[1].colnames
        for column in catalogs[0].colnames:
            np.testing.assert_array_equal(catalogs[0][column], catalogs[1][column])
        results = [json.loads((path / "sets" / f"{name}.json").read_text()) for path in
                   (out, reference)]  # fmt: skip
        for result in results:
            del result["seconds"]
        assert results[0] == results[1]
