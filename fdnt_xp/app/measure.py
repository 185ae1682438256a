"""What `fdnt-xp measure` does, between its options and its last line."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

import fdnt_xp.peers  # noqa: F401  gives its methods their names
from fdnt_xp.app.backends import Backend, load_backend
from fdnt_xp.app.responses import measure_source_responses
from fdnt_xp.app.runner import Noise, find_noise, measure_source
from fdnt_xp.data.images import Pixels, read_header, read_image
from fdnt_xp.data.ivar import IvarSource
from fdnt_xp.data.provenance import Value, provenance
from fdnt_xp.data.stamps import StampSource, cube_stamps, grid_stamps, position_stamps
from fdnt_xp.data.tables import read_positions
from fdnt_xp.data.wcs import wcs_jacobians
from fdnt_xp.errors import CatalogError, FdntValueError
from fdnt_xp.shapes.methods import SHAPES_ON_SKY, method_in_noise, shape_method

if TYPE_CHECKING:
    from astropy.table import Table


@dataclass(frozen=True, kw_only=True)
class Inputs:
    """What to measure, by the options of the command line.

    Parameters
    ----------
    image, psf : str
        FITS files.
    cell : int or None
        Side of the cells, if the image is a grid of them.
    positions : str or None
        Table of positions, if galaxies are anywhere on the image.
    stamp_size : int or None
        Side of the stamp around each position.
    x_column, y_column : str
        Columns of that table.
    origin : int
        Its first pixel's coordinate.
    noise_image : str or None
        FITS file, blank sky: an image, or a cube of stamps.
    mask, weight : str or None
        FITS files of the shape of the image: not 0 where a pixel is missing, and the inverse
        variance of each pixel.
    jacobian : str or None
        `dudx,dudy,dvdx,dvdy` of all pixels.
    wcs : bool
        Whether to take it from the header of the image, at each position.
    """

    image: str
    psf: str
    cell: int | None = None
    positions: str | None = None
    stamp_size: int | None = None
    x_column: str = "x"
    y_column: str = "y"
    origin: int = 0
    noise_image: str | None = None
    mask: str | None = None
    weight: str | None = None
    jacobian: str | None = None
    wcs: bool = False

    @property
    def layout(self) -> str:
        """How the stamps are found: "grid", "positions" or "cube"."""
        if self.cell is not None:
            return "grid"
        return "positions" if self.positions is not None else "cube"

    def refuse_as_output(self, output: str) -> None:
        """Raise `CatalogError` if the output would replace one of the inputs."""
        maps = (self.noise_image, self.mask, self.weight)
        for path in (self.image, self.psf, self.positions, *maps):
            if path is not None and Path(path).resolve() == Path(output).resolve():
                raise CatalogError(f"{output} is an input; choose another name for the output")


@dataclass(frozen=True, kw_only=True)
class Settings:
    """How to measure it.

    Parameters
    ----------
    backend, device, dtype : str
        See `fdnt_xp.app.backends.load_backend`.
    oversampling : int
        PSF pixels per image pixel.
    noise_variance : float or None
        Per pixel; measured on the noise image or the borders of the stamps if None.
    size : float or None
        Weight size, if fixed.
    chunk : int or None
        Galaxies at a time.
    quiet : bool
        No progress bar.
    responses : bool
        Whether to measure responses to shear, not shapes.
    method : str
        Of the shapes, by its name in `fdnt_xp.shapes.methods`.
    seed : int
        Of their synthetic noise.
    """

    backend: str = "numpy"
    device: str | None = None
    dtype: str = "float64"
    oversampling: int = 1
    noise_variance: float | None = None
    size: float | None = None
    chunk: int | None = None
    quiet: bool = False
    responses: bool = False
    method: str = "fdnt-ft"
    seed: int = 0


def open_source(inputs: Inputs) -> StampSource:
    """Open the image, and find the stamps in it.

    Raises
    ------
    FdntValueError
        If the options do not say how an image is divided.
    """
    if inputs.cell is not None and inputs.positions is not None:
        raise FdntValueError("give --cell or --positions, not both")
    if (inputs.positions is None) != (inputs.stamp_size is None):
        raise FdntValueError("--positions and --stamp-size go together")
    divided = inputs.layout != "cube"
    pixels = read_image(inputs.image, ndim=(2,) if divided else (2, 3))
    if inputs.cell is not None:
        return grid_stamps(pixels, inputs.cell)
    if inputs.positions is not None and inputs.stamp_size is not None:
        table = read_positions(
            inputs.positions,
            x_column=inputs.x_column,
            y_column=inputs.y_column,
            origin=inputs.origin,
        )
        return position_stamps(pixels, table.xy, inputs.stamp_size, table.ids)
    if pixels.ndim == 2:
        raise FdntValueError(
            f"{inputs.image} is one image of {pixels.shape[1]} x {pixels.shape[0]} pixels: say "
            "where its galaxies are, by --cell or by --positions and --stamp-size"
        )
    return cube_stamps(pixels)


def find_jacobians(inputs: Inputs, method: str, source: StampSource) -> NDArray[np.float64] | None:
    """Return the Jacobian of all pixels, (2, 2), or at each galaxy, (n_gal, 2, 2), if wanted."""
    if (inputs.wcs or inputs.jacobian is not None) and method not in SHAPES_ON_SKY:
        raise FdntValueError(
            f"--jacobian and --wcs are for --method {', '.join(SHAPES_ON_SKY)} and --responses"
        )
    if inputs.wcs:
        if inputs.jacobian is not None or inputs.layout == "cube":
            raise FdntValueError("--wcs wants positions on an image, and no --jacobian")
        return wcs_jacobians(read_header(inputs.image), source.positions)
    if inputs.jacobian is None:
        return None
    try:
        numbers = [float(part) for part in inputs.jacobian.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != 4:
        raise FdntValueError(
            f"--jacobian must be four numbers, dudx,dudy,dvdx,dvdy, not {inputs.jacobian!r}"
        )
    return np.reshape(numbers, (2, 2))


def measure_files(inputs: Inputs, settings: Settings) -> tuple[Table, float]:
    """Measure an image; return the catalog with its provenance, and the seconds it took."""
    backend = load_backend(settings.backend, settings.device, settings.dtype)
    method = shape_method(settings.method)
    if settings.responses and settings.method != "fdnt-ft":
        raise FdntValueError("--method chooses how shapes are measured, not --responses")
    if settings.responses and (inputs.mask or inputs.weight):
        raise FdntValueError("--mask and --weight are for shapes, not for --responses")
    source = open_source(inputs)
    mask = _open_beside(source, inputs.mask, "mask")
    weight = _open_beside(source, inputs.weight, "weight map")
    psf_pixels: Pixels = read_image(inputs.psf, ndim=(2, 3), what="PSF image")
    blank = None
    if inputs.noise_image is not None:
        blank = read_image(inputs.noise_image, ndim=(2, 3), what="noise image")
    noise = find_noise(source, settings.noise_variance, blank, mask=mask, mapped=weight is not None)
    ivar = None
    if mask is not None or weight is not None:
        ivar = IvarSource(mask=mask, weight=weight, variance=noise.variance)
    coloured = None
    if noise.power is not None and ivar is None:
        coloured = method_in_noise(settings.method, backend.from_numpy(noise.power))
    jacobians = find_jacobians(inputs, settings.method, source)
    start = time.perf_counter()
    if settings.responses:
        table = measure_source_responses(
            source,
            psf_pixels,
            backend=backend,
            noise=noise,
            oversampling=settings.oversampling,
            size=settings.size,
            seed=settings.seed,
            chunk=settings.chunk,
            quiet=settings.quiet,
            jacobians=jacobians,
        )
    else:
        table = measure_source(
            source,
            psf_pixels,
            backend=backend,
            method=coloured or method,
            noise_variance=None if coloured else noise.variance,
            ivar=ivar,
            oversampling=settings.oversampling,
            size=settings.size,
            chunk=settings.chunk,
            quiet=settings.quiet,
            jacobians=jacobians,
        )
    seconds = time.perf_counter() - start
    table.meta = _facts(
        inputs,
        settings,
        backend,
        noise,
        table.meta.get("RSTEP"),
        noise.power is not None if settings.responses else (coloured is not None) or None,
    )
    return table, seconds


def _open_beside(source: StampSource, path: str | None, what: str) -> StampSource | None:
    """Open a map of the shape of the image."""
    if path is None:
        return None
    return source.beside(read_image(path, ndim=(2, 3), what=what), what)


def _short(jacobian: str | None) -> str | None:
    """Return the numbers of a Jacobian with as many digits as a card of a header holds."""
    if jacobian is None:
        return None
    return ",".join(f"{float(part):.6g}" for part in jacobian.split(","))


def _facts(
    inputs: Inputs,
    settings: Settings,
    backend: Backend,
    noise: Noise,
    step: float | None,
    correlated: bool | None,
) -> dict[str, Value]:
    """Return the header of the catalog."""
    positions = inputs.layout == "positions"
    return provenance(
        method="responses" if settings.responses else settings.method,
        backend=backend.library,
        libver=backend.version,
        device=backend.device,
        dtype=backend.dtype,
        image=inputs.image,
        psfimage=inputs.psf,
        layout=inputs.layout,
        cell=inputs.cell,
        poscat=inputs.positions,
        stampsiz=inputs.stamp_size,
        xcolumn=inputs.x_column if positions else None,
        ycolumn=inputs.y_column if positions else None,
        origin=inputs.origin if positions else None,
        oversamp=settings.oversampling,
        noisevar=noise.variance,
        noiseerr=noise.relative_err,
        noisesrc=noise.origin,
        noiseimg=inputs.noise_image,
        maskimg=inputs.mask,
        ivarimg=inputs.weight,
        noisecor=correlated,
        jacobian="wcs" if inputs.wcs else _short(inputs.jacobian),
        bordlvl=noise.border.level if noise.border else None,
        wtsize=settings.size,
        chunk=settings.chunk,
        seed=settings.seed if settings.responses else None,
        rstep=step,
    )
