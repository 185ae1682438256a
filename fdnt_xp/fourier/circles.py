"""A PSF on circles around k = 0: its power there, and the circular weight made from it.

`𝒯(k) = <|T|^-2>_θ^-1` (B10, eq. 21, with the exponent corrected; docs, "Weight of the
PSF") ends at `kmax`, where it falls below a floor or the grid ends, and it ends smoothly: a hard
edge costs 1e-4 in e. T is evaluated by direct trigonometric sums, exact at any k, on circles
that PSFs share, and interpolated from there.
"""

from __future__ import annotations

import math

import numpy as np

from fdnt_xp.arrays import Array, array_namespace, device_of, to_numpy, works_in_blocks
from fdnt_xp.fourier.interpolation import CubicTable, cubic_table
from fdnt_xp.fourier.jacobian import longest_stretch

_SCAN_RADII, _SCAN_ANGLES = 48, 12
"""Circles on which the end of 𝒯 is looked for, and points on half of each."""
_TABLE_NODES, _TABLE_ANGLES = 97, 24
"""Nodes of the table of 𝒯. The mean over the angle need not be exact: any isotropic weight
gives a valid null test. It must be smooth in k, which it is for any number of angles."""
CIRCLES, CIRCLE_POINTS = 25, _TABLE_ANGLES
"""Of the table of `|T|²` on circles, every fourth of those, and points on half of each."""
_PSFS_AT_ONCE, _PSFS_IN_CACHE = 64, 2
"""Bounds the memory of the trigonometric sums."""


def circle_tables(
    image: Array, oversampling: float, floor: float, unit: Array | None = None
) -> tuple[Array, CubicTable, Array]:
    """Return `kmax`, `𝒯` and `ln |T|²` on circles of stars of unit flux.

    Parameters
    ----------
    image : array, shape (n_psf, ny, nx)
    oversampling, floor : float
    unit : array, shape (n_psf, 2, 2), optional
        B, where the circles are those of the sky.
    """
    xp = array_namespace(image=image)
    n_psf = int(image.shape[0])
    parts = []
    for start in range(0, max(n_psf, 1), _PSFS_AT_ONCE):
        rows = slice(start, min(start + _PSFS_AT_ONCE, n_psf))
        some = None if unit is None else unit[rows, :, :]
        parts.append(_circularise(image[rows, :, :], oversampling, floor, some))
    kmax, power, ln_power = (xp.concat(part) for part in zip(*parts, strict=True))
    return kmax, cubic_table(power, zero_beyond=True), ln_power


def ended_at(kmax: Array, weight: CubicTable, floor: float) -> tuple[Array, CubicTable]:
    """Return `kmax` and the table of `𝒯` of weights that end at a higher floor."""
    xp = array_namespace(kmax=kmax)
    n_psf = int(kmax.shape[0])
    t = xp.linspace(0.0, 1.0, _TABLE_NODES, dtype=kmax.dtype, device=device_of(kmax))[None, :]
    row = xp.arange(n_psf, dtype=xp.int64, device=device_of(kmax))
    nodes = xp.broadcast_to(t, (n_psf, _TABLE_NODES))
    reached = _first_crossing(t, weight.evaluate(nodes, row)[0], floor)
    power = weight.evaluate(nodes * reached[:, None], row)[0]
    return kmax * reached, cubic_table(_ended_smoothly(power, t), zero_beyond=True)


def pixels_from_middle(n: int, like: Array) -> Array:
    """Return the coordinates of n pixels from the middle of their array."""
    xp = array_namespace(like=like)
    return xp.arange(n, dtype=like.dtype, device=device_of(like)) - 0.5 * (n - 1)


