"""Ring tests: what shear comes back from one galaxy, turned through all angles and sheared.

A ring of angles has no mean shape of its own. So what a shear estimator returns for it is
the estimator's own bias: no shape noise, and without pixel noise nothing but bias.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

import fdnt_xp.peers  # noqa: F401  gives its methods their names
from fdnt_xp.arrays import Array, array_namespace, device_of, to_numpy
from fdnt_xp.data.profiles import is_inversion_symmetric, load_galsim
from fdnt_xp.errors import FdntValueError, FdntWarning, RangeError
from fdnt_xp.fourier.psf import Psf
from fdnt_xp.shapes.methods import shape_method
from fdnt_xp.shapes.results import ShapeResult
from fdnt_xp.shears.estimate import ShearEstimate
from fdnt_xp.shears.from_shapes import shear_from_shapes
from fdnt_xp.shears.population import population_null

ESTIMATORS: Final[dict[str, str]] = {
    "raw": "responsivity R1 of ellipses, linear",
    "eg": "R1 with the ellipticity gradient, linear",
    "eg+cubic": "the same, third order in the shear inverted",
    "null-frozen": "population null, quadrupole under a fixed weight",
    "null-eta": "population null, every shape solved anew",
}
"""What `ring_test` compares. The nulls take the stamps, and no notice of the shape method."""
_LEAST_ANGLES: Final = 8
_LARGEST_G: Final = 0.25
"""The null must be able to look beyond the shear it is to find, and ends at 0.3."""


@dataclass(frozen=True, kw_only=True)
class Bias:
    """What one estimator makes of a ring.

    Parameters
    ----------
    m : float
        Multiplicative bias along the applied direction: `(g^(+) - g^(-))/(g(+) - g(-)) - 1`.
    m_err : float or None
        Half the difference between the two interleaved half-rings.
    c : tuple of float
        Additive bias (c1, c2): the estimate where no shear is applied.
    c_err : tuple of float, or None
        As `m_err`.
    m_cross : float
        Shear that comes back at 45 degrees to the applied one, in parts of it. It vanishes
        for galaxies with a mirror symmetry, and on average over a galaxy and its mirror image.
    """

    m: float
    m_err: float | None
    c: tuple[float, float]
    c_err: tuple[float, float] | None
    m_cross: float


@dataclass(frozen=True, kw_only=True)
class RingResult:
    """The outcome of a ring test.

    Parameters
    ----------
    delta_eta : tuple of float
        Applied shear (eta1, eta2), conformal; the ring had plus and minus this, and none.
    method : str
        Shape method.
    n_gal : int
        Galaxies of one ring.
    full_turn : bool
        Whether the angles go over 2 pi; over pi otherwise.
    stamp_size, padding : int
        Pixels of a stamp, and how much finer than theirs the k grid was.
    pixel : bool
        Whether the pixel was drawn in addition to the PSF.
    e : float
        Mean of `|e|` over the ring without shear: the shape as seen through this PSF.
    eg : float
        Mean ellipticity gradient of the same.
    n_failed : int
        Galaxies of the three rings without a shape. Any at all spoil the biases that are
        made of shapes.
    biases : dict of Bias
        By name of the estimator.
    """

    delta_eta: tuple[float, float]
    method: str
    n_gal: int
    full_turn: bool
    stamp_size: int
    padding: int
    pixel: bool
    e: float
    eg: float
    n_failed: int
    biases: dict[str, Bias]

    @property
    def g(self) -> float:
        """Modulus of the applied reduced shear, `tanh(|delta_eta|/2)`."""
        return math.tanh(0.5 * math.hypot(*self.delta_eta))

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain Python, ready for `json.dumps`."""
        plain = asdict(self)
        plain["delta_eta"] = list(self.delta_eta)
        for bias in plain["biases"].values():
            for name in ("c", "c_err"):
                bias[name] = None if bias[name] is None else list(bias[name])
        return plain

    @classmethod
    def from_dict(cls, plain: dict[str, Any]) -> RingResult:
        """Return the result that `to_dict` wrote."""

        def pair(values: Sequence[float] | None) -> tuple[float, float] | None:
            return None if values is None else (values[0], values[1])

        biases = {
            name: Bias(**{**bias, "c": pair(bias["c"]), "c_err": pair(bias["c_err"])})
            for name, bias in plain["biases"].items()
        }
        return cls(**{**plain, "delta_eta": pair(plain["delta_eta"]), "biases": biases})


