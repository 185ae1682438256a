"""A catalog is the same however its rows come in batches, and is never half there."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table

from fdnt_xp.data.catalog import read_catalog, write_catalog
from fdnt_xp.data.row_batches import new_catalog
from fdnt_xp.errors import CatalogError, FdntValueError

SUFFIXES = [".fits", ".ecsv", ".parquet", ".hdf5"]


@pytest.fixture
def table():
    """Rows of all kinds of columns."""
    rng = np.random.default_rng(3)
    n = 200
    table = Table(
        {
            "id": np.array([f"galaxy {i}" for i in range(n)]),
            "x": np.where(rng.random(n) < 0.1, np.nan, rng.standard_normal(n)),
            "e1": rng.standard_normal(n).astype("f4"),
            "flags": rng.integers(0, 1 << 30, n).astype("i4"),
            "seed": rng.integers(-(1 << 62), 1 << 62, n),
            "used": rng.random(n) < 0.5,
        }
    )
    table["x"].unit, table["x"].description = "pix", "centroid along columns"
    table.meta = {"CREATOR": "fdnt_xp", "NOISEVAR": 2.5, "IMAGE": "a.fits"}
    return table


def write_in_batches(table, path, ends):
    with new_catalog(path, meta=table.meta) as catalog:
        for start, end in zip([0, *ends], [*ends, len(table)], strict=True):
            catalog.append(table[start:end])
    assert catalog.n_rows == len(table)


def write_tables(tables, path):
    with new_catalog(path) as catalog:
        for table in tables:
            catalog.append(table)


@pytest.mark.parametrize("ends", [(1,), (0, 7, 7, 150), (0, 0, 200)])
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_batches_make_the_same_catalog(suffix, ends, table, tmp_path):
    whole, parts = tmp_path / f"whole{suffix}", tmp_path / f"parts{suffix}"
    write_catalog(table, whole)
    write_in_batches(table, parts, ends)
    if suffix in (".fits", ".ecsv"):
        assert parts.read_bytes() == whole.read_bytes()
    read = read_catalog(parts)
    assert read.meta == table.meta
    assert read.colnames == table.colnames
    for name in table.colnames:
        assert read[name].dtype == table[name].dtype
        np.testing.assert_array_equal(read[name], table[name])
        assert (read[name].unit, read[name].description) == (
            table[name].unit,
            table[name].description,
        )
    assert sorted(file.name for file in tmp_path.iterdir()) == sorted([whole.name, parts.name])


def test_other_readers_find_the_batches(table, tmp_path):
    """The formats as astropy and pyarrow know them, without any reader of the package."""
    for suffix in SUFFIXES:
        write_in_batches(table, tmp_path / f"a{suffix}", (60, 80))
    with fits.open(tmp_path / "a.fits") as hdus:
        hdus.verify("exception")
        assert hdus["SHAPES"].header["NAXIS2"] == len(table)
        assert (tmp_path / "a.fits").stat().st_size % 2880 == 0
        np.testing.assert_array_equal(hdus["SHAPES"].data["seed"], table["seed"])
    from_hdf5 = Table.read(tmp_path / "a.hdf5", path="SHAPES")
    assert from_hdf5["x"].unit == "pix"
    assert from_hdf5.meta == table.meta
    np.testing.assert_array_equal(from_hdf5["x"], table["x"])
    np.testing.assert_array_equal(Table.read(tmp_path / "a.ecsv")["id"], table["id"])
    parquet = pytest.importorskip("pyarrow.parquet").ParquetFile(tmp_path / "a.parquet")
    assert parquet.num_row_groups == 3
    np.testing.assert_array_equal(parquet.read()["id"].to_numpy(), table["id"])


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_the_first_table_says_what_the_columns_are(suffix, table, tmp_path):
    path = tmp_path / f"catalog{suffix}"
    narrow = table[10:]
    narrow["x"] = narrow["x"].astype("f4")
    narrow["x"].unit, narrow.meta = "km", {"IMAGE": "b.fits"}
    write_tables([table[:10], narrow], path)
    read = read_catalog(path)
    assert (read["x"].unit, read["x"].dtype, read.meta) == ("pix", "f8", table.meta)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_rows_that_do_not_fit(suffix, table, tmp_path):
    path = tmp_path / f"catalog{suffix}"
    others = {
        "too wide for the <U10": {"id": np.array(["galaxy with a long name"])},
        "too wide for the float32": {"e1": np.array([0.1])},
        "the first ones id, x, e1": {"more": np.array([0.1])},
    }
    for message, columns in others.items():
        row = table[:1]
        row.keep_columns([name for name in row.colnames if name not in columns])
        for name, values in columns.items():
            row.add_column(values, name=name, index=table.colnames.index("id"))
        if "e1" in columns:
            row = row[table.colnames]
        with pytest.raises(CatalogError, match=message):
            write_tables([table, row], path)
        assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_text_that_is_not_ascii(suffix, tmp_path):
    path = tmp_path / f"catalog{suffix}"
    table = Table({"id": np.array(["a", "é"])})
    if suffix == ".fits":
        with pytest.raises(CatalogError, match=r"cannot write .*catalog\.fits: 'ascii' codec"):
            write_catalog(table, path)
        assert list(tmp_path.iterdir()) == []
        return
    write_catalog(table, path)
    assert read_catalog(path)["id"].tolist() == ["a", "é"]
    other = tmp_path / f"other{suffix}"
    write_tables([table[1:], table[:1]], other)
    assert read_catalog(other)["id"].tolist() == ["é", "a"]


def test_text_that_grows_in_bytes_is_not_cut(tmp_path):
    tables = [Table({"id": np.array([text])}) for text in ("a", "é")]
    with pytest.raises(CatalogError, match="text needs more bytes"):
        write_tables(tables, tmp_path / "catalog.hdf5")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_no_table_at_all(suffix, tmp_path):
    with (
        pytest.raises(FdntValueError, match="no table was appended"),
        new_catalog(tmp_path / f"catalog{suffix}"),
    ):
        pass
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_what_no_format_holds(suffix, tmp_path):
    objects = Table({"a": np.array([object(), None], dtype=object)})
    with pytest.raises(CatalogError, match="cannot write"):
        write_catalog(objects, tmp_path / f"catalog{suffix}")
    assert list(tmp_path.iterdir()) == []
