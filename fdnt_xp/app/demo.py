"""The demonstration: draw galaxies of a known shear, measure them, and compare."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fdnt_xp.app.measure import Inputs, Settings
from fdnt_xp.app.measure_run import measure_files
from fdnt_xp.app.plots import plot_catalog, save_figure
from fdnt_xp.app.summary import format_measured, measured_rows, summary_lines
from fdnt_xp.data.catalog import read_catalog, write_catalog
from fdnt_xp.data.files import check_writable, make_folder
from fdnt_xp.data.images import write_image
from fdnt_xp.data.provenance import provenance
from fdnt_xp.data.simulate import NOISE_SIGMA, great08_image
from fdnt_xp.shears.from_shapes import shear_from_eta

if TYPE_CHECKING:
    from astropy.table import Table

SHEAR_RANGE = 0.03
"""Components of a shear that the seed chooses lie between minus and plus this."""


@dataclass(frozen=True, kw_only=True)
class Field:
    """What the demonstration draws.

    Parameters
    ----------
    side : int
        Cells along x and y.
    cell : int
        Pixels on a side of a cell.
    snr : float or None
        Of every galaxy; None for no noise.
    shear : tuple of float, or None
        Applied shear (g1, g2); the seed chooses it if None.
    seed : int
        Of everything random.
    """

    side: int = 40
    cell: int = 64
    snr: float | None = 200.0
    shear: tuple[float, float] | None = (0.02, -0.01)
    seed: int = 1

    @property
    def applied_shear(self) -> tuple[float, float]:
        """The shear that is applied, chosen or given."""
        if self.shear is not None:
            return self.shear
        g1, g2 = np.random.default_rng([self.seed, 8]).uniform(-SHEAR_RANGE, SHEAR_RANGE, 2)
        return float(g1), float(g2)


def run_demo(
    folder: Path,
    field: Field,
    inputs: Inputs | None,
    settings: Settings,
    *,
    overwrite: bool,
    say: Callable[[str], None],
) -> None:
    """Draw (unless there are inputs), measure, plot, and say what shear comes out.

    Parameters
    ----------
    folder : Path
        Where everything is written.
    field : Field
        What to draw.
    inputs : Inputs or None
        An image to measure instead of drawing one.
    settings : Settings
        How to measure.
    overwrite : bool
        Whether files that exist may be replaced.
    say : callable
        Takes each line of the report.
    """
    make_folder(folder)
    drawn = ["image.fits", "psf.fits", "truth.ecsv"] if inputs is None else []
    for name in (*drawn, "catalog.fits", "catalog.png"):
        check_writable(folder / name, overwrite=overwrite)
    truth, pairs = None, None
    if inputs is None:
        truth = field.applied_shear
        say(f"drawing    {field.side} x {field.side} galaxies of {field.cell} pixels with GalSim")
        inputs, pairs = draw_field(folder, field, overwrite=overwrite)
        if field.snr is None and settings.noise_variance is None:
            # Only the wings of the galaxies are on the borders.
            settings = replace(settings, noise_variance=NOISE_SIGMA**2)
    say(f"measuring  {inputs.image}")
    catalog = folder / "catalog.fits"
    seconds = measure_files(inputs, settings, str(catalog), overwrite=overwrite).seconds
    table = read_catalog(catalog)
    figure = plot_catalog(table, Path(inputs.image).name)
    save_figure(figure, folder / "catalog.png", overwrite=overwrite)
    for line in summary_lines(table, seconds):
        say(line)
    for line in shear_lines(table, truth, pairs):
        say(line)
    say(f"written    {', '.join([*drawn, 'catalog.fits', 'catalog.png'])} in {folder}")


def draw_field(folder: Path, field: Field, *, overwrite: bool) -> tuple[Inputs, NDArray[np.int64]]:
    """Draw a field, write image, PSF and truth; return them as inputs, and the pairs."""
    shear = field.applied_shear
    drawn = great08_image(
        n_x=field.side,
        n_y=field.side,
        cell=field.cell,
        shear=shear,
        snr=field.snr,
        seed=field.seed,
    )
    drawn.truth.meta = provenance(
        cell=field.cell, snr=field.snr, seed=field.seed, shear1=shear[0], shear2=shear[1]
    )
    image, psf = folder / "image.fits", folder / "psf.fits"
    write_image(drawn.image.astype(np.float32), image, overwrite=overwrite, cell=field.cell)
    write_image(drawn.psf_image, psf, overwrite=overwrite)
    write_catalog(drawn.truth, folder / "truth.ecsv", overwrite=overwrite)
    inputs = Inputs(image=str(image), psf=str(psf), cell=field.cell)
    return inputs, np.asarray(drawn.truth["pair"], dtype=np.int64)


def shear_lines(
    table: Table, truth: tuple[float, float] | None, pairs: NDArray[Any] | None = None
) -> Iterator[str]:
    """Yield the mean shear of a catalog by the simple responsivity, beside the truth.

    Parameters
    ----------
    table : astropy.table.Table
        The catalog.
    truth : tuple of float, or None
        The shear that was applied, if it is known.
    pairs : array, shape (n_gal,), optional
        Number of the pair at 90 degrees to which each galaxy belongs. The intrinsic shapes
        of a pair cancel, so the error is that of the means of pairs.
    """
    good = measured_rows(table)
    if np.sum(good) < 2:
        yield "shear      too few galaxies"
        return
    eta = np.stack([np.asarray(table[name])[good] for name in ("eta1", "eta2")], axis=-1)
    estimate = shear_from_eta(eta)
    shear, error = estimate.g, estimate.g_err
    if pairs is not None:
        error = error * _pair_factor(eta, pairs[good])
    for i, name in enumerate(("g1", "g2")):
        line = f"{'shear' if i == 0 else '':<10} {name} = {format_measured(shear[i], error[i])}"
        if truth is not None:
            line += f"   truth {truth[i]:+.4f}   {(shear[i] - truth[i]) / error[i]:+.1f} sigma"
        yield line


def _pair_factor(eta: NDArray[np.float64], pairs: NDArray[Any]) -> NDArray[np.float64]:
    """Return the error of the mean from whole pairs over that from single galaxies, (2,)."""
    _, first, count = np.unique(pairs, return_index=True, return_counts=True)
    _, last = np.unique(pairs[::-1], return_index=True)
    first, last = first[count == 2], len(pairs) - 1 - last[count == 2]
    if len(first) < 2:
        return np.ones(2)
    means = 0.5 * (eta[first] + eta[last])
    by_pairs = np.std(means, axis=0, ddof=1) / np.sqrt(len(means))
    return np.asarray(by_pairs / (np.std(eta, axis=0, ddof=1) / np.sqrt(len(eta))))
