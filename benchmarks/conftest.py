"""What the benchmarks measure: GREAT08-like stamps, one thread for each library."""

from __future__ import annotations

import os
from collections.abc import Callable
from types import ModuleType
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before the libraries are loaded

import array_api_compat.numpy as compat_numpy
import numpy as np
import pytest

from fdnt_xp.data.simulate import great08_image

N_GAL, CELL = 1024, 48


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--cuda", action="store_true", help="also on torch's first CUDA device")


@pytest.fixture(scope="session")
def field() -> tuple[np.ndarray, np.ndarray]:
    """Stamps (N_GAL, CELL, CELL) at S/N 200, and the star."""
    drawn = great08_image(n_x=32, n_y=N_GAL // 32, cell=CELL, seed=3)
    cells = drawn.image.reshape(N_GAL // 32, CELL, 32, CELL).transpose(0, 2, 1, 3)
    return np.ascontiguousarray(cells).reshape(-1, CELL, CELL), drawn.psf_image


class Library:
    """A library, a device and a precision, and how to wait for it."""

    def __init__(self, name: str, dtype: str) -> None:
        self.name, self.dtype = name, dtype
        self.device = name.partition(":")[2]

    @property
    def xp(self) -> ModuleType:
        if self.name == "numpy":
            return compat_numpy
        return pytest.importorskip("array_api_compat.torch")

    def array(self, host: np.ndarray) -> Any:
        xp = self.xp
        if self.name == "numpy":
            return host.astype(self.dtype)
        return xp.asarray(host, dtype=getattr(xp, self.dtype), device=self.device)

    def waiting(self, function: Callable[[], Any]) -> Callable[[], Any]:
        """Return the function, followed by a wait for the device."""
        if self.device != "cuda":
            return function

        def synchronised() -> Any:
            result = function()
            self.xp.cuda.synchronize()
            return result

        return synchronised


@pytest.fixture(params=["float64", "float32"])
def dtype(request: pytest.FixtureRequest) -> str:
    return request.param


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Choose the libraries: to skip one later is an error, its benchmark being unused."""
    if "library" in metafunc.fixturenames:
        cuda = ["torch:cuda"] if metafunc.config.getoption("--cuda") else []
        metafunc.parametrize("library", ["numpy", "torch:cpu", *cuda], indirect=True)


@pytest.fixture
def library(request: pytest.FixtureRequest, dtype: str) -> Library:
    library = Library(request.param, dtype)
    if library.device == "cpu":
        library.xp.set_num_threads(1)
    return library