def ring_test(
    galaxy: Any,
    psf: Any,
    delta_eta: float | tuple[float, float] = 0.02,
    *,
    method: str = "fdnt-ft",
    estimators: Sequence[str] = tuple(ESTIMATORS),
    n_angles: int = 16,
    stamp_size: int = 128,
    pixel: bool = False,
    errors: bool = True,
    max_shear: float = 0.1,
    padding: int = 1,
    chunk_size: int | None = None,
    to_array: Callable[[NDArray[np.float64]], Array] = np.asarray,
) -> RingResult:
    """Draw one galaxy at many angles, shear it, and see what shear comes back.

    Each galaxy is rotated, then sheared by `+delta_eta`, 0 and `-delta_eta`, convolved with
    the PSF and drawn by GalSim, without noise; all are measured in one batch.

    Parameters
    ----------
    galaxy, psf : galsim.GSObject
        Lengths in pixels; see `fdnt_xp.data.profiles`. The accuracy of the drawing is that
        of their `gsparams`.
    delta_eta : float or tuple of float
        Applied shear in conformal units, (eta1, eta2); a number is along x. The reduced
        shear is half as much: `g = tanh(|delta_eta|/2)`.
    method : str
        Name of a shape method, `fdnt_xp.shapes.methods`.
    estimators : sequence of str
        Which of `ESTIMATORS` to compare.
    n_angles : int
        Angles over half a turn, even. A galaxy that does not look the same upside down gets
        as many again over the other half.
    stamp_size : int
        Pixels on a side.
    pixel : bool
        Whether to convolve with the pixel; by default the PSF contains it.
    errors : bool
        Whether to estimate errors from half-rings, which doubles the time of the nulls.
    max_shear : float
        Of `population_null`; enlarged where the applied shear wants it.
    padding : int
        Makes the k grid finer by this factor, for shapes and nulls. The sums over cells of
        the usual grid leave 2e-6 in m at `delta_eta = 0.02`; 2 takes that to 1e-7.
    chunk_size : int, optional
        Galaxies in work together.
    to_array : callable
        Takes a NumPy array to the library, device and precision that shall compute.

    Returns
    -------
    RingResult

    Warns
    -----
    FdntWarning
        If a galaxy has no shape.

    Raises
    ------
    FdntValueError, RangeError
        If a name is unknown, or a number out of range; as `shear_from_shapes` and
        `population_null`.
    MissingExtraError
        If GalSim is not installed.

    Notes
    -----
    There is no noise, so the errors say how isotropic the ring is, and nothing about a
    sample: a half-ring of half as many angles aliases harmonics that the whole one does
    not, so they are upper limits for the ring, and do not contain what the stamps cut off.

    References
    ----------
    .. [1] Bernstein 2010, MNRAS 406, 2793, §5.3.
    .. [2] Nakajima & Bernstein 2007, AJ 133, 1763.
    """
    applied = _applied_shear(delta_eta)
    _check(estimators, n_angles, stamp_size)
    measure = shape_method(method)
    full_turn = not is_inversion_symmetric(galaxy)
    angles = ring_angles(n_angles, full_turn=full_turn)
    drawn = [
        draw_ring(galaxy, psf, angles, eta, stamp_size=stamp_size, pixel=pixel)
        for eta in (applied, (0.0, 0.0), (-applied[0], -applied[1]))
    ]
    stamps = to_array(np.concatenate(drawn))
    star = Psf.from_image(to_array(draw(psf, stamp_size, pixel=pixel)))
    shapes = measure(stamps, star, padding=padding, chunk_size=chunk_size)
    rings = _Rings(
        stamps=stamps,
        psf=star,
        shapes=shapes,
        n_gal=len(angles),
        max_shear=max(max_shear, 1.2 * math.tanh(0.5 * math.hypot(*applied))),
        padding=padding,
        chunk_size=chunk_size,
    )
    n_failed = _count_failed(shapes)
    unsheared = rings.shapes_of(1).to_numpy()
    return RingResult(
        delta_eta=applied,
        method=method,
        n_gal=len(angles),
        full_turn=full_turn,
        stamp_size=stamp_size,
        padding=padding,
        pixel=pixel,
        e=float(np.mean(np.hypot(*unsheared.e.T))),
        eg=float(np.mean(unsheared.eg)),
        n_failed=n_failed,
        biases={name: _bias(rings, name, applied, errors=errors) for name in estimators},
    )


def ring_angles(n_angles: int, *, full_turn: bool) -> NDArray[np.float64]:
    """Return the angles of a ring, radians: `n_angles` over pi, or twice that over 2 pi."""
    n = 2 * n_angles if full_turn else n_angles
    return np.arange(n, dtype=np.float64) * float(np.pi / n_angles)


def draw_ring(
    galaxy: Any,
    psf: Any,
    angles: NDArray[np.float64],
    eta: tuple[float, float],
    *,
    stamp_size: int,
    pixel: bool,
) -> NDArray[np.float64]:
    """Draw a galaxy at each angle, then sheared, then convolved; (n_angles, ny, nx)."""
    galsim = load_galsim()
    shear = galsim.Shear(eta1=eta[0], eta2=eta[1])
    stamps = []
    for angle in angles:
        turned = galaxy.rotate(float(angle) * galsim.radians).shear(shear)
        seen = galsim.Convolve([turned, psf], gsparams=galaxy.gsparams)
        stamps.append(draw(seen, stamp_size, pixel=pixel))
    return np.stack(stamps)


