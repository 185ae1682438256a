"""A catalog comes back as it was written, from every format, and is never half there."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table

import fdnt_xp
from fdnt_xp.data import row_batches
from fdnt_xp.data.catalog import check_catalog, read_catalog, write_catalog
from fdnt_xp.data.provenance import COMMENTS, SCHEMA, provenance
from fdnt_xp.errors import CatalogError, FdntWarning, MissingExtraError
from fdnt_xp.flags import Flag

SUFFIXES = [".fits", ".fit", ".ecsv", ".parquet", ".hdf5", ".h5"]


@pytest.fixture
def table():
    table = Table(
        {
            "id": np.arange(4),
            "name": np.array(["a", "bb", "c", ""]),
            "x": np.array([1.5, np.nan, -3.25, np.inf]),
            "e1": np.array([0.1, 0.2, np.nan, 0.3], dtype="f4"),
            "flags": np.array([0, 1, int(Flag.OFF_IMAGE), 5], dtype="i4"),
        }
    )
    table["x"].unit = "pix"
    table["x"].description = "centroid along columns, 0-based, integer at pixel centres " * 2 + "."
    table["e1"].description = "distortion (a^2-b^2)/(a^2+b^2), component 1"
    table.meta = provenance(
        image="folder/" * 15 + "imäge.fits", noisevar=1e6, cell=64, dtype="float64", wtsize=None
    )
    return table


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_round_trip(suffix, table, tmp_path):
    path = tmp_path / f"catalog{suffix}"
    write_catalog(table, path)
    read = read_catalog(path)
    assert read.colnames == table.colnames
    assert read.meta == table.meta
    for name in table.colnames:
        np.testing.assert_array_equal(read[name], table[name])
        assert read[name].dtype == table[name].dtype
        assert read[name].unit == table[name].unit
        assert (read[name].description or None) == (table[name].description or None)
        assert not hasattr(read[name], "mask")
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_empty_table(suffix, table, tmp_path):
    path = tmp_path / f"catalog{suffix}"
    write_catalog(table[:0], path)
    read = read_catalog(path)
    assert len(read) == 0
    assert read.colnames == table.colnames


def test_writing_leaves_the_table_alone(table, tmp_path):
    before = table.copy()
    write_catalog(table, tmp_path / "catalog.fits")
    assert table.meta == before.meta
    assert [c.description for c in table.itercols()] == [c.description for c in before.itercols()]


def test_any_fits_reader_finds_units_descriptions_and_provenance(table, tmp_path):
    path = tmp_path / "catalog.fits"
    write_catalog(table, path)
    header = fits.getheader(path, "SHAPES")
    number = table.colnames.index("x") + 1
    assert header[f"TUNIT{number}"] == "pix"
    assert header[f"TCOMM{number}"] == table["x"].description
    assert header["NOISEVAR"] == 1e6
    assert header.comments["NOISEVAR"] == COMMENTS["NOISEVAR"]
    assert header["IMAGE"].endswith("im\\xe4ge.fits")
    assert "COMMENT" not in header


def test_provenance():
    facts = provenance(image="a.fits", cell=40, noisevar=float("nan"), device=None)
    assert facts["CREATOR"] == "fdnt_xp"
    assert facts["FDNTVER"] == fdnt_xp.__version__
    assert facts["NUMPYVER"] == np.__version__
    assert (facts["IMAGE"], facts["CELL"]) == ("a.fits", 40)
    assert not {"NOISEVAR", "DEVICE"} & set(facts)
    with pytest.raises(KeyError):
        provenance(no_such_fact=1)


def test_columns_of_a_later_version_are_warned_of(table, tmp_path):
    assert table.meta["SCHEMA"] == SCHEMA
    table.meta["SCHEMA"] = SCHEMA + 1
    write_catalog(table, tmp_path / "catalog.fits")
    with pytest.warns(FdntWarning, match=f"columns of version {SCHEMA + 1}"):
        assert len(read_catalog(tmp_path / "catalog.fits")) == len(table)


@pytest.mark.parametrize("keyword", COMMENTS)
def test_keywords_fit_a_fits_header(keyword):
    assert len(keyword) <= 8
    assert keyword == keyword.upper()
    assert len(COMMENTS[keyword]) <= 47


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_an_existing_file_is_kept(suffix, table, tmp_path):
    path = tmp_path / f"catalog{suffix}"
    write_catalog(table, path)
    before = path.read_bytes()
    with pytest.raises(CatalogError, match="exists"):
        write_catalog(table[:1], path)
    with pytest.raises(CatalogError, match="exists"):
        check_catalog(path)
    assert path.read_bytes() == before
    check_catalog(path, overwrite=True)
    write_catalog(table[:1], path, overwrite=True)
    assert len(read_catalog(path)) == 1


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("error", [OSError(28, "No space left"), KeyboardInterrupt()])
def test_a_writer_that_fails_midway_leaves_nothing(suffix, error, table, tmp_path, monkeypatch):
    class WritesHalf(row_batches._KINDS[suffix]):
        def append(self, table):
            super().append(table)
            raise error

    monkeypatch.setitem(row_batches._KINDS, suffix, WritesHalf)
    path = tmp_path / f"catalog{suffix}"
    with pytest.raises(CatalogError if isinstance(error, OSError) else KeyboardInterrupt):
        write_catalog(table, path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["catalog.txt", "catalog", "catalog.fits.gz"])
@pytest.mark.parametrize("function", [read_catalog, check_catalog])
def test_unknown_suffix(name, function, tmp_path):
    with pytest.raises(
        CatalogError, match=r"known are \.fits, \.fit, \.ecsv, \.parquet, \.hdf5, \.h5"
    ):
        function(tmp_path / name)


def test_places_that_cannot_be_written(table, tmp_path):
    (tmp_path / "file").touch()
    for folder in ("no", "file"):
        with pytest.raises(CatalogError, match="cannot write"):
            write_catalog(table, tmp_path / folder / "catalog.fits")


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_files_that_cannot_be_read(suffix, table, tmp_path):
    path = tmp_path / f"catalog{suffix}"
    with pytest.raises(CatalogError, match="does not exist"):
        read_catalog(path)
    path.write_bytes(b"nothing of the kind")
    with pytest.raises(CatalogError, match=rf"cannot read the catalog .*catalog\{suffix}"):
        read_catalog(path)
    write_catalog(table, path, overwrite=True)
    if suffix != ".ecsv":  # half a text table may be a table
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
        with pytest.raises(CatalogError, match="cannot read the catalog"):
            read_catalog(path)


@pytest.mark.parametrize("suffix", [".parquet", ".hdf5", ".h5"])
def test_formats_name_their_extras(suffix, table, tmp_path, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    extra = "parquet" if suffix == ".parquet" else "hdf5"
    with pytest.raises(MissingExtraError, match=rf"fdnt-xp\[{extra}\]"):
        write_catalog(table, tmp_path / f"catalog{suffix}")
