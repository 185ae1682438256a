"""Output files appear whole or not at all, and never in the place of another by accident."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from fdnt_xp.errors import CatalogError


@contextmanager
def new_file(path: str | os.PathLike[str], *, overwrite: bool = False) -> Iterator[Path]:
    """Give a temporary path to write to, which becomes `path` when the block succeeds.

    The temporary file lies in the same folder and has the same suffix. It is renamed in one
    step; if the block raises (an interrupt included) it is removed, and what was at `path`
    before is untouched.

    Parameters
    ----------
    path : path
        The file to make.
    overwrite : bool
        Whether it may replace a file that exists.

    Raises
    ------
    CatalogError
        If the file exists and may not be replaced, or cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> folder = Path(tempfile.mkdtemp())
    >>> with new_file(folder / "note.txt") as temporary:
    ...     _ = temporary.write_text("all of it")
    >>> [file.name for file in folder.iterdir()]
    ['note.txt']
    """
    target = Path(path)
    temporary = target.with_name(f".{target.stem}-{secrets.token_hex(4)}{target.suffix}")
    try:
        check_writable(target, overwrite=overwrite)
        yield temporary
        if not overwrite and target.exists():  # it appeared while the block ran
            raise _exists(target)
        temporary.replace(target)
    except OSError as error:
        if isinstance(error, CatalogError):
            raise
        raise CatalogError(f"cannot write {target}: {error.strerror or error}") from error
    finally:
        with suppress(OSError):
            temporary.unlink()


def check_writable(path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
    """Raise `CatalogError` if `new_file` would; ask before an hour of work, not after."""
    target = Path(path)
    if target.is_dir():
        raise CatalogError(f"cannot write {target}: it is a folder")
    if not overwrite and target.exists():
        raise _exists(target)
    folder = target.parent
    if not folder.is_dir():
        reason = "is not a folder" if folder.exists() else "does not exist"
        raise CatalogError(f"cannot write {target}: {folder} {reason}")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise CatalogError(f"cannot write {target}: no permission to write in {folder}")


def make_folder(path: str | os.PathLike[str]) -> Path:
    """Return a folder, made with its parents if need be; `CatalogError` if it cannot be."""
    folder = Path(path)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise CatalogError(f"cannot make the folder {folder}: {error.strerror}") from error
    return folder


def _exists(path: Path) -> CatalogError:
    return CatalogError(f"{path} exists; choose another name or overwrite it (--overwrite)")