def draw(profile: Any, stamp_size: int, *, pixel: bool) -> NDArray[np.float64]:
    """Draw a profile on a square stamp of unit pixels, its origin in the middle."""
    method = "auto" if pixel else "no_pixel"
    image = profile.drawImage(
        nx=stamp_size, ny=stamp_size, scale=1.0, method=method, dtype=np.float64
    )
    return np.asarray(image.array)


@dataclass(frozen=True, kw_only=True)
class _Rings:
    """Three rings one after the other: sheared by plus, nothing, minus."""

    stamps: Array
    psf: Psf
    shapes: ShapeResult
    n_gal: int
    max_shear: float
    padding: int
    chunk_size: int | None

    def rows(self, ring: int, start: int = 0, step: int = 1) -> slice:
        """Return which rows are every `step`th angle of a ring."""
        return slice(ring * self.n_gal + start, (ring + 1) * self.n_gal, step)

    def shapes_of(self, ring: int, start: int = 0, step: int = 1) -> ShapeResult:
        """Return the shapes of a ring."""
        xp = array_namespace(stamps=self.stamps)
        numbers = xp.arange(3 * self.n_gal, dtype=xp.int64, device=device_of(self.stamps))
        return self.shapes.take(numbers[self.rows(ring, start, step)])

    def estimate(self, name: str, ring: int, start: int, step: int) -> NDArray[np.float64]:
        """Return the shear of a ring by one estimator, (2,)."""
        if name.startswith("null-"):
            found: ShearEstimate = population_null(
                self.stamps[self.rows(ring, start, step), :, :],
                self.psf,
                statistic="eta" if name == "null-eta" else "frozen",
                max_shear=self.max_shear,
                padding=self.padding,
                chunk_size=self.chunk_size,
            )
        else:
            # The orientations of a ring are even by its making; the estimators are B10's.
            found = shear_from_shapes(
                self.shapes_of(ring, start, step),
                use_eg=name != "raw",
                cubic=name == "eg+cubic",
                orientations=False,
            )
        return np.array([float(found.g[0]), float(found.g[1])])


def _bias(rings: _Rings, name: str, applied: tuple[float, float], *, errors: bool) -> Bias:
    whole = _m_and_c(rings, name, applied, 0, 1)
    m_err, c_err = None, None
    if errors:
        halves = [_m_and_c(rings, name, applied, start, 2) for start in (0, 1)]
        error = 0.5 * np.abs(halves[0] - halves[1])
        m_err, c_err = float(error[0]), (float(error[2]), float(error[3]))
    return Bias(
        m=float(whole[0]),
        m_err=m_err,
        c=(float(whole[2]), float(whole[3])),
        c_err=c_err,
        m_cross=float(whole[1]),
    )


def _m_and_c(
    rings: _Rings, name: str, applied: tuple[float, float], start: int, step: int
) -> NDArray[np.float64]:
    """Return m, m_cross, c1, c2 of every `step`th angle."""
    plus, none, minus = (rings.estimate(name, ring, start, step) for ring in (0, 1, 2))
    modulus = math.hypot(*applied)
    along = np.array(applied) / modulus
    across = np.array([-along[1], along[0]])  # spin 2: 90 degrees here are 45 on the sky
    response = (plus - minus) / (2.0 * math.tanh(0.5 * modulus))
    return np.array([response @ along - 1.0, response @ across, *none])


def _count_failed(shapes: ShapeResult) -> int:
    n_failed = int(np.sum(~np.asarray(to_numpy(shapes.measured))))
    if n_failed:
        warnings.warn(
            f"{n_failed} of {shapes.n_gal} galaxies of the rings have no shape: what is left is "
            "not isotropic, and the biases made of shapes mean little",
            FdntWarning,
            stacklevel=3,
        )
    return n_failed


def _applied_shear(delta_eta: float | tuple[float, float]) -> tuple[float, float]:
    """Return the two components of a shear that is not zero and not too large."""
    pair = (delta_eta, 0.0) if isinstance(delta_eta, int | float) else tuple(delta_eta)
    if len(pair) != 2:
        raise FdntValueError(f"delta_eta must be a number or (eta1, eta2), not {delta_eta!r}")
    modulus = math.hypot(*pair)
    if not 0.0 < modulus <= 2.0 * math.atanh(_LARGEST_G):  # NaN neither
        raise RangeError("|delta_eta|", modulus, 0.0, 2.0 * math.atanh(_LARGEST_G))
    return float(pair[0]), float(pair[1])


def _check(estimators: Sequence[str], n_angles: int, stamp_size: int) -> None:
    unknown = [name for name in estimators if name not in ESTIMATORS]
    if unknown or not estimators:
        raise FdntValueError(
            f"no estimator {', '.join(unknown) or 'given'}; known are {', '.join(ESTIMATORS)}"
        )
    if n_angles < _LEAST_ANGLES:
        raise RangeError("n_angles", n_angles, _LEAST_ANGLES, None)
    if n_angles % 2:
        raise FdntValueError(f"n_angles must be even, for the half-rings, not {n_angles}")
    if stamp_size < 16:
        raise RangeError("stamp_size", stamp_size, 16, None)
