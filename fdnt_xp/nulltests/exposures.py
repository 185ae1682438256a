"""The null tests of objects with many exposures: sums of the tests of their stamps.

The exposures of an object share the shape eta and the centroid u on the sky, counted from a
point that lies at `origin` on each stamp. There the centroid is `x = origin + J⁻¹ u`, and as
`k = Jᵀ k_sky` the dipole along the sky is `J⁻ᵀ (tx, ty)`. With fixed coefficients a_e::

    t = sum_e a_e (t1, t2, |det J| J⁻ᵀ (tx, ty), t0)_e
    f = (t1, t2, tx/L, ty/L)/t0.

The numerators are linear in the images: at a given size of the weights their mean vanishes at
the truth, whatever the noise of each exposure. Quotients of single exposures would not have
that, and are lost where one t0 is all noise (docs, "Many exposures").

The objects of a batch have equally many stamps each, in their order: a sum over exposures is
one along an axis, and nothing is padded.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from fdnt_xp.arrays import Array, array_namespace, device_of
from fdnt_xp.nulltests.scaled import scaled_tests
from fdnt_xp.nulltests.tests import NullTests
from fdnt_xp.nulltests.values import MatchedWidth, TestValues


@dataclass(frozen=True, kw_only=True)
class Exposures:
    """How the stamps of objects lie on the sky, and what each of them counts.

    Lengths on the sky are in a unit of each object's own: about a pixel.

    Parameters
    ----------
    n_each : int
        Stamps of each object.
    origin : array, shape (n_stamp, 2)
        Where the origin of the sky is, pixels from the centre of the stamp.
    to_stamp : array, shape (n_stamp, 2, 2)
        `J⁻¹`: from the sky to pixels.
    factor : array, shape (n_stamp,)
        a_e; 0 for a stamp that does not count, whatever its tests are.
    share : array, shape (n_stamp,)
        What it counts among those of its object; their sum is 1, or 0 if none counts.
    """

    n_each: int
    origin: Array
    to_stamp: Array
    factor: Array
    share: Array

    @property
    def area(self) -> Array:
        """`|det J|`, shape (n_stamp,)."""
        m = self.to_stamp
        xp = array_namespace(m=m)
        return 1.0 / xp.abs(m[:, 0, 0] * m[:, 1, 1] - m[:, 0, 1] * m[:, 1, 0])

    def take(self, rows: Array) -> Exposures:
        """Return the exposures of the given objects (integer array)."""
        xp = array_namespace(rows=rows)
        stamps = self.stamps_of(rows)
        moved = ("origin", "to_stamp", "factor", "share")
        return replace(self, **{g: xp.take(getattr(self, g), stamps, axis=0) for g in moved})

    def stamps_of(self, rows: Array) -> Array:
        """Return the numbers of the stamps of the given objects, in that order."""
        return stamps_of_objects(rows, self.n_each)

    def spread(self, values: Array) -> Array:
        """Return numbers of objects, (n_obj, d), for each of their stamps, (n_stamp, d)."""
        return spread_over_stamps(values, self.n_each)

    def centroids(self, offset: Array) -> Array:
        """Return centroids on the stamps, pixels from their centres, shape (n_stamp, 2).

        Parameters
        ----------
        offset : array, shape (n_obj, 2)
            On the sky.
        """
        xp = array_namespace(offset=offset)
        return self.origin + xp.sum(self.to_stamp * self.spread(offset)[:, None, :], axis=-1)

    def add(self, tests: Array, first: int, *, power: int = 1) -> Array:
        """Return sums of tests with their dipoles turned to the sky, shape (n_obj, m, d).

        Parameters
        ----------
        tests : array, shape (n_stamp, m, d)
        first : int
            Which of the m is tx; ty follows it.
        power : int
            Of a_e: 1 for tests, 2 for their covariances.
        """
        return self.total(self.turned(tests, first) * (self.factor**power)[:, None, None])

    def add_slopes(self, slopes: Array, first: int) -> Array:
        """Return the same for slopes, of which the last two are by the centroid."""
        return self.add(self.by_sky(slopes), first)

    def by_sky(self, slopes: Array) -> Array:
        """Return slopes, (n_stamp, m, d), with the last two by the centroid on the sky."""
        xp = array_namespace(slopes=slopes)
        by_sky = xp.sum(slopes[:, :, -2:, None] * self.to_stamp[:, None, :, :], axis=2)
        return xp.concat([slopes[:, :, :-2], by_sky], axis=-1)

    def mean_width(self, width: Array) -> Array:
        """Return the mean of widths of weights, pixel², on the sky; (n_obj, d)."""
        return self.total(width * (self.share * self.area)[:, None])

    def add_covariances(self, covariances: Array) -> Array:
        """Return the covariances, (n_obj, 4, 4), of the sums from those of (t1, t2, tx, ty)."""
        xp = array_namespace(covariances=covariances)
        once = xp.matrix_transpose(self.turned(covariances, 2))
        return self.add(once, 2, power=2)

    def turned(self, tests: Array, first: int) -> Array:
        """Return tests, (n_stamp, m, d), with their dipoles along the sky."""
        xp = array_namespace(tests=tests)
        matrix = self.to_stamp * self.area[:, None, None]
        dipole = tests[:, first : first + 2, :]
        dipole = xp.sum(matrix[:, :, :, None] * dipole[:, :, None, :], axis=1)
        return xp.concat([tests[:, :first, :], dipole, tests[:, first + 2 :, :]], axis=1)

    def total(self, values: Array) -> Array:
        """Return sums over the stamps that count, (n_obj, ...) from (n_stamp, ...)."""
        xp = array_namespace(values=values)
        counts = xp.reshape(self.factor != 0, (-1,) + (1,) * (values.ndim - 1))
        values = xp.where(counts, values, xp.zeros_like(values))
        return xp.sum(by_object(values, self.n_each), axis=1)


@dataclass(frozen=True, kw_only=True)
class ExposureTests:
    """The null tests of a batch of objects: a `RootProblem` in `(eta1, eta2, u/L, v/L)`.

    Each stamp has the weight of its own PSF. Their Gaussian parts have one size on the sky,
    the mean of those that each exposure asks for, with weights `share`: the size of an
    exposure alone is as noisy as its tests, and goes with them.

    Parameters
    ----------
    stamps : NullTests
        In the order of the objects.
    exposures : Exposures
    """

    stamps: NullTests
    exposures: Exposures

    @property
    def length(self) -> float:
        """L."""
        return self.stamps.length

    @property
    def fixed_width(self) -> Array | None:
        """sigma² of each stamp where the caller gave it."""
        return self.stamps.fixed_width

    def take(self, rows: Array) -> ExposureTests:
        """Return the tests of the given objects (integer array)."""
        stamps = self.stamps.take(self.exposures.stamps_of(rows))
        return ExposureTests(stamps=stamps, exposures=self.exposures.take(rows))

    def evaluate(self, x: Array) -> tuple[Array, Array]:
        """Return the scaled sums, shape (n_obj, 4), and their Jacobian; see `NullTests`."""
        eta, centroid = self.on_stamps(x)
        if self.exposures.n_each == 1 or self.fixed_width is not None:
            tests, matched = self.stamps.at(eta, centroid)
        else:
            matched = self.stamps.widths(eta, centroid)
            tests, _ = self.of_one_size(matched).at(eta, centroid)
        return self.scaled(x[:, :2], *self.summed(tests, matched))

    def of_one_size(self, matched: MatchedWidth) -> NullTests:
        """Return the tests of the stamps with weights of the common size, held.

        Parameters
        ----------
        matched : MatchedWidth
            What each stamp asks for.
        """
        width = self.exposures.mean_width(matched.width[:, None])
        width = self.exposures.spread(width)[:, 0] / self.exposures.area
        return replace(self.stamps, fixed_width=width)

    def scaled(self, eta: Array, tests: TestValues, matched: MatchedWidth) -> tuple[Array, Array]:
        """Return what `evaluate` does, from the sums at `eta`."""
        return scaled_tests(eta, tests, matched, self.length)

    def on_stamps(self, x: Array) -> tuple[Array, Array]:
        """Return eta and the centroid, pixels from the centre, for each stamp."""
        offset = self.length * x[:, 2:]
        return self.exposures.spread(x[:, :2]), self.exposures.centroids(offset)

    def summed(self, tests: TestValues, matched: MatchedWidth) -> tuple[TestValues, MatchedWidth]:
        """Return the sums over exposures, and the common width.

        Parameters
        ----------
        tests, matched : TestValues, MatchedWidth
            Of the stamps: the tests at the common size, and the sizes they ask for.
        """
        add, mean = self.exposures.add, self.exposures.mean_width
        xp = array_namespace(values=tests.values)
        # The width of a stamp, in its pixels, is that on the sky over the area of a pixel.
        by_width = tests.by_width / self.exposures.area[:, None]
        by_parameter = self.exposures.by_sky(matched.by_parameter[:, None, :])[:, 0, :]
        held = xp.astype(matched.at_bound, tests.values.dtype) / self.exposures.area
        return TestValues(
            values=add(tests.values[:, :, None], 2)[:, :, 0],
            by_parameter=self.exposures.add_slopes(tests.by_parameter, 2),
            by_ln_shrink=add(tests.by_ln_shrink[:, :, None], 2)[:, :, 0],
            by_width=add(by_width[:, :, None], 2)[:, :, 0],
        ), MatchedWidth(
            width=mean(matched.width[:, None])[:, 0],
            by_parameter=mean(by_parameter),
            by_ln_shrink=mean(matched.by_ln_shrink[:, None])[:, 0],
            by_ln_square=mean(matched.by_ln_square[:, None])[:, 0],
            flux=self.exposures.total(matched.flux),
            square=self.exposures.total(matched.square),
            at_bound=mean(held[:, None])[:, 0] > 0.5,
        )


def stamps_of_objects(rows: Array, n_each: int) -> Array:
    """Return the numbers of the stamps of objects that have `n_each` each."""
    xp = array_namespace(rows=rows)
    within = xp.arange(n_each, dtype=xp.int64, device=device_of(rows))
    return xp.reshape(rows[:, None] * n_each + within, (-1,))


def spread_over_stamps(values: Array, n_each: int) -> Array:
    """Return numbers of objects, (n_obj, d), for each of their stamps, (n_obj n_each, d)."""
    xp = array_namespace(values=values)
    n_obj, d = (int(length) for length in values.shape)
    return xp.reshape(xp.broadcast_to(values[:, None, :], (n_obj, n_each, d)), (n_obj * n_each, d))


def by_object(values: Array, n_each: int) -> Array:
    """Return numbers of stamps, (n_stamp, ...), as (n_obj, n_each, ...)."""
    xp = array_namespace(values=values)
    n_obj = int(values.shape[0]) // n_each
    return xp.reshape(values, (n_obj, n_each, *(int(n) for n in values.shape[1:])))
