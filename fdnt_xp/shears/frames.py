"""A sample seen in counter-sheared frames, chunk by chunk.

Each chunk is transformed once, its synthetic noise drawn once, and then looked at in as many
frames as are asked for. Nothing of a chunk is kept but where its centroids were, unless they
are so few that all of them fit the memory of some.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Final, TypeAlias

from fdnt_xp.arrays import Array, Rows, array_namespace, device_of, has_any, rows_of
from fdnt_xp.flags import FAILED, Flag
from fdnt_xp.fourier.grid import KGrid
from fdnt_xp.fourier.noise import DeconvolvedNoise, PixelNoise, RoundNoise
from fdnt_xp.fourier.sky_grid import SkyGrid
from fdnt_xp.fourier.transform import DeconvolvedStamps, deconvolve
from fdnt_xp.nulltests.weights import Weight
from fdnt_xp.shapes.centroid import starting_centroid, wide_weight
from fdnt_xp.shapes.job import Chunk, Job, in_order, screen
from fdnt_xp.shear import eta_from_matrix, shear_matrix
from fdnt_xp.shears.counter_shear import FrameNoise, FrameValues, Statistic, in_new_frame
from fdnt_xp.shears.cuts import QUANTITIES, FrameQuantities
from fdnt_xp.shears.masks import SampleMask

Gamma: TypeAlias = tuple[float, float]  # a trial shear, eta-type

_CHUNKS_HELD: Final = 4
"""Most chunks of a sample whose transforms are kept from one look at it to the next."""


@dataclass(frozen=True, kw_only=True)
class SampleNoise:
    """What is known of the noise of a sample, and what is done about it.

    Parameters
    ----------
    pixels : PixelNoise
    isotropise : bool
        Whether to add the synthetic noise that makes it round.
    identifiers : array of int64, shape (n_gal,)
        Names of the galaxies, to which their synthetic noise belongs.
    seed : int
    symmetry : array of integers, shape (n_gal,), optional
        How the synthetic noise of each galaxy is turned: see `RoundNoise.draw`.
    """

    pixels: PixelNoise
    isotropise: bool
    identifiers: Array
    seed: int
    symmetry: Array | None = None

    def draw(self, grid: KGrid) -> RoundNoise | None:
        """Draw the synthetic noise, if it is wanted."""
        if not self.isotropise:
            return None
        return RoundNoise.draw(
            self.identifiers, self.seed, self.pixels.variance, grid, self.symmetry
        )

    def take(self, rows: Rows) -> SampleNoise:
        """Return the noise of the given galaxies."""
        return replace(
            self,
            pixels=self.pixels.take(rows),
            identifiers=rows_of(self.identifiers, rows),
            symmetry=None if self.symmetry is None else rows_of(self.symmetry, rows),
        )


@dataclass(frozen=True, kw_only=True)
class SampleValues(FrameValues):
    """The statistic of a sample in one frame.

    Parameters
    ----------
    flags : array, shape (n_gal,), int32
        What is to be said of the stamps; those with a bit of `FAILED` are not `found`.
    centroid : array, shape (n_gal, 2)
        On the stamp, pixels from its middle.
    """

    flags: Array
    centroid: Array


@dataclass(kw_only=True)
class FrameSample:
    """Galaxies to be looked at in counter-sheared frames.

    Parameters
    ----------
    stamps : array, shape (n_gal, ny, nx)
    job : Job
    statistic : Statistic
    reach : float
        What divides the radius of the weight's disc, so that every frame has it whole.
    chunk_size : int
        Galaxies in memory together.
    noise : SampleNoise, optional
    mask : SampleMask, optional
    regular : array, shape (1,) or (n_gal,), bool, optional
        Where the Jacobian of a galaxy is one, if they have Jacobians.
    unit_length : float
        On the sky, of the lengths that the frames work in; quantities are in that of the sky.
    """

    stamps: Array
    job: Job
    statistic: Statistic
    reach: float
    chunk_size: int
    noise: SampleNoise | None = None
    mask: SampleMask | None = None
    regular: Array | None = None
    unit_length: float = 1.0
    _solutions: dict[int, tuple[Gamma, Array]] = field(default_factory=dict)
    """Of each chunk, by its number: the last frame and the unknowns that were solved there,
    the start of the next."""
    _optics: dict[int | None, _Optics] = field(default_factory=dict)
    """Of PSFs that galaxies share, by their number; None for the only one."""
    _held: dict[int, _Transformed] = field(default_factory=dict)
    """Chunks of a sample that is small enough."""
    _grids: dict[Gamma, KGrid] = field(default_factory=dict)
    """In the frames that are looked at, for all chunks; not on the sky."""

    @property
    def n_gal(self) -> int:
        """Number of galaxies."""
        return int(self.stamps.shape[0])

    def take(self, rows: Rows) -> FrameSample:
        """Return the given galaxies as a sample of its own."""
        return FrameSample(
            stamps=rows_of(self.stamps, rows),
            job=self.job.some(rows),
            statistic=self.statistic,
            reach=self.reach,
            chunk_size=self.chunk_size,
            noise=None if self.noise is None else self.noise.take(rows),
            mask=None if self.mask is None else self.mask.take(rows),
            regular=None if self.regular is None else _of_rows(self.regular, rows),
            unit_length=self.unit_length,
        )

    def told_of_noise(self, factor: float) -> FrameSample:
        """Return the same galaxies, with the noise power said to be larger by a factor."""
        if self.noise is None:
            return self
        noise = replace(self.noise, pixels=self.noise.pixels.scaled(factor))
        return replace(self, noise=noise, _solutions=dict(self._solutions), _optics={}, _held={})

    def evaluate(self, gammas: Sequence[Gamma]) -> list[SampleValues]:
        """Return the statistic of all galaxies in each frame."""
        parts: list[list[SampleValues]] = [[] for _ in gammas]
        self._grids.clear()
        for number in range(len(self._chunks)):
            for of_frame, values in zip(parts, self._evaluate_chunk(number, gammas), strict=True):
                of_frame.append(values)
        place = in_order(self._chunks)
        return [_joined(of_frame, place) for of_frame in parts]

    @cached_property
    def _chunks(self) -> list[Chunk]:
        return self.job.chunks(self.n_gal, self.chunk_size)

    def _evaluate_chunk(self, number: int, gammas: Sequence[Gamma]) -> Iterator[SampleValues]:
        held = self._transformed(number)
        job, noise, optics, galaxies = held.job, held.noise, held.optics, held.galaxies
        grid = job.coarse
        known = self._solutions.get(number)
        frame, start = (None, self._start(job, galaxies)) if known is None else known
        for gamma in gammas:
            sheared, weight = self._in_frame(job, gamma)
            old = grid if frame is None else self._in_frame(job, frame)[0]
            start = in_new_frame(start, old, sheared)
            start = self._counter_sheared(start, frame, gamma)
            seen, frame_noise = galaxies, None
            if noise is not None and optics.noise is not None:
                power = optics.noise.power
                if held.synthetic is not None:
                    power = optics.noise.made_round(sheared, gamma, self.reach)
                    seen = held.synthetic.added_to(galaxies, power - optics.noise.power)
                frame_noise = FrameNoise(power=power, variance=noise.pixels.variance)
            values = self.statistic.evaluate(sheared, seen, weight, start, frame_noise)
            frame, start = gamma, values.solution
            centroid = job.length * sheared.on_stamp(values.solution[:, -2:])
            yield _withdrawn(values, held.flags, centroid, self.unit_length)
        if frame is not None:
            self._solutions[number] = (frame, start)

    def _transformed(self, number: int) -> _Transformed:
        """Return what a chunk looks like in any frame; a small sample's is made but once."""
        if number in self._held:
            return self._held[number]
        chunk = self._chunks[number]
        job = self.job.of(chunk)
        noise = None if self.noise is None else self.noise.take(chunk.rows)
        stamps, flags = self._screened(chunk, job)
        optics = self._optics_of(chunk, job, noise)
        made = _Transformed(
            job=job,
            noise=noise,
            optics=optics,
            galaxies=deconvolve(stamps, optics.inverse_transfer, job.coarse),
            synthetic=None if noise is None else noise.draw(job.coarse),
            flags=flags,
        )
        if self.n_gal <= _CHUNKS_HELD * self.chunk_size:
            self._held[number] = made
        return made

    def _in_frame(self, job: Job, gamma: Gamma) -> tuple[KGrid, Weight]:
        """Return the grid, and the weight that is round there, in the frame of a trial shear.

        Where the pixels have Jacobians the shear is one of the sky: `kappa = S_gamma A k`.
        """
        xp = array_namespace(stamps=self.stamps)
        weight = job.weight.shrunk(self.reach)
        if weight.frame is None and gamma in self._grids:
            return self._grids[gamma], weight
        shear = xp.asarray(gamma, dtype=self.stamps.dtype, device=device_of(self.stamps))
        if weight.frame is None:
            return self._grids.setdefault(gamma, job.coarse.sheared(shear)), weight
        matrix = xp.matmul(shear_matrix(shear)[None, :, :], weight.frame)
        return SkyGrid.of(job.coarse, matrix), replace(weight, frame=matrix)

    def _counter_sheared(self, solution: Array, old: Gamma | None, new: Gamma) -> Array:
        """Return solutions with their shapes as those of frame `old` look in another.

        But for the ellipticity gradient that is what the search will find there.
        """
        if self.statistic.n_unknown == 2:
            return solution
        xp = array_namespace(solution=solution)
        by_old, by_new = (
            shear_matrix(xp.asarray(gamma, dtype=solution.dtype, device=device_of(solution)))
            for gamma in (old or (0.0, 0.0), (-new[0], -new[1]))
        )
        change = xp.matmul(by_new, by_old)[None, :, :]
        eta = eta_from_matrix(xp.matmul(change, shear_matrix(solution[:, :2])))
        return xp.concat([eta, solution[:, 2:]], axis=-1)

    def _screened(self, chunk: Chunk, job: Job) -> tuple[Array, Array]:
        """Return stamps that do no harm, their gaps filled, and what is to be said of them.

        Returns
        -------
        stamps : array, shape (n_gal, ny, nx)
        flags : array, shape (n_gal,), int32
            Bits of `Flag`; with one of `FAILED` the galaxy cannot be measured.
        """
        stamps = rows_of(self.stamps, chunk.rows)
        xp = array_namespace(stamps=stamps)
        reasons = []
        if self.mask is not None:
            stamps, dropped, filled = self.mask.take(chunk.rows).applied(stamps, job.psf)
            reasons = [(Flag.MASKED, dropped), (Flag.FILLED, filled)]
        stamps, flags = screen(stamps, job.psf)
        if self.regular is not None:
            irregular = xp.broadcast_to(~_of_rows(self.regular, chunk.rows), flags.shape)
            reasons.append((Flag.BAD_JACOBIAN, irregular))
        for reason, holds in reasons:
            flags = flags + xp.astype(holds, xp.int32) * int(reason)
        return stamps, flags

    def _optics_of(self, chunk: Chunk, job: Job, noise: SampleNoise | None) -> _Optics:
        """Return what galaxies of a chunk share, made once for each PSF that many share."""
        if not job.weight.shared or not (noise is None or noise.pixels.shared):
            return _Optics.of(job, noise)
        if chunk.psf_number not in self._optics:
            self._optics[chunk.psf_number] = _Optics.of(job, noise)
        return self._optics[chunk.psf_number]

    def _start(self, job: Job, galaxies: DeconvolvedStamps) -> Array:
        """Return a first guess in the frame of the image."""
        xp = array_namespace(stamps=self.stamps)
        side = min(int(n) for n in self.stamps.shape[1:])
        if self.noise is None:
            wide = wide_weight(job.weight, job.coarse, side)
            centre = starting_centroid(job.coarse, galaxies, wide, job.length, reach=0.5 * side)
        else:
            centre = xp.zeros_like(galaxies.re[:, :2])
        zeros = [xp.zeros_like(centre)] * (self.statistic.n_unknown // 2 - 1)
        return xp.concat([*zeros, centre / job.length], axis=-1)


@dataclass(frozen=True, kw_only=True)
class _Optics:
    """What division by the transfer function does to galaxies and to their noise."""

    inverse_transfer: Array
    noise: DeconvolvedNoise | None

    @classmethod
    def of(cls, job: Job, noise: SampleNoise | None) -> _Optics:
        inverse_transfer = job.psf.inverse_transfer(job.coarse)
        if noise is None:
            return cls(inverse_transfer=inverse_transfer, noise=None)
        deconvolved = DeconvolvedNoise.behind(job.psf, noise.pixels, job.coarse, inverse_transfer)
        return cls(inverse_transfer=inverse_transfer, noise=deconvolved)


@dataclass(frozen=True, kw_only=True)
class _Transformed:
    """Galaxies of a chunk, divided by the transfer function, and what goes with them."""

    job: Job
    noise: SampleNoise | None
    optics: _Optics
    galaxies: DeconvolvedStamps
    synthetic: RoundNoise | None
    flags: Array


def _of_rows(column: Array, rows: Rows) -> Array:
    """Return what the given galaxies have; one for all stays."""
    return column if int(column.shape[0]) == 1 else rows_of(column, rows)


def _withdrawn(
    values: FrameValues, flags: Array, centroid: Array, unit_length: float
) -> SampleValues:
    """Return the values with those of unusable galaxies withdrawn."""
    xp = array_namespace(flags=flags)
    usable = ~has_any(flags, int(FAILED))

    def masked(column: Array) -> Array:
        return xp.where(usable, column, xp.full_like(column, math.nan))

    def or_zero(pair: Array) -> Array:
        return xp.where(usable[:, None], pair, xp.zeros_like(pair))

    quantities = {name: masked(getattr(values.quantities, name)) for name in QUANTITIES}
    quantities["size"] = unit_length * quantities["size"]
    variance = values.v_variance
    return SampleValues(
        v=or_zero(values.v),
        v_variance=None if variance is None else or_zero(variance),
        found=values.found & usable,
        solution=values.solution,
        quantities=FrameQuantities(**quantities),
        flags=flags,
        centroid=centroid,
    )


def _joined(parts: list[SampleValues], place: Array | None) -> SampleValues:
    """Return the values of all chunks, in the order of the galaxies."""
    xp = array_namespace(v=parts[0].v)

    def whole(columns: list[Array]) -> Array:
        joined = xp.concat(columns, axis=0)
        return joined if place is None else xp.take(joined, place, axis=0)

    def column(name: str) -> Array:
        return whole([getattr(part, name) for part in parts])

    quantities = {
        name: whole([getattr(part.quantities, name) for part in parts]) for name in QUANTITIES
    }
    return SampleValues(
        v=column("v"),
        v_variance=None if parts[0].v_variance is None else column("v_variance"),
        found=column("found"),
        solution=column("solution"),
        quantities=FrameQuantities(**quantities),
        flags=column("flags"),
        centroid=column("centroid"),
    )
