"""Objects from their first look to their shapes: the root of the summed tests, noise, fluxes."""

from __future__ import annotations

from dataclasses import dataclass, replace

from fdnt_xp.arrays import Array, array_namespace, count_true, device_of
from fdnt_xp.flags import Flag
from fdnt_xp.fourier.grid import KGrid
from fdnt_xp.nulltests.dogleg import RootResult
from fdnt_xp.nulltests.exposures import Exposures, ExposureTests, by_object
from fdnt_xp.nulltests.tests import NullTests
from fdnt_xp.shapes.exposure_results import ObjectShapes
from fdnt_xp.shapes.exposure_sources import StampSources
from fdnt_xp.shapes.first_look import FirstLook
from fdnt_xp.shapes.job import FINER, Job
from fdnt_xp.shapes.results import ShapeResult
from fdnt_xp.shapes.search import (
    COARSE_STEPS,
    FINE_ABOVE,
    TWO_STEPS_OFF,
    looked_at,
    one_step_off,
    round_start,
    search,
    squeezed,
    stepped,
)
from fdnt_xp.shapes.solution import SolutionNoise, describe_at_origin


@dataclass(frozen=True, kw_only=True)
class SeenObjects:
    """Objects ready to be solved, and what is known of them.

    Parameters
    ----------
    job : Job
        Of their stamps.
    sources : StampSources
    look : FirstLook
    unit : array, shape (n_obj,)
        Of lengths on the sky.
    band : array of int64, shape (n_stamp,), optional
    n_bands : int
    stamp_shape : tuple of int
        (ny, nx).
    n_at_once : int
        Stamps that fit the memory together.
    """

    job: Job
    sources: StampSources
    look: FirstLook
    unit: Array
    band: Array | None
    n_bands: int
    stamp_shape: tuple[int, int]
    n_at_once: int

    def take(self, rows: Array) -> SeenObjects:
        """Return the given objects (integer array)."""
        xp = array_namespace(rows=rows)
        stamps = self.look.exposures.stamps_of(rows)
        return replace(
            self,
            job=self.job.take(stamps),
            sources=self.sources.take(stamps),
            look=self.look.take(rows),
            unit=xp.take(self.unit, rows, axis=0),
            band=None if self.band is None else xp.take(self.band, stamps, axis=0),
        )

    def off_stamp(self, centroid: Array) -> Array:
        """Return where centroids, pixels from the centre, are not on the stamp; (n_stamp,)."""
        xp = array_namespace(centroid=centroid)
        ny, nx = self.stamp_shape
        return (xp.abs(centroid[:, 0]) > 0.5 * nx) | (xp.abs(centroid[:, 1]) > 0.5 * ny)

    def on_sky(self, shapes: ShapeResult, noise: SolutionNoise) -> ObjectShapes:
        """Return shapes with lengths on the sky, centroids on a stamp, and band fluxes.

        Parameters
        ----------
        shapes : ShapeResult
            With lengths in the objects' units, centroids from their origins.
        noise : SolutionNoise
            Of the stamps.
        """
        xp = array_namespace(unit=self.unit)
        flux, snr = self._band_fluxes(shapes, noise)
        total = shapes.snr
        if snr is not None:
            there = xp.isfinite(snr)
            squares = xp.where(there, snr, xp.zeros_like(snr)) ** 2
            total = xp.where(xp.any(there, axis=-1), xp.sqrt(xp.sum(squares, axis=-1)), total)
        none = xp.zeros_like(shapes.flags)
        moved = {
            "centroid": self._on_first_stamp(shapes.centroid),
            "sky_offset": shapes.centroid * self.unit[:, None],
            "size": shapes.size * self.unit,
            "snr": total,
        }
        return ObjectShapes(
            **(shapes.columns() | moved),
            n_exposures=none,
            n_used=none,
            band_flux=flux,
            band_snr=snr,
        )

    def _on_first_stamp(self, offset: Array) -> Array:
        """Return (x, y) of centroids on the first stamp of each object that counts."""
        xp = array_namespace(offset=offset)
        exposures = self.look.exposures
        ny, nx = self.stamp_shape
        like = {"dtype": offset.dtype, "device": device_of(offset)}
        middle = xp.asarray([0.5 * (nx - 1), 0.5 * (ny - 1)], **like)
        counts = by_object(xp.astype(exposures.factor != 0, xp.int32), exposures.n_each)
        first = (counts > 0) & (xp.cumulative_sum(counts, axis=1) == 1)
        places = by_object(exposures.centroids(offset), exposures.n_each)
        place = xp.sum(xp.where(first[:, :, None], places, xp.zeros_like(places)), axis=1)
        # Where there is no shape, there is no centroid either.
        return xp.where(xp.isfinite(offset), place + middle, offset)

    def _band_fluxes(
        self, shapes: ShapeResult, noise: SolutionNoise
    ) -> tuple[Array | None, Array | None]:
        """Return flux and S/N in each band, shape (n_obj, n_band); NaN where not measured."""
        if self.band is None:
            return None, None
        xp = array_namespace(band=self.band)
        measured = shapes.measured
        fluxes, errors = [], []
        for band in range(self.n_bands):
            here = self.band == band
            share = xp.where(here, self.look.flux_share, xp.zeros_like(self.look.flux_share))
            flux, variance = _mean_flux(self.look.exposures, noise, share)
            known = measured & (variance > 0)
            error = xp.sqrt(xp.where(known, variance, xp.ones_like(variance)))
            nan = xp.full_like(flux, float("nan"))
            fluxes.append(xp.where(measured, flux, nan))
            errors.append(xp.where(known, error, nan))
        flux = xp.stack(fluxes, axis=-1)
        return flux, flux / xp.stack(errors, axis=-1)


