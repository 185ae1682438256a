"""A sample seen in counter-sheared frames, chunk by chunk.

Each chunk is transformed once, its synthetic noise drawn once, and then looked at in as many
frames as are asked for. Nothing of a chunk is kept but where its centroids were.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import TypeAlias

from fdnt_xp.arrays import Array, array_namespace, device_of
from fdnt_xp.fourier.noise import DeconvolvedNoise, PixelNoise, RoundNoise
from fdnt_xp.fourier.transform import DeconvolvedStamps, deconvolve
from fdnt_xp.shapes.centroid import starting_centroid, wide_weight
from fdnt_xp.shapes.job import Job, screen
from fdnt_xp.shears.counter_shear import FrameNoise, FrameValues, Statistic, in_new_frame
from fdnt_xp.shears.cuts import FrameQuantities

Gamma: TypeAlias = tuple[float, float]
"""A trial shear, eta-type."""


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

    def rows(self, rows: slice) -> SampleNoise:
        """Return the noise of a range of galaxies."""
        return SampleNoise(
            pixels=self.pixels.rows(rows),
            isotropise=self.isotropise,
            identifiers=self.identifiers[rows],
            seed=self.seed,
            symmetry=None if self.symmetry is None else self.symmetry[rows],
        )


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
    """

    stamps: Array
    job: Job
    statistic: Statistic
    reach: float
    chunk_size: int
    noise: SampleNoise | None = None
    _solutions: dict[int, tuple[Gamma, Array]] = field(default_factory=dict)
    """Of each chunk, by its first row: the last frame and the unknowns that were solved there,
    the start of the next."""

    @property
    def n_gal(self) -> int:
        """Number of galaxies."""
        return int(self.stamps.shape[0])

    def rows(self, rows: slice) -> FrameSample:
        """Return a range of the galaxies as a sample of its own."""
        return FrameSample(
            stamps=self.stamps[rows, :, :],
            job=self.job.rows(rows),
            statistic=self.statistic,
            reach=self.reach,
            chunk_size=self.chunk_size,
            noise=None if self.noise is None else self.noise.rows(rows),
        )

    def told_of_noise(self, factor: float) -> FrameSample:
        """Return the same galaxies, with the noise power said to be larger by a factor."""
        if self.noise is None:
            return self
        noise = replace(self.noise, pixels=self.noise.pixels.scaled(factor))
        return replace(self, noise=noise, _solutions=dict(self._solutions))

    def evaluate(self, gammas: Sequence[Gamma]) -> list[FrameValues]:
        """Return the statistic of all galaxies in each frame.

        Galaxies that cannot be measured at all are not `found`.
        """
        parts: list[list[FrameValues]] = [[] for _ in gammas]
        for first in range(0, self.n_gal, self.chunk_size):
            rows = slice(first, min(first + self.chunk_size, self.n_gal))
            for of_frame, values in zip(parts, self._evaluate_chunk(rows, gammas), strict=True):
                of_frame.append(values)
        return [_joined(of_frame) for of_frame in parts]

    def _evaluate_chunk(self, rows: slice, gammas: Sequence[Gamma]) -> Iterator[FrameValues]:
        xp = array_namespace(stamps=self.stamps)
        job = self.job.rows(rows)
        grid = job.coarse
        like = {"dtype": self.stamps.dtype, "device": device_of(self.stamps)}
        stamps, flags = screen(self.stamps[rows, :, :], job.psf)
        inverse_transfer = job.psf.inverse_transfer(grid)
        galaxies = deconvolve(stamps, inverse_transfer, grid)
        view = _NoiseOfChunk.of(self.noise, rows, job, inverse_transfer)
        frame, start = self._solutions.get(rows.start) or ((0.0, 0.0), self._start(job, galaxies))
        weight = job.weight.shrunk(self.reach)
        for gamma in gammas:
            sheared = grid.sheared(xp.asarray(gamma, **like))
            start = in_new_frame(start, grid.sheared(xp.asarray(frame, **like)), sheared)
            seen, noise = view.in_frame(galaxies, sheared, gamma, self.reach)
            values = self.statistic.evaluate(sheared, seen, weight, start, noise)
            frame, start = gamma, values.solution
            yield _only_where(values, flags == 0)
        self._solutions[rows.start] = (frame, start)

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
class _NoiseOfChunk:
    """The noise of one chunk, ready for any frame; empty where it is unknown."""

    pixels: PixelNoise | None
    deconvolved: DeconvolvedNoise | None
    synthetic: RoundNoise | None

    @classmethod
    def of(
        cls, noise: SampleNoise | None, rows: slice, job: Job, inverse_transfer: Array
    ) -> _NoiseOfChunk:
        if noise is None:
            return cls(pixels=None, deconvolved=None, synthetic=None)
        mine = noise.rows(rows)
        return cls(
            pixels=mine.pixels,
            deconvolved=DeconvolvedNoise.behind(
                job.psf, mine.pixels, job.coarse, inverse_transfer
            ),
            synthetic=RoundNoise.draw(
                mine.identifiers,
                mine.seed,
                mine.pixels.variance,
                job.coarse,
                mine.symmetry,
            )
            if mine.isotropise
            else None,
        )

    def in_frame(
        self, galaxies: DeconvolvedStamps, grid: object, gamma: Gamma, reach: float
    ) -> tuple[DeconvolvedStamps, FrameNoise | None]:
        """Return the galaxies with their noise made round, and what it then is."""
        if self.pixels is None or self.deconvolved is None:
            return galaxies, None
        power = self.deconvolved.power
        if self.synthetic is not None:
            xp = array_namespace(power=power)
            wanted = self.deconvolved.made_round(grid, gamma, reach)
            missing = xp.where(power > 0, wanted - power, xp.zeros_like(power))
            galaxies = self.synthetic.added_to(galaxies, missing)
            power = wanted
        return galaxies, FrameNoise(power=power, variance=self.pixels.variance)


def _only_where(values: FrameValues, usable: Array) -> FrameValues:
    """Return the values with those of unusable galaxies withdrawn."""
    xp = array_namespace(usable=usable)

    def masked(column: Array) -> Array:
        return xp.where(usable, column, xp.full_like(column, math.nan))

    quantities = {f.name: masked(getattr(values.quantities, f.name)) for f in fields(FrameQuantities)}
    return FrameValues(
        v=xp.where(usable[:, None], values.v, xp.zeros_like(values.v)),
        found=values.found & usable,
        solution=values.solution,
        quantities=FrameQuantities(**quantities),
    )


def _joined(parts: list[FrameValues]) -> FrameValues:
    xp = array_namespace(v=parts[0].v)

    def column(name: str) -> Array:
        return xp.concat([getattr(part, name) for part in parts], axis=0)

    quantities = {
        f.name: xp.concat([getattr(part.quantities, f.name) for part in parts])
        for f in fields(FrameQuantities)
    }
    return FrameValues(
        v=column("v"),
        found=column("found"),
        solution=column("solution"),
        quantities=FrameQuantities(**quantities),
    )