def _circularise(
    image: Array, oversampling: float, floor: float, unit: Array | None
) -> tuple[Array, Array, Array]:
    """Return `kmax`, shape (n_psf,), `𝒯` at the table's nodes, and `ln |T|²` on circles."""
    xp = array_namespace(image=image)
    like = {"dtype": image.dtype, "device": device_of(image)}
    scan = xp.linspace(0.0, np.pi, _SCAN_RADII, **like)[None, :]
    if unit is not None:
        # A circle of the sky is an ellipse on the grid, and must not reach out of that.
        scan = scan / longest_stretch(unit)[:, None]
    scanned = power_on_circles(image, scan, _SCAN_ANGLES, oversampling, unit)
    kmax = _first_crossing(scan, _mean(scanned), floor)
    t = xp.linspace(0.0, 1.0, _TABLE_NODES, **like)
    every = _on_own_circles(image, kmax, scan[:, -1], t, oversampling, unit)
    power, on_circles = _mean(every), every[:, :: (_TABLE_NODES - 1) // (CIRCLES - 1), :]
    # Where a PSF is dark there is no logarithm; the weight ends before.
    least = xp.full_like(on_circles, float(xp.finfo(image.dtype).smallest_normal))
    return kmax, _ended_smoothly(power, t[None, :]), xp.log(xp.maximum(on_circles, least))


def _on_own_circles(
    image: Array, kmax: Array, reach: Array, t: Array, oversampling: float, unit: Array | None
) -> Array:
    """Return `|T|²` on the circles `kmax t`, interpolated from circles that PSFs share.

    Most of the sums over a star are the waves, which on shared circles are made once. These end
    at the next of `reach 2^(-i/8)`: where, and so the result, depends on no other PSF.

    Parameters
    ----------
    reach : array, shape (n or 1,)
        Radius of the largest circle on the grid.
    """
    xp = array_namespace(image=image)
    steps = xp.floor(8.0 * xp.log2(reach / kmax))
    ends = reach * 2.0 ** (-0.125 * steps)
    # A host read: how many PSFs share circles decides the size of their batch.
    _, group = np.unique(to_numpy(steps), return_inverse=True)
    group = group if unit is None else np.zeros_like(group)
    parts, places = [], []
    for number in range(max(group, default=0) + 1):
        place = np.flatnonzero(group == number)
        rows = xp.asarray(place, dtype=xp.int64, device=device_of(image))
        some, end, own = (xp.take(column, rows, axis=0) for column in (image, ends, kmax))
        frame = None if unit is None else xp.take(unit, rows, axis=0)
        radii = end[:, None] * t
        radii = radii[:1, :] if unit is None and len(place) > 0 else radii
        re, im = _on_circles(some, radii, _TABLE_ANGLES, oversampling, frame)
        nodes = (own / end)[:, None] * t
        parts.append(_between(re, nodes) ** 2 + _between(im, nodes) ** 2)
        places.append(rows)
    return xp.take(xp.concat(parts), xp.argsort(xp.concat(places)), axis=0)


def _between(values: Array, nodes: Array) -> Array:
    """Return values on circles at other radii.

    Parameters
    ----------
    values : array, shape (n, n_node, n_angle)
        On circles of equidistant radii.
    nodes : array, shape (n, n_node)
        In units of the largest of them.
    """
    xp = array_namespace(values=values)
    n, n_node, n_angle = (int(length) for length in values.shape)
    rays = (n * n_angle, n_node)
    table = cubic_table(xp.reshape(xp.matrix_transpose(values), rays))
    wanted = xp.reshape(xp.broadcast_to(nodes[:, None, :], (n, n_angle, n_node)), rays)
    row = xp.arange(n * n_angle, dtype=xp.int64, device=device_of(values))
    found = table.evaluate(wanted, row)[0]
    return xp.matrix_transpose(xp.reshape(found, (n, n_angle, n_node)))


def _mean(power: Array) -> Array:
    """Return `<|T|^-2>_θ^-1`, shape (n_psf, n_radius), of `|T|²` on circles."""
    xp = array_namespace(power=power)
    dark = xp.any(power <= 0, axis=-1)
    inverse = xp.mean(1.0 / xp.where(power > 0, power, xp.ones_like(power)), axis=-1)
    return xp.where(dark, xp.zeros_like(inverse), 1.0 / inverse)


def power_on_circles(
    image: Array, radii: Array, n_angle: int, oversampling: float, unit: Array | None = None
) -> Array:
    """Return `|T|²` of images on circles, shape (n, n_radius, n_angle).

    `|T|` is the same at k and -k, so half a circle is enough; on equidistant points of it
    means over the angle converge exponentially.

    Parameters
    ----------
    image : array, shape (n or 1, ny, nx)
    radii : array, shape (n or 1, n_radius)
        rad/pixel of the galaxies.
    n_angle : int
        Angles `π (j + ½)/n_angle`.
    oversampling : float
        Pixels of `image` per pixel of the galaxies.
    unit : array, shape (n or 1, 2, 2), optional
        B, where the circles are those of the sky: `k = Bᵀ k_sky`.
    """
    re, im = _on_circles(image, radii, n_angle, oversampling, unit)
    return re**2 + im**2


def _on_circles(
    image: Array, radii: Array, n_angle: int, oversampling: float, unit: Array | None
) -> tuple[Array, Array]:
    """Return `Re T` and `Im T`; parameters and shapes are those of `power_on_circles`."""
    xp = array_namespace(image=image)
    ny, nx = (int(length) for length in image.shape[1:])
    # From the sums at (kx, ky) those at (-kx, ky) follow, which is half of all where the circles
    # are those of the pixels.
    mirrored = unit is None and n_angle % 2 == 0
    n_point = n_angle // 2 if mirrored else n_angle
    angle = np.pi * (np.arange(n_point) + 0.5) / n_angle
    like = {"dtype": image.dtype, "device": device_of(image)}
    cos, sin = (xp.asarray(f(angle), **like) for f in (np.cos, np.sin))
    n = int(image.shape[0])
    shared = int(radii.shape[0]) == 1 and unit is None
    at_once = _PSFS_IN_CACHE if works_in_blocks(image) else max(n, 1)
    waves, parts = None, []
    for start in range(0, max(n, 1), at_once):
        rows = slice(start, min(start + at_once, n))
        if waves is None or not shared:
            some = radii if shared else radii[rows, :]
            frame = None if unit is None else unit[rows, :, :]
            waves = _waves_on(some, cos, sin, (ny, nx), oversampling, frame)
        parts.append(_sums_of_waves(image[rows, :, :], *waves))
    sums = (xp.concat(part) for part in zip(*parts, strict=True))
    cc, ss, sc, cs = (xp.reshape(one, (n, int(radii.shape[1]), n_point)) for one in sums)
    if not mirrored:
        return cc - ss, sc + cs
    re = xp.concat([cc - ss, xp.flip(cc + ss, axis=-1)], axis=-1)
    im = xp.concat([sc + cs, xp.flip(cs - sc, axis=-1)], axis=-1)
    return re, im


def _sums_of_waves(
    image: Array, along_x: tuple[Array, Array], along_y: tuple[Array, Array]
) -> tuple[Array, Array, Array, Array]:
    """Return sums of images times cos cos, sin sin, sin cos and cos sin of `kx x` and `ky y`."""
    xp = array_namespace(image=image)
    # Even and odd in x and y: a wave meets a quarter of the pixels instead of all.
    (even, odd), (odd_y, odd_xy) = (
        _even_and_odd(part, axis=2) for part in _even_and_odd(image, axis=1)
    )
    (cos_x, sin_x), (cos_y, sin_y) = along_x, along_y
    return (
        xp.sum(xp.matmul(even, cos_x) * cos_y, axis=1),
        xp.sum(xp.matmul(odd_xy, sin_x) * sin_y, axis=1),
        xp.sum(xp.matmul(odd, sin_x) * cos_y, axis=1),
        xp.sum(xp.matmul(odd_y, cos_x) * sin_y, axis=1),
    )


def _waves_on(
    radii: Array,
    cos: Array,
    sin: Array,
    shape: tuple[int, int],
    oversampling: float,
    unit: Array | None,
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Return the waves along x and along y of the points of circles: see `_waves_at`."""
    xp = array_namespace(radii=radii)
    ny, nx = shape
    n_point = int(radii.shape[1]) * int(cos.shape[0])
    kx, ky = (xp.reshape(radii[:, :, None] * f, (-1, n_point)) for f in (cos, sin))
    if unit is not None:
        kx, ky = (unit[:, 0, j : j + 1] * kx + unit[:, 1, j : j + 1] * ky for j in (0, 1))
    return _waves_at(kx, nx, oversampling), _waves_at(ky, ny, oversampling)


def _even_and_odd(image: Array, axis: int) -> tuple[Array, Array]:
    """Return `I(x) + I(-x)` and `I(x) - I(-x)` of the pixels with x >= 0, the first at 0 or ½."""
    xp = array_namespace(image=image)
    n = int(image.shape[axis])
    half = [slice(None)] * image.ndim
    half[axis] = slice(n // 2, n)
    right, left = image[tuple(half)], xp.flip(image, axis=axis)[tuple(half)]
    even = right + left
    if n % 2 == 1:
        # The middle is its own mirror image, and counts once.
        x = xp.arange(n - n // 2, dtype=image.dtype, device=device_of(image))
        share = xp.where(x > 0, xp.ones_like(x), 0.5 * xp.ones_like(x))
        even = even * (share[None, :, None] if axis == 1 else share)
    return even, right - left


def _waves_at(k: Array, n: int, oversampling: float) -> tuple[Array, Array]:
    """Return `cos k x` and `sin k x` of the pixels of n with x >= 0, (n_psf, -(-n//2), n_point).

    A wave over all pixels is the product of one over blocks of them and one over the pixels of
    a block: about `2 sqrt(n)` cosines instead of n.
    """
    xp = array_namespace(k=k)
    first, n = 0.5 * (n % 2 == 0), n - n // 2
    n_block = math.isqrt(n)
    n_pixel = -(-n // n_block)
    like = {"dtype": k.dtype, "device": device_of(k)}
    blocks = (xp.arange(n_block, **like) * n_pixel + first) / oversampling
    block = k[:, None, :] * blocks[None, :, None]
    pixel = k[:, None, :] * (xp.arange(n_pixel, **like) / oversampling)[None, :, None]
    cos_b, sin_b = (f(block)[:, :, None, :] for f in (xp.cos, xp.sin))
    cos_p, sin_p = (f(pixel)[:, None, :, :] for f in (xp.cos, xp.sin))
    shape = (int(k.shape[0]), n_block * n_pixel, int(k.shape[1]))
    cos = xp.reshape(cos_b * cos_p - sin_b * sin_p, shape)
    sin = xp.reshape(sin_b * cos_p + cos_b * sin_p, shape)
    return cos[:, :n, :], sin[:, :n, :]


def _first_crossing(radii: Array, power: Array, floor: float) -> Array:
    """Return the first radius where `power` falls below `floor`, or the last; (n_psf,)."""
    xp = array_namespace(power=power)
    n_psf = int(power.shape[0])
    radii = xp.broadcast_to(radii, power.shape)
    # A radius counts as reached until the first crossing; ln P is nearly linear in a cell.
    above = xp.astype(power >= floor, xp.int64)
    reached = xp.sum(xp.cumulative_prod(above, axis=1), axis=1)
    last = int(power.shape[1]) - 1
    right = xp.minimum(reached, xp.full_like(reached, last))[:, None]
    left = right - 1
    tiny = xp.full_like(power, floor * 1e-6)
    excess = xp.log(xp.maximum(power, tiny) / floor)
    r0, r1 = (xp.take_along_axis(radii, i, axis=1) for i in (left, right))
    e0, e1 = (xp.take_along_axis(excess, i, axis=1) for i in (left, right))
    found = (reached <= last)[:, None]
    fraction = xp.where(found, e0 / xp.where(found, e0 - e1, xp.ones_like(e0)), xp.ones_like(e0))
    return xp.reshape(r0 + fraction * (r1 - r0), (n_psf,))


def _ended_smoothly(power: Array, t: Array) -> Array:
    """Return `P (1 - t⁸ P_end/P)²`, t = k/kmax: zero with its derivative at the end.

    For a PSF that falls to the floor this is a function of P, but for the last few per
    cent of the disc, and as smooth in k as P is: tapers in k, whose higher derivatives
    jump where they begin, cost up to 30 times more accuracy. For one that the grid cuts
    while it is still large, the power of t keeps the weight alive inside.
    """
    xp = array_namespace(power=power)
    end = power[:, -1:]
    positive = power > 0
    safe = xp.where(positive, power, xp.ones_like(power))
    excess = xp.where(positive, 1.0 - t**8 * end / safe, xp.zeros_like(power))
    return power * xp.maximum(excess, xp.zeros_like(power)) ** 2
