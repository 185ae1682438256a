"""From pixels to Fourier modes: the k grid, the transform, the PSF."""
