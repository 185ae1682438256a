"""The fit of one circular model to the pixels of each galaxy: chi² and all its derivatives.

Least squares in `(x0, y0, eta1, eta2, ln r)`; the amplitudes of the components are solved for at
every step (variable projection: Golub and Pereyra 1973), and what that does to the curvature
of chi² is taken into account.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from fdnt_xp.arrays import Array, array_namespace
from fdnt_xp.nulltests.small_systems import inverse
from fdnt_xp.peers.batch import Fitted, in_domain
from fdnt_xp.peers.drawing import Drawing
from fdnt_xp.peers.levenberg import find_minimum, inverse_of_normal
from fdnt_xp.peers.models import Form, Model
from fdnt_xp.peers.profiles import Profile
from fdnt_xp.shapes.gl_matching import starting_moments


@dataclass(frozen=True, kw_only=True)
class ImageFit:
    """The fit of a profile to stamps: a `LeastSquaresProblem`.

    Its unknowns are `(x0/L, y0/L, eta1, eta2, ln r)`.

    Parameters
    ----------
    drawing : Drawing
    profile : Profile
    pixels : array, shape (n_gal, ny nx)
        Times the roots of their weights, and divided by `norm`, so that the sum of their
        squares is 1.
    roots : array, shape (n_gal, ny nx), or None
        Of the weights, 0 where a pixel is missing; None if all weigh 1.
    norm : array, shape (n_gal,)
    centre : array, shape (n_gal, 2)
        First centroid by moments, pixels from the centre of the stamp.
    length : array, shape (n_gal,)
        L, the sigma of the observed image by moments, pixels.
    fixed_size : float or None
        r, if it is not free.
    """

    drawing: Drawing
    profile: Profile
    pixels: Array
    roots: Array | None
    norm: Array
    centre: Array
    length: Array
    fixed_size: float | None

    @classmethod
    def of(
        cls,
        drawing: Drawing,
        profile: Profile,
        stamps: Array,
        *,
        weights: Array | None = None,
        size: float | None,
    ) -> ImageFit:
        """Return the fit of stamps with finite pixels; weights are 1 at most, 0 where missing."""
        xp = array_namespace(stamps=stamps)
        pixels = xp.reshape(stamps, (int(stamps.shape[0]), -1))
        brightest = xp.max(xp.abs(pixels), axis=-1)
        unit = xp.where(brightest > 0, brightest, xp.ones_like(brightest))
        # In two steps: the square of a small number underflows.
        scaled = pixels / unit[:, None]
        there = xp.ones_like(stamps) if weights is None else weights
        centre, length = starting_moments(xp.reshape(scaled, stamps.shape), there)
        roots = None if weights is None else xp.reshape(xp.sqrt(weights), pixels.shape)
        scaled = scaled if roots is None else roots * scaled
        norm = xp.sqrt(xp.sum(scaled * scaled, axis=-1))
        norm = xp.where(norm > 0, norm, xp.ones_like(norm))
        return cls(
            drawing=drawing,
            profile=profile,
            pixels=scaled / norm[:, None],
            roots=roots,
            norm=norm * unit,
            centre=centre,
            length=length,
            fixed_size=size,
        )

    def take(self, rows: Array) -> ImageFit:
        """Return the fits of the given galaxies (integer array)."""
        xp = array_namespace(rows=rows)
        names = ("pixels", "norm", "centre", "length")
        columns = {name: xp.take(getattr(self, name), rows, axis=0) for name in names}
        roots = None if self.roots is None else xp.take(self.roots, rows, axis=0)
        return replace(self, drawing=self.drawing.take(rows), roots=roots, **columns)

    def start(self, ratio: float) -> Array:
        """Return where to start: round, the size a part of the observed one; (n_gal, 5)."""
        xp = array_namespace(pixels=self.pixels)
        size = ratio * self.length
        if self.fixed_size is not None:
            size = xp.full_like(size, self.fixed_size)
        scaled = self.centre / self.length[:, None]
        return xp.concat([scaled, xp.zeros_like(scaled), xp.log(size)[:, None]], axis=-1)

    def parameters(self, x: Array) -> tuple[Array, Array, Array]:
        """Return shape, centroid in pixels from the stamp's centre, and size."""
        xp = array_namespace(x=x)
        return x[:, 2:4], self.length[:, None] * x[:, :2], xp.exp(x[:, 4])

    def evaluate(self, x: Array) -> tuple[Array, Array, Array, Array]:
        """Return chi² and its derivatives; see `LeastSquaresProblem`."""
        xp = array_namespace(x=x)
        at = self.expanded(x)
        scale = xp.linalg.diagonal(at.normal)
        if self.fixed_size is None:
            return at.chi2, at.g, at.h, scale
        # Nothing pulls at the size, and it answers to nothing else.
        free = xp.concat([xp.ones_like(x[:, :4]), xp.zeros_like(x[:, :1])], axis=-1)
        return at.chi2, free * at.g, _pinned(at.h, free), free * scale + (1.0 - free)

    def expanded(self, x: Array) -> Expansion:
        """Return chi² and its derivatives, the amplitudes solved for."""
        xp = array_namespace(x=x)
        eta, centroid, size = self.parameters(x)
        sane = in_domain(eta, centroid, size, min(self.drawing.stamp_shape))
        form = Form.of(
            xp.where(sane[:, None], eta, xp.zeros_like(eta)),
            xp.where(sane, size, xp.ones_like(size)),
        )
        centroid = xp.where(sane[:, None], centroid, xp.zeros_like(centroid))
        model = Model.at(self.drawing, self.profile, centroid, form.values)
        images = self._weighted(model.draw_components())
        inverse, regular = inverse_of_normal(_products(images, images))
        amplitudes, residual = self._amplitudes(images, inverse)
        slopes = self._weighted(model.draw_slopes(amplitudes))
        pull = residual if self.roots is None else self.roots * residual
        first, second = model.overlaps(pull, amplitudes)

        shared = _products(slopes, images)
        h = _products(slopes, slopes) - second
        tied = shared - xp.matrix_transpose(first)
        h = h - _sandwich(tied, inverse)
        slopes = slopes - xp.matmul(xp.matmul(shared, inverse), images)
        normal = _products(slopes, slopes)
        noise = normal + _sandwich(xp.matrix_transpose(first), inverse)
        g = xp.sum(slopes * residual[:, None, :], axis=-1)

        chain, bent = self._chain(form, g)
        chi2 = xp.sum(residual * residual, axis=-1)
        return Expansion(
            chi2=xp.where(sane & regular, chi2, xp.full_like(chi2, float("nan"))),
            g=xp.sum(chain * g[:, None, :], axis=-1),
            h=_sandwich(chain, h) - bent,
            normal=_sandwich(chain, normal),
            noise=_sandwich(chain, noise),
            amplitudes=amplitudes,
            square=xp.sum((self.pixels - residual) ** 2, axis=-1),
        )

    def _weighted(self, images: Array) -> Array:
        """Return images, (n_gal, n, n_pix), as they count."""
        return images if self.roots is None else self.roots[:, None, :] * images

    def enough(self) -> Array:
        """Return where there are more pixels than parameters, shape (n_gal,), bool."""
        xp = array_namespace(pixels=self.pixels)
        there = xp.ones_like(self.pixels) if self.roots is None else self.roots
        n_pixels = xp.sum(xp.astype(there > 0, xp.int32), axis=-1, dtype=xp.int32)
        return n_pixels > 5 + self.profile.n_components

    def _amplitudes(self, images: Array, inverse: Array) -> tuple[Array, Array]:
        """Return the best amplitudes, (n_gal, n_component), and data minus model, weighted."""
        xp = array_namespace(images=images)
        residual = self.pixels
        total = xp.zeros_like(inverse[:, 0, :])
        for _ in range(2):  # the second takes the ridge of the inverse back
            right = xp.sum(images * residual[:, None, :], axis=-1)
            change = xp.sum(inverse * right[:, None, :], axis=-1)
            total = total + change
            residual = residual - xp.sum(change[:, :, None] * images, axis=1)
        return total, residual

    def _chain(self, form: Form, g: Array) -> tuple[Array, Array]:
        """Return the slopes of `(x0, y0, u, v, w)` by the unknowns, and `g` times the curvatures.

        Both of shape (n_gal, 5, 5), the first with a row for each unknown.
        """
        xp = array_namespace(g=g)
        length, zero = self.length, xp.zeros_like(self.length)
        rows = [xp.stack([length, zero, zero, zero, zero], axis=-1)]
        rows.append(xp.stack([zero, length, zero, zero, zero], axis=-1))
        empty = xp.stack([zero, zero], axis=-1)
        rows += [xp.concat([empty, form.slopes[:, :, j]], axis=-1) for j in range(3)]
        bent = xp.sum(g[:, 2:, None, None] * form.curvatures, axis=1)
        bent = xp.concat([xp.zeros_like(bent[:, :, :2]), bent], axis=-1)
        return xp.stack(rows, axis=1), xp.concat([xp.zeros_like(bent[:, :2, :]), bent], axis=1)


