"""Weak-lensing galaxy shapes by Fourier-domain null tests (Bernstein 2010).

One code for NumPy, torch, JAX and CuPy: the arrays that are given decide where it runs.
"""

from fdnt_xp.data.noise_power import measure_noise_power as measure_noise_power
from fdnt_xp.data.ring import RingResult as RingResult
from fdnt_xp.data.ring import ring_test as ring_test
from fdnt_xp.fourier.psf import Psf as Psf
from fdnt_xp.shapes.exposure_results import ExposureResult as ExposureResult
from fdnt_xp.shapes.exposures import measure_exposures as measure_exposures
from fdnt_xp.shapes.measure import measure_shapes as measure_shapes
from fdnt_xp.shapes.results import ShapeResult as ShapeResult
from fdnt_xp.shears.cuts import Cut as Cut
from fdnt_xp.shears.estimate import ShearEstimate as ShearEstimate
from fdnt_xp.shears.from_responses import shear_from_responses as shear_from_responses
from fdnt_xp.shears.from_shapes import shear_from_shapes as shear_from_shapes
from fdnt_xp.shears.population import population_null as population_null
from fdnt_xp.shears.responses import ResponseResult as ResponseResult
from fdnt_xp.shears.responses import measure_responses as measure_responses
from fdnt_xp.shears.stacking import shear_from_stack as shear_from_stack

__version__ = "0.1.0"

__all__ = [
    "Cut",
    "ExposureResult",
    "Psf",
    "ResponseResult",
    "RingResult",
    "ShapeResult",
    "ShearEstimate",
    "__version__",
    "measure_exposures",
    "measure_noise_power",
    "measure_responses",
    "measure_shapes",
    "population_null",
    "ring_test",
    "shear_from_responses",
    "shear_from_shapes",
    "shear_from_stack",
]
