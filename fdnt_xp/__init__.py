"""Weak-lensing galaxy shapes by Fourier-domain null tests (Bernstein 2010).

One code for NumPy, torch, JAX and CuPy: the arrays that are given decide where it runs.
"""

__version__ = "0.1.0"

__all__ = ["__version__"]