def stamp_tests(job: Job, grid: KGrid, sources: StampSources, inverse_transfer: Array) -> NullTests:
    """Return the null tests of stamps."""
    xp = array_namespace(inverse_transfer=inverse_transfer)
    galaxies = sources.deconvolved(inverse_transfer, grid)
    n_stamp = int(galaxies.re.shape[0])
    fixed = None if job.size is None else xp.broadcast_to(job.size**2, (n_stamp,))
    return NullTests(
        grid=grid, galaxies=galaxies, weight=job.weight, length=job.length, fixed_width=fixed
    )


def solve_objects(
    objects: SeenObjects, tests: ExposureTests, inverse_transfer: Array, flags: Array
) -> ObjectShapes:
    """Solve objects on the coarse grid, then the few that need it on the fine one."""
    xp = array_namespace(flags=flags)
    max_iter = min(objects.job.max_iter, COARSE_STEPS)
    result, root = _solved_on(
        objects, tests, inverse_transfer, flags, max_iter=max_iter, near=TWO_STEPS_OFF
    )
    eta, _ = tests.on_stamps(root.x)
    narrow = squeezed(eta, objects.job.weight.frame) > FINE_ABOVE
    narrow = tests.exposures.total(xp.astype(narrow, eta.dtype)) > 0
    finer = (narrow | ~root.success) & (flags != int(Flag.NO_EXPOSURE))
    # A host read: how many need the fine grid decides the size of that batch.
    n_fine = count_true(finer)
    if n_fine == 0:
        return result
    order = xp.argsort(xp.astype(~finer, xp.int32), stable=True)
    parts = []
    per_chunk = max(1, int(flags.shape[0]) // FINER**2)
    for start in range(0, n_fine, per_chunk):
        rows = order[start : min(start + per_chunk, n_fine)]
        some = objects.take(rows)
        inverse_transfer = some.job.psf.inverse_transfer(some.job.fine)
        fine = stamp_tests(some.job, some.job.fine, some.sources, inverse_transfer)
        again, _ = _solved_on(
            some,
            ExposureTests(stamps=fine, exposures=some.look.exposures),
            inverse_transfer,
            xp.take(flags, rows, axis=0) + int(Flag.FINE_GRID),
            max_iter=some.job.max_iter,
            start=xp.take(root.x, rows, axis=0),
        )
        parts.append(again)
    merged = ObjectShapes.concat([*parts, result.take(order[n_fine:])])
    return merged.take(xp.argsort(order))


def _solved_on(
    objects: SeenObjects,
    tests: ExposureTests,
    inverse_transfer: Array,
    flags: Array,
    *,
    max_iter: int,
    near: float | None = None,
    start: Array | None = None,
) -> tuple[ObjectShapes, RootResult]:
    """Solve objects on one grid, but for two Newton steps, the second from tests with noise."""
    xp = array_namespace(flags=flags)
    job, exposures = objects.job, tests.exposures
    start = round_start(objects.look.offset, job.length) if start is None else start
    near = one_step_off(start) if near is None else near
    root = stepped(search(tests, start, max_iter=max_iter, near=near))
    eta, centroid = tests.on_stamps(root.x)
    stamps, widths = tests.stamps, None
    if exposures.n_each > 1 and tests.fixed_width is None:
        widths = stamps.widths(eta, centroid)
        stamps = tests.of_one_size(widths)
    noise = objects.sources.noise(
        stamps, eta, centroid, inverse_transfer, n_at_once=objects.n_at_once
    )
    summed, matched = tests.summed(noise.tests, noise.matched if widths is None else widths)
    root = looked_at(root, *tests.scaled(root.x[:, :2], summed, matched))
    flux, variance = _mean_flux(exposures, noise, objects.look.flux_share)
    combined = SolutionNoise(
        tests=summed,
        matched=matched,
        flux=flux,
        covariance=exposures.add_covariances(noise.covariance),
        flux_variance=variance,
    )
    off_stamp = exposures.total(xp.astype(objects.off_stamp(centroid), centroid.dtype)) > 0
    shapes = describe_at_origin(tests, root, combined, off_stamp=off_stamp, flags=flags)
    return objects.on_sky(shapes, noise), root


def _mean_flux(exposures: Exposures, noise: SolutionNoise, share: Array) -> tuple[Array, Array]:
    """Return fluxes of objects, those of their stamps weighted by `share`, and variances."""
    xp = array_namespace(share=share)
    total = exposures.total(share)
    there = total > 0
    safe = xp.where(there, total, xp.ones_like(total))
    nan = xp.full_like(total, float("nan"))
    flux = xp.where(there, exposures.total(share * noise.flux) / safe, nan)
    variance = exposures.total(share**2 * noise.flux_variance) / safe**2
    return flux, xp.where(there, variance, nan)
