"""Where the command line computes: library, device and precision, chosen by name.

Nothing else in the package chooses: functions of the library follow the arrays they get.
This module may import the libraries, and may change their settings, because the command
line owns its process.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from fdnt_xp.arrays import Array
from fdnt_xp.errors import FdntValueError, MissingExtraError

DTYPES: Final = ("float64", "float32")


@dataclass(frozen=True, kw_only=True)
class Backend:
    """A library, a device and a precision, ready to take arrays.

    Parameters
    ----------
    library, version : str
        Of the array library.
    device : str
        As the library calls it.
    dtype : str
        "float64" or "float32".
    from_numpy : callable
        Copies a NumPy array there, in this precision.
    copy_beside : callable, optional
        The same from another thread, while the device computes.
    """

    library: str
    version: str
    device: str
    dtype: str
    from_numpy: Callable[[np.ndarray[Any, Any]], Array]
    copy_beside: Callable[[np.ndarray[Any, Any]], Array] | None = None

    @property
    def upload(self) -> Callable[[np.ndarray[Any, Any]], Array]:
        """What copies NumPy arrays there from a thread that runs ahead."""
        return self.copy_beside or self.from_numpy

    @property
    def on_cpu(self) -> bool:
        """Whether the arrays are in the memory of the host."""
        return self.device.lower().startswith(("cpu", "tfrt_cpu"))


def load_backend(
    library: str = "numpy", device: str | None = None, dtype: str = "float64"
) -> Backend:
    """Import a library and check that the device is there.

    Parameters
    ----------
    library : str
        "numpy", "torch", "jax" or "cupy".
    device : str, optional
        "cpu", "cuda", "cuda:1", ...; the library's default without it.
    dtype : str
        "float64" or "float32". For JAX, float64 switches `jax_enable_x64` on.

    Raises
    ------
    MissingExtraError
        If the library is not installed.
    FdntValueError
        If library, dtype or device are not known, or the device is not there.
    """
    if library not in BACKENDS:
        raise FdntValueError(f"no backend {library!r}; known are {', '.join(BACKENDS)}")
    if dtype not in DTYPES:
        raise FdntValueError(f"no dtype {dtype!r}; known are {', '.join(DTYPES)}")
    return BACKENDS[library](device, dtype)


def _numpy(device: str | None, dtype: str) -> Backend:
    if device not in (None, "cpu"):
        raise FdntValueError(f"numpy computes on the cpu only, not on {device!r}")
    return Backend(
        library="numpy",
        version=np.__version__,
        device="cpu",
        dtype=dtype,
        from_numpy=lambda host: np.array(host, dtype=dtype, order="C"),
    )


def _torch(device: str | None, dtype: str) -> Backend:
    try:
        import torch
    except ImportError as error:
        raise _missing("torch", "pip install 'fdnt-xp[torch]'") from error
    try:
        place = torch.device(device or "cpu")
        if place.type == "cuda" and not torch.cuda.is_available():
            raise FdntValueError("torch finds no CUDA device; choose --device cpu")
        torch.zeros(1, dtype=getattr(torch, dtype), device=place)
    except (RuntimeError, AssertionError, TypeError) as error:
        if isinstance(error, FdntValueError):
            raise
        raise _no_device("torch", device, dtype, error) from error
    return Backend(
        library="torch",
        version=str(torch.__version__),
        device=str(place),
        dtype=dtype,
        from_numpy=lambda host: torch.asarray(
            host.astype(dtype), dtype=getattr(torch, dtype), device=place
        ),
        copy_beside=_cuda_copies(place, dtype) if place.type == "cuda" else None,
    )


def _cuda_copies(place: Any, dtype: str) -> Callable[[np.ndarray[Any, Any]], Array]:
    """Return a copy to a CUDA device that does not queue behind the computations there."""
    import torch

    stream = torch.cuda.Stream(place)

    def copy(host: np.ndarray[Any, Any]) -> Array:
        # Only from pinned memory does a copy run beside the device's work.
        pinned = torch.from_numpy(np.array(host, dtype=dtype, order="C")).pin_memory()
        with torch.cuda.stream(stream):
            there = pinned.to(place, non_blocking=True)
        stream.synchronize()
        # Its memory is that stream's, and must not be used again before these are done with it.
        there.record_stream(torch.cuda.default_stream(place))
        return there

    return copy


def _jax(device: str | None, dtype: str) -> Backend:
    try:
        import jax
    except ImportError as error:
        raise _missing("jax", "pip install 'fdnt-xp[jax]'") from error
    if dtype == "float64":
        jax.config.update("jax_enable_x64", True)
    platform, _, number = (device or "").partition(":")
    try:
        place = jax.devices(platform or None)[int(number or 0)]
    except (RuntimeError, IndexError, ValueError) as error:
        raise _no_device("jax", device, dtype, error) from error
    return Backend(
        library="jax",
        version=jax.__version__,
        device=f"{place.platform}:{place.id}",
        dtype=dtype,
        from_numpy=lambda host: jax.device_put(host.astype(dtype), place),
    )


def _cupy(device: str | None, dtype: str) -> Backend:
    try:
        import cupy
    except ImportError as error:
        raise _missing("cupy", "install the wheel for your CUDA, such as cupy-cuda12x") from error
    platform, _, number = (device or "cuda").partition(":")
    try:
        if platform != "cuda":
            raise ValueError("CuPy computes on CUDA devices only")
        place = cupy.cuda.Device(int(number or 0))
        place.use()  # the process belongs to the command line
        cupy.zeros(1, dtype=dtype)
    except (RuntimeError, ValueError) as error:
        raise _no_device("cupy", device, dtype, error) from error
    return Backend(
        library="cupy",
        version=cupy.__version__,
        device=f"cuda:{place.id}",
        dtype=dtype,
        from_numpy=lambda host: cupy.asarray(host, dtype=dtype),
    )


BACKENDS: Final[dict[str, Callable[[str | None, str], Backend]]] = {
    "numpy": _numpy,
    "torch": _torch,
    "jax": _jax,
    "cupy": _cupy,
}
"""By the name that `--backend` takes."""


def _missing(library: str, remedy: str) -> MissingExtraError:
    return MissingExtraError(f"{library} is not installed: {remedy}")


def _no_device(library: str, device: str | None, dtype: str, error: Exception) -> FdntValueError:
    reason = str(error).strip().partition("\n")[0]
    return FdntValueError(f"{library} cannot use the device {device!r} with {dtype}: {reason}")
