"""Accuracy on simulated galaxies: truths from GalSim, marked `science` as a whole."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("galsim")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    here = Path(__file__).parent
    for item in items:
        if here in item.path.parents:
            item.add_marker(pytest.mark.science)
