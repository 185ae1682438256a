"""Weak-lensing galaxy shapes by Fourier-domain null tests (Bernstein 2010).

One code for NumPy, torch, JAX and CuPy: the arrays that are given decide where it runs.
"""

from fdnt_xp.fourier.psf import Psf as Psf
from fdnt_xp.shapes.measure import measure_shapes as measure_shapes
from fdnt_xp.shapes.results import ShapeResult as ShapeResult

__version__ = "0.1.0"

__all__ = ["Psf", "ShapeResult", "__version__", "measure_shapes"]
