"""Which array libraries the tests run on, and how arrays get there and back.

`FDNT_XP_TEST_BACKENDS` holds a comma list of the ids of `Backend`. What is named there
must work: a library that is missing is an error, not a skip. Unset, the suite runs on
NumPy, array-api-strict, and torch on the CPU if torch is installed.
"""

from __future__ import annotations

import importlib
import importlib.util
import os
from collections.abc import Callable
from enum import Enum
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, settings

from fdnt_xp.arrays import Array, Device, DType, to_numpy

VARIABLE = "FDNT_XP_TEST_BACKENDS"


# The same examples on every machine and no clock: a failure belongs to the change that
# shows it. The fixtures below do not vary between examples, so they may be shared.
settings.register_profile(
    "fdnt_xp",
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
settings.load_profile("fdnt_xp")


class Backend(Enum):
    """A library, and where its arrays live."""

    NUMPY = "numpy"
    NUMPY_READONLY = "numpy:readonly"
    STRICT = "strict"
    STRICT_DEVICE1 = "strict:device1"
    TORCH_CPU = "torch:cpu"
    TORCH_CUDA = "torch:cuda"
    JAX = "jax"
    CUPY = "cupy"

    def __str__(self) -> str:
        return self.value

    @property
    def library(self) -> str:
        return self.value.partition(":")[0]

    @property
    def namespace(self) -> ModuleType:
        """The module that `array_namespace` gives for arrays of this backend."""
        return importlib.import_module(_NAMESPACES[self.library])

    @property
    def device(self) -> Device:
        match self:
            case Backend.NUMPY | Backend.NUMPY_READONLY:
                return "cpu"
            case Backend.STRICT:
                return self.namespace.Device("CPU_DEVICE")
            case Backend.STRICT_DEVICE1:
                return self.namespace.Device("device1")
            case Backend.TORCH_CPU:
                return self.namespace.device("cpu")
            case Backend.TORCH_CUDA:
                return self.namespace.device("cuda:0")
            case Backend.JAX:
                return self.namespace.zeros(()).device
            case Backend.CUPY:
                return self.namespace.cuda.Device(0)

    def why_not(self) -> str | None:
        """Say why the backend cannot run here, or None."""
        library = _LIBRARIES[self.library]
        if importlib.util.find_spec(library) is None:
            return f"{library} is not installed"
        if self is Backend.TORCH_CUDA and not self.namespace.cuda.is_available():
            return "torch finds no CUDA device"
        return None


_LIBRARIES = {
    "numpy": "numpy",
    "strict": "array_api_strict",
    "torch": "torch",
    "jax": "jax",
    "cupy": "cupy",
}
_NAMESPACES = {
    "numpy": "array_api_compat.numpy",
    "strict": "array_api_strict",
    "torch": "array_api_compat.torch",
    "jax": "jax.numpy",
    "cupy": "array_api_compat.cupy",
}
_DEFAULT = [Backend.NUMPY, Backend.NUMPY_READONLY, Backend.STRICT, Backend.STRICT_DEVICE1]


def selected_backends() -> list[Backend]:
    """Return the backends to test, in the order in which they were named."""
    names = os.environ.get(VARIABLE)
    if names is None:
        return [*_DEFAULT, *([] if Backend.TORCH_CPU.why_not() else [Backend.TORCH_CPU])]
    backends = []
    for name in filter(None, (part.strip() for part in names.split(","))):
        try:
            backend = Backend(name)
        except ValueError:
            known = ", ".join(str(known) for known in Backend)
            raise pytest.UsageError(f"{VARIABLE}: no backend {name!r}; known: {known}") from None
        if reason := backend.why_not():
            raise pytest.UsageError(f"{VARIABLE}: {name} cannot be tested, {reason}")
        backends.append(backend)
    if not backends:
        raise pytest.UsageError(f"{VARIABLE} is set but names no backend")
    return backends


def pytest_configure(config: pytest.Config) -> None:
    libraries = {backend.library for backend in selected_backends()}
    if "strict" in libraries:
        strict = importlib.import_module("array_api_strict")
        strict.set_array_api_strict_flags(
            boolean_indexing=False,
            data_dependent_shapes=False,
            enabled_extensions=("linalg", "fft"),
        )
    if "jax" in libraries:
        # Without it JAX has no float64 and does not follow the standard.
        importlib.import_module("jax").config.update("jax_enable_x64", True)


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    if "backend" in metafunc.fixturenames:
        metafunc.parametrize("backend", selected_backends(), ids=str, indirect=True)


@pytest.fixture
def backend(request: pytest.FixtureRequest) -> Backend:
    """The backend under test; `skip_backend` marks are obeyed here."""
    for mark in request.node.iter_markers("skip_backend"):
        if {request.param.value, request.param.library} & set(mark.args):
            pytest.skip(mark.kwargs["reason"])
    return request.param


@pytest.fixture
def xp(backend: Backend) -> ModuleType:
    """Its namespace."""
    return backend.namespace


@pytest.fixture
def device(backend: Backend) -> Device:
    """Where its arrays are made; for `strict:device1` not the default device."""
    return backend.device


@pytest.fixture(params=["float64", "float32"])
def dtype(request: pytest.FixtureRequest, xp: ModuleType) -> DType:
    """Its float64 and float32 in turn."""
    return getattr(xp, request.param)


ToXp = Callable[..., Array]


@pytest.fixture
def to_xp(backend: Backend, xp: ModuleType, device: Device) -> ToXp:
    """Return `convert(array, dtype=None)`, from NumPy or lists to the backend and its device.

    The dtype is kept unless given, by name ("float32") or as the namespace has it.
    """

    def convert(array: Any, dtype: DType | str | None = None) -> Array:
        host = np.array(array, order="C")
        if isinstance(dtype, str) or dtype is None:
            dtype = getattr(xp, dtype or host.dtype.name)
        converted = xp.asarray(host, dtype=dtype, device=device)
        if backend is Backend.NUMPY_READONLY:
            converted.flags.writeable = False
        return converted

    return convert


@pytest.fixture
def to_np() -> Callable[[Array], np.ndarray]:
    """Return the function from an array of any backend to NumPy."""
    return to_numpy