@dataclass(frozen=True, kw_only=True)
class Expansion:
    """chi² about one set of parameters of every galaxy.

    Parameters
    ----------
    chi2 : array, shape (n_gal,)
    g, h : array, shapes (n_gal, 5) and (n_gal, 5, 5)
        Minus half the gradient, and half the second derivative.
    normal, noise : array, shape (n_gal, 5, 5)
        `Jᵀ J` of the slopes with the amplitudes marginalised over, and the covariance of g for
        noise 1 of pixels of weight 1; one and the same where the model fits.
    amplitudes : array, shape (n_gal, n_component)
    square : array, shape (n_gal,)
        Sum of the squares of the model, weighted.
    """

    chi2: Array
    g: Array
    h: Array
    normal: Array
    noise: Array
    amplitudes: Array
    square: Array


def fit_images(problem: ImageFit, start: float, max_iter: int) -> Fitted:
    """Fit a profile to every galaxy of a problem, from round models.

    The covariance is `H⁻¹ Cov(g) H⁻¹`, that of the maximum itself, be the model right or not.
    """
    xp = array_namespace(pixels=problem.pixels)
    found = find_minimum(problem, problem.start(start), max_iter=max_iter)
    eta, centroid, size = problem.parameters(found.x)
    at = problem.expanded(found.x)
    h, noise = at.h, at.noise
    if problem.fixed_size is not None:
        free = xp.concat([xp.ones_like(at.g[:, :4]), xp.zeros_like(at.g[:, :1])], axis=-1)
        h, noise = _pinned(h, free), noise * free[:, :, None] * free[:, None, :]
    inverse, regular = _inverse(h)
    covariance = _sandwich(inverse, noise)
    total = xp.sum(at.amplitudes, axis=-1)
    # The flux of an image is known as well as the square of one of flux 1 says.
    seen = at.square > 0
    return Fitted(
        eta=eta,
        eta_cov=covariance[:, 2:4, 2:4] / (problem.norm**2)[:, None, None],
        centroid=centroid,
        size=size,
        flux=problem.norm * total,
        flux_variance=total**2 / xp.where(seen, at.square, xp.ones_like(total)),
        regular=regular & seen & problem.enough(),
        status=found.status,
        n_eval=found.n_eval,
    )


def _inverse(h: Array) -> tuple[Array, Array]:
    """Return the inverse of H, and where it has one and is a minimum's."""
    xp = array_namespace(h=h)
    result, regular = inverse(xp, h)
    return result, regular & xp.all(xp.linalg.diagonal(h) > 0, axis=-1)


def _products(a: Array, b: Array) -> Array:
    """Return the products of images, summed over pixels; (n_gal, n_a, n_b)."""
    xp = array_namespace(a=a, b=b)
    return xp.matmul(a, xp.matrix_transpose(b))


def _sandwich(a: Array, c: Array) -> Array:
    """Return `A C Aᵀ`."""
    xp = array_namespace(a=a, c=c)
    return xp.matmul(xp.matmul(a, c), xp.matrix_transpose(a))


def _pinned(h: Array, free: Array) -> Array:
    """Return H with 1 on the diagonal, and nothing else, of what is not free."""
    pinned = (1.0 - free)[:, :, None] * (1.0 - free)[:, None, :]
    return h * free[:, :, None] * free[:, None, :] + pinned
