"""The project's own lint finds what it should, and nothing else."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def lint():
    spec = importlib.util.spec_from_file_location("check", ROOT / "tools" / "check_devices.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize(
    ("call", "missing"),
    [
        ("xp.zeros(3)", "device= and dtype="),
        ("xp.ones(3, dtype=d)", "device="),
        ("xp.full((2, 2), 1.0, device=d)", "dtype="),
        ("self.xp.empty(3)", "device= and dtype="),
        ("xp.fft.fftfreq(8)", "device= and dtype="),
        ("xp.fft.rfftfreq(8, device=d)", "dtype="),
        ("xp.asarray([1.0, 2.0], device=d)", "dtype="),
        ("xp.asarray(-1.0, device=d)", "dtype="),
        ("xp.asarray(image)", "device="),
        ("f(xp.eye(2)) + 1", "device= and dtype="),
    ],
)
def test_found(call, missing, lint, tmp_path, capsys):
    file = tmp_path / "module.py"
    file.write_text(f"import numpy\nx = {call}\n")
    assert lint.main([str(tmp_path)]) == 1
    assert capsys.readouterr().out.strip().endswith(f"(...) without {missing}")
    assert next(lint.check(file)).startswith(f"{file}:2: ")


@pytest.mark.parametrize(
    "call",
    [
        "xp.zeros(3, dtype=d, device=e)",
        "xp.asarray(image, device=e)",
        "xp.zeros(3, **like)",
        "xp.zeros_like(image)",
        "xp.sum(image)",
        "np.zeros(3)",
        "np.fft.fftfreq(8)",
        "zeros(3)",
        "xp.zeros(3)  # default device: a bool for the host",
        "xp.zeros(\n    3,  # default device: a bool for the host\n)",
    ],
)
def test_passed(call, lint, tmp_path, capsys):
    file = tmp_path / "module.py"
    file.write_text(f"x = {call}\n")
    assert lint.main([str(file)]) == 0
    assert capsys.readouterr().out == ""


def test_the_package_passes(lint):
    assert lint.main([str(ROOT / "fdnt_xp")]) == 0
