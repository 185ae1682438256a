"""The numbers behind a report or a figure, as JSON or as a table."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from fdnt_xp.data.catalog import check_catalog, write_catalog
from fdnt_xp.data.files import check_writable, new_file
from fdnt_xp.errors import CatalogError


def check_json(path: str, *, overwrite: bool) -> None:
    """Raise what `write_json` would raise, before there is anything to write."""
    if Path(path).suffix.lower() != ".json":
        raise CatalogError(f"the suffix of {path} must be .json")
    check_writable(path, overwrite=overwrite)


def write_json(content: Any, path: str, *, overwrite: bool) -> None:
    """Write JSON, whole or not at all."""
    with new_file(path, overwrite=overwrite) as temporary:
        temporary.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def check_rows(path: str, *, overwrite: bool) -> None:
    """Raise what `write_rows` would raise, before there is anything to write."""
    check = check_json if _is_json(path) else check_catalog
    check(path, overwrite=overwrite)


def write_rows(rows: list[dict[str, Any]], path: str, *, overwrite: bool) -> None:
    """Write rows as JSON, or as a table by the suffix."""
    if _is_json(path):
        # JSON has no NaN.
        plain = [{k: None if v != v else v for k, v in row.items()} for row in rows]
        write_json(plain, path, overwrite=overwrite)
        return
    from astropy.table import Table

    write_catalog(Table(rows=rows), path, overwrite=overwrite)


def _is_json(path: str) -> bool:
    return Path(path).suffix.lower() == ".json"
