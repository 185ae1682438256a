"""The page about a catalog is drawn for any catalog that `measure` can write."""

from __future__ import annotations

import builtins
import subprocess
import sys

import numpy as np
import pytest
from astropy.table import Table

from fdnt_xp.app.plots import check_figure, plot_catalog, save_figure
from fdnt_xp.app.summary import count_flags, format_measured, measured_rows, summary_lines
from fdnt_xp.errors import CatalogError, MissingExtraError
from fdnt_xp.flags import Flag

pytest.importorskip("matplotlib")


def _catalog(n, *, seed=1):
    rng = np.random.default_rng(seed)
    side = max(1, int(np.ceil(np.sqrt(n))))
    x, y = (64.0 * v + 31.5 for v in (np.arange(n) % side, np.arange(n) // side))
    e = rng.uniform(0, 0.7, n) * np.exp(1j * rng.uniform(0, 2 * np.pi, n))
    table = Table(
        {
            "x": x,
            "y": y,
            "x_image": x + rng.normal(size=n),
            "y_image": y + rng.normal(size=n),
            "e1": e.real,
            "e2": e.imag,
            "snr": rng.uniform(100, 300, n),
            "flags": np.zeros(n, dtype="i4"),
        }
    )
    for start, flag in ((0, Flag.EDGE), (1, Flag.SIZE_AT_BOUND), (2, Flag.DID_NOT_CONVERGE)):
        rows = np.arange(n) % 37 == start
        table["flags"][rows] = int(flag)
    for name in ("x_image", "y_image", "e1", "e2", "snr"):
        table[name][~measured_rows(table)] = np.nan
    return table


def _texts(figure):
    return " ".join(
        text.get_text()
        for axes in figure.axes
        for text in [*axes.texts, axes.title, axes._left_title]
    )


@pytest.mark.parametrize("n", [0, 1, 2, 50, 2000])
def test_any_number_of_galaxies(n, tmp_path):
    figure = plot_catalog(_catalog(n), "a catalog")
    save_figure(figure, tmp_path / "page.png")
    assert (tmp_path / "page.png").read_bytes().startswith(b"\x89PNG")
    assert [file.name for file in tmp_path.iterdir()] == ["page.png"]


def test_many_galaxies_are_averaged():
    few, many = plot_catalog(_catalog(300)), plot_catalog(_catalog(10_000))
    whiskers = [figure.axes[0].collections[0].N for figure in (few, many)]
    assert whiskers[0] == measured_rows(_catalog(300)).sum()
    assert 300 < whiskers[1] < 1000
    assert "mean of bins" not in _texts(few)
    assert "mean of bins" in _texts(many)


def test_whiskers_point_along_the_galaxies():
    table = _catalog(100)
    table = table[measured_rows(table)]
    table["e1"], table["e2"] = 0.5 * np.cos(2.0), 0.5 * np.sin(2.0)  # at 1 rad
    whiskers = plot_catalog(table).axes[0].collections[0]
    np.testing.assert_allclose(np.arctan2(whiskers.V, whiskers.U), 1.0)


def test_no_galaxy_measured():
    table = _catalog(20)
    table["flags"] = int(Flag.NO_SIGNAL)
    for name in ("x_image", "y_image", "e1", "e2", "snr"):
        table[name] = np.nan
    text = _texts(plot_catalog(table))
    assert "no galaxy was measured" in text
    assert "no positive flux: 20" in text


def test_no_noise_no_snr(tmp_path):
    table = _catalog(20)
    table["snr"] = np.nan
    figure = plot_catalog(table)
    assert "no noise variance" in _texts(figure)
    save_figure(figure, tmp_path / "page.png")


def test_equal_snr_and_a_single_row_of_galaxies(tmp_path):
    table = _catalog(500)
    table["snr"], table["y"] = 200.0, 31.5
    save_figure(plot_catalog(table), tmp_path / "page.png")


def test_stamps_of_a_cube(tmp_path):
    table = _catalog(500)
    table["x"], table["y"] = 31.5, 31.5
    figure = plot_catalog(table)
    assert "cube" in _texts(figure)
    save_figure(figure, tmp_path / "page.png")


@pytest.mark.parametrize("suffix", [".pdf", ".svg"])
def test_other_formats(suffix, tmp_path):
    save_figure(plot_catalog(_catalog(10)), tmp_path / f"page{suffix}")
    assert (tmp_path / f"page{suffix}").stat().st_size > 1000


def test_figures_that_cannot_be_written(tmp_path):
    with pytest.raises(CatalogError, match=r"known are \.png, \.pdf, \.svg"):
        check_figure(tmp_path / "page.doc")
    (tmp_path / "page.png").touch()
    with pytest.raises(CatalogError, match="exists"):
        check_figure(tmp_path / "page.png")


def test_not_a_catalog():
    with pytest.raises(CatalogError, match="no column x_image, y_image"):
        plot_catalog(Table({"x": [1], "y": [1], "e1": [0], "e2": [0], "snr": [1], "flags": [0]}))


def test_without_matplotlib_the_extra_is_named(monkeypatch):
    real = builtins.__import__

    def without(name, *rest):
        if name.startswith("matplotlib"):
            raise ImportError(name)
        return real(name, *rest)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(MissingExtraError, match=r"fdnt-xp\[plot\]"):
        plot_catalog(_catalog(3))


def test_pyplot_is_never_imported():
    code = (
        "import sys; from astropy.table import Table; from fdnt_xp.app.plots import *; "
        "plot_catalog(Table({name: [0.5] for name in NEEDED[:-1]} | {'flags': [0]})); "
        "print('matplotlib.pyplot' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


# --- the summary ------------------------------------------------------------------------


def test_summary():
    lines = list(summary_lines(_catalog(370), seconds=3.7))
    assert lines[0] == "measured   350 of 370 galaxies (94.59%)"
    assert lines[1] == "time       3.7 s, 10 ms per galaxy"
    assert lines[2] == "failed         10  EDGE: stamp cut by the edge of the image"
    assert lines[3] == "               10  DID_NOT_CONVERGE: iteration limit reached"
    assert lines[4] == "noted          10  SIZE_AT_BOUND: weight size held at its bound"
    assert lines[5].startswith("mean shape e1 = ")
    assert len(lines) == 6


def test_summary_of_nothing():
    assert list(summary_lines(_catalog(0), seconds=0.1)) == ["measured   0 of 0 galaxies"]


def test_flags_are_counted_each():
    table = _catalog(74)
    table["flags"][5] = int(Flag.EDGE | Flag.NO_SIGNAL)
    assert count_flags(table) == {
        "EDGE": 3,
        "SIZE_AT_BOUND": 2,
        "DID_NOT_CONVERGE": 2,
        "NO_SIGNAL": 1,
    }


@pytest.mark.parametrize(
    ("value", "error", "text"),
    [
        (0.0201234, 0.000312, "+0.02012 ± 0.00031"),
        (-1234.6, 56.0, "-1235 ± 56"),
        (0.5, float("nan"), "+0.5"),
        (0.5, 0.0, "+0.5"),
    ],
)
def test_values_with_errors(value, error, text):
    assert format_measured(value, error) == text
