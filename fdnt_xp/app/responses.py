"""What `fdnt-xp measure --responses` does: the response of each galaxy to shear."""

from __future__ import annotations

import hashlib
import warnings
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fdnt_xp.app.backends import Backend
from fdnt_xp.app.noise import Noise
from fdnt_xp.app.runner import ChunkPsfs, MeasureChunk, jacobian_of, measure_chunks
from fdnt_xp.arrays import Array, array_namespace, device_of
from fdnt_xp.data.images import Pixels
from fdnt_xp.data.stamps import StampChunk, StampSource
from fdnt_xp.errors import FdntValueError, FdntWarning
from fdnt_xp.fourier.psf import Psf
from fdnt_xp.shears.responses import STEP, measure_responses
from fdnt_xp.shears.sample import default_size, rows_for_size

if TYPE_CHECKING:
    from astropy.table import Table


def measure_source_responses(
    source: StampSource,
    psf_pixels: Pixels,
    *,
    backend: Backend,
    noise: Noise,
    oversampling: int = 1,
    size: float | None = None,
    seed: int = 0,
    chunk: int | None = None,
    quiet: bool = True,
    jacobians: NDArray[np.float64] | None = None,
) -> Table:
    """Measure the response of every galaxy of a source; memory is that of one chunk.

    Parameters
    ----------
    source, psf_pixels, backend, oversampling, size, chunk, quiet, jacobians
        As for `measure_source`; without `size`, one weight fits all galaxies.
    noise : Noise
        Of the pixels.
    seed : int
        Of the synthetic noise. That of a galaxy depends on the seed and on its id alone,
        not on order or chunks.

    Returns
    -------
    astropy.table.Table
        One row for each galaxy, in order, with the columns of `ResponseResult.to_table`
        and the step of the frames in `meta["RSTEP"]`.

    Raises
    ------
    FdntValueError
        With JAX in float32.
    """
    psfs = ChunkPsfs.of(psf_pixels, source, backend, oversampling)
    size = size or common_size(source, psfs, noise, jacobians)
    measure = response_measurer(
        source, backend=backend, noise=noise, size=size, seed=seed, jacobians=jacobians
    )
    return measure_chunks(source, psfs, measure, chunk=chunk, quiet=quiet)


def response_measurer(
    source: StampSource,
    *,
    backend: Backend,
    noise: Noise,
    size: float | None,
    seed: int,
    jacobians: NDArray[np.float64] | None = None,
) -> MeasureChunk:
    """Return what measures the responses of a chunk of a source.

    Parameters
    ----------
    source, backend, noise, seed, jacobians
        As for `measure_source_responses`.
    size : float or None
        Of the weight: the same for all galaxies; None only if there are none.

    Raises
    ------
    FdntValueError
        With JAX in float32.
    """
    if (backend.library, backend.dtype) == ("jax", "float32"):
        raise FdntValueError(
            "responses need 64-bit integers, which JAX has with --dtype float64 only"
        )
    names = galaxy_numbers(source.ids)

    def measure(part: StampChunk, stamps: Array, psf: Psf) -> Table:
        xp = array_namespace(stamps=stamps)
        return measure_responses(
            stamps,
            psf,
            **_as_options(noise, backend),
            seed=seed,
            identifiers=xp.asarray(names[part.rows], dtype=xp.int64, device=device_of(stamps)),
            size=size,
            **_on_sky(jacobians, part.rows, backend),
        ).to_table()

    return measure


def galaxy_numbers(ids: NDArray[Any]) -> NDArray[np.int64]:
    """Return the numbers by which galaxies have their synthetic noise, shape (n_gal,).

    Whole numbers stay what they are; of anything else it is a hash of the text, 63 bits
    of BLAKE2b, the same on every machine. Warns (`FdntWarning`) if two galaxies have one
    id, for they get the same noise.
    """
    numbers = np.asarray(ids)
    if numbers.dtype.kind == "f" and np.all(np.isfinite(numbers) & (numbers == np.rint(numbers))):
        numbers = numbers.astype(np.int64)
    if numbers.dtype.kind not in "iu":
        numbers = np.fromiter(map(_hash, numbers), dtype=np.int64, count=len(numbers))
    if len(np.unique(numbers)) < len(numbers):
        warnings.warn(
            "some galaxies have the same id, and so get the same synthetic noise; errors of "
            "shear that treat them as independent are too small",
            FdntWarning,
            stacklevel=2,
        )
    return numbers.astype(np.int64)


def _hash(name: Any) -> int:
    text = name.decode() if isinstance(name, bytes) else str(name)
    digest = hashlib.blake2b(text.strip().encode(), digest_size=8).digest()
    return int.from_bytes(digest, "big") >> 1


def _on_sky(
    jacobians: NDArray[np.float64] | None, rows: slice, backend: Backend
) -> dict[str, Array]:
    return {} if jacobians is None else {"jacobian": jacobian_of(jacobians, rows, backend)}


def common_size(
    source: StampSource, psfs: ChunkPsfs, noise: Noise, jacobians: NDArray[np.float64] | None
) -> float | None:
    """Return the default size for all galaxies together, which no chunk of them knows."""
    if source.n_gal == 0:
        return None
    rows = rows_for_size(source.n_gal)
    stamps = psfs.backend.from_numpy(source.take(np.arange(source.n_gal)[rows]))
    options = _as_options(noise, psfs.backend) | _on_sky(jacobians, rows, psfs.backend)
    return default_size(stamps, psfs.rows(rows), max_shear=STEP, **options)


def _as_options(noise: Noise, backend: Backend) -> dict[str, Any]:
    """Return the noise as `measure_responses` wants it."""
    if noise.power is None:
        return {"noise_variance": noise.variance}
    return {"noise_power": backend.from_numpy(noise.power)}
