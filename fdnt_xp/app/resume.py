"""The folder of a run that can be resumed: its `run.json` says what it was begun with."""

from __future__ import annotations

import json
import warnings
from collections.abc import Collection, Iterable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import fdnt_xp
from fdnt_xp.app.numbers import write_json
from fdnt_xp.data.files import make_folder
from fdnt_xp.data.provenance import provenance
from fdnt_xp.errors import CatalogError, FdntWarning

RUN: Final = "run.json"


def begin_run(
    folder: Path,
    options: Mapping[str, Any],
    *,
    command: str,
    remedy: str,
    shown: Mapping[str, str] | None = None,
    choices: Mapping[str, Any] | None = None,
    unfinished: Collection[str] = (),
) -> dict[str, Any]:
    """Make the folder of a run, or see that it is one that can be resumed.

    Parameters
    ----------
    folder : Path
        A new or empty one, or that of a run with the same options.
    options : mapping
        What must be the same when a run is resumed, as it comes back from JSON.
    command : str
        Whose runs these are, "great08 measure".
    remedy : str
        What to do if there is something else in the folder, "choose another folder".
    shown : mapping, optional
        What the user calls an option, if it is not `--name`.
    choices : mapping, optional
        What a new run chooses for itself, and a resumed one takes over.
    unfinished : collection of str
        Patterns of the names that `new_file` gives to what is being written in the folder:
        what a kill left behind is removed.

    Returns
    -------
    dict
        The choices of the run.

    Raises
    ------
    CatalogError
        If the folder holds something else, or a run with other options.
    """
    path = folder / RUN
    if path.is_file():
        run = read_json(path)
        _refuse_others(folder, run, options, command, remedy, shown or {})
        tidy(folder, unfinished)
        return dict(run.get("choices", {}))
    if folder.is_dir() and any(not file.name.startswith(".run-") for file in folder.iterdir()):
        raise CatalogError(
            f"{folder} is not empty, and no run of {command} is in it: it has no {RUN}; {remedy}"
        )
    make_folder(folder)
    run = {"options": dict(options), "begun": provenance()}
    if choices:
        run["choices"] = dict(choices)
    write_json(run, str(path), overwrite=False)
    return dict(choices or {})


def files_as_they_are(paths: Iterable[Path]) -> dict[str, str]:
    """Return the size and the last change of each file, to tell whether it is another one."""
    states = {}
    for path in paths:
        now = path.stat()
        changed = datetime.fromtimestamp(now.st_mtime, UTC).isoformat()
        states[str(path)] = f"{now.st_size} bytes, {changed}"
    return states


def tidy(folder: Path, unfinished: Collection[str]) -> None:
    """Remove files that a process which was killed had begun to write."""
    for pattern in (f".{Path(RUN).stem}-*.json", *unfinished):
        for file in folder.glob(pattern):
            file.unlink(missing_ok=True)


def read_json(path: Path) -> dict[str, Any]:
    """Return what a run wrote; `CatalogError` if that is not what is there."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise CatalogError(f"cannot read {path}: {error}") from error
    if not isinstance(content, dict):
        raise CatalogError(f"{path} is not what was written: remove it")
    return content


def _refuse_others(
    folder: Path,
    run: dict[str, Any],
    options: Mapping[str, Any],
    command: str,
    remedy: str,
    shown: Mapping[str, str],
) -> None:
    """Raise `CatalogError` if a run had other options; warn if it was another version's."""
    if not {"options", "begun"} <= set(run):
        raise CatalogError(f"{folder / RUN} is not that of a run of {command}")
    for name, now in options.items():
        then = run["options"].get(name)
        if then != now:
            option = shown.get(name, f"--{name.replace('_', '-')}")
            raise CatalogError(
                f"{folder} holds a run with {option} {_text(then)}, and this has "
                f"{_text(now)}: give the same options, or {remedy}"
            )
    version = run["begun"]["FDNTVER"]
    if version != fdnt_xp.__version__:
        warnings.warn(
            f"{folder} was begun by fdnt_xp {version}, and is continued by {fdnt_xp.__version__}",
            FdntWarning,
            stacklevel=3,
        )


def _text(value: Any) -> str:
    return "not given" if value is None else str(value)
