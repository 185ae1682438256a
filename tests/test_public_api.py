"""What the package promises from outside: its names, its version, its floors, its examples."""

from __future__ import annotations

import doctest
import importlib
import importlib.metadata
import inspect
import pkgutil
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

import fdnt_xp

ROOT = Path(__file__).parents[1]
MODULES = sorted(
    module.name for module in pkgutil.walk_packages(fdnt_xp.__path__, prefix="fdnt_xp.")
)
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def test_all_is_sorted_and_complete():
    public = {
        name
        for name, member in vars(fdnt_xp).items()
        if not name.startswith("_") and not isinstance(member, ModuleType)
    }
    assert list(fdnt_xp.__all__) == sorted(fdnt_xp.__all__)
    assert set(fdnt_xp.__all__) - {"__version__"} == public


def test_public_names_are_documented():
    undocumented = [name for name in fdnt_xp.__all__ if not inspect.getdoc(getattr(fdnt_xp, name))]
    assert undocumented == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_names_in_the_documentation_exist(page):
    used = set(re.findall(r"\bfx\.(\w+)", page.read_text(encoding="utf-8")))
    assert used <= set(fdnt_xp.__all__)


def test_one_version_everywhere():
    version = fdnt_xp.__version__
    assert version == importlib.metadata.version("fdnt-xp")
    assert f"\n## {version}" in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")


def test_importing_the_package_imports_no_backend():
    heavy = ["cupy", "galsim", "jax", "matplotlib", "torch"]
    code = f"import fdnt_xp, sys; print([name for name in {heavy} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_imports_go_one_way(monkeypatch, capsys):
    linter = pytest.importorskip("importlinter.cli")
    monkeypatch.chdir(ROOT)
    code = linter.lint_imports(no_cache=True)
    assert code == 0, capsys.readouterr().out


@pytest.mark.parametrize("name", MODULES)
def test_examples_in_docstrings(name):
    module = importlib.import_module(name)
    flags = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
    assert doctest.testmod(module, optionflags=flags).failed == 0
