"""What the benchmarks measure: GREAT08-like stamps, one thread for each library."""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import lru_cache
from types import ModuleType
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before the libraries are loaded

import array_api_compat.numpy as compat_numpy
import numpy as np
import pytest

from fdnt_xp.app.backends import Backend, load_backend
from fdnt_xp.app.bench_stamps import BenchStamps, make_stamps

N_GAL, CELL = 1024, 48


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--cuda", action="store_true", help="also on torch's first CUDA device")
    parser.addoption(
        "--every-scene",
        action="store_true",
        help="all combinations of stamp size, batch and S/N, not one changed at a time",
    )


# Drawing takes longer than measuring, and one scene after the other is wanted.
scene_of = lru_cache(maxsize=2)(make_stamps)
"""Stamps by number, size and S/N."""


@pytest.fixture(scope="session")
def drawn() -> BenchStamps:
    """N_GAL stamps of CELL x CELL pixels at S/N 200."""
    return make_stamps(N_GAL, CELL)


@pytest.fixture(scope="session")
def field(drawn: BenchStamps) -> tuple[np.ndarray, np.ndarray]:
    """The same, as stamps and star."""
    return drawn.pixels, drawn.star


class Library:
    """A library, a device and a precision, and how to wait for it."""

    def __init__(self, name: str, dtype: str) -> None:
        self.name, self.dtype = name, dtype
        self.device = name.partition(":")[2]

    @property
    def backend(self) -> Backend:
        return load_backend(self.name.partition(":")[0], self.device or None, self.dtype)

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
