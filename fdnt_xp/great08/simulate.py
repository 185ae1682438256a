"""Write a simulated directory of the challenge, set by set, as `read_challenge` reads it.

A set is drawn from the seed and its number alone, so neither the number of processes nor an
interruption matters. Its image is written last and in one step: where it is, the set is
finished.
"""

from __future__ import annotations

import importlib.metadata
import json
import os
import warnings
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

import fdnt_xp
from fdnt_xp.data.catalog import write_catalog
from fdnt_xp.data.files import make_folder, new_file
from fdnt_xp.data.images import write_image
from fdnt_xp.data.profiles import load_galsim
from fdnt_xp.errors import CatalogError, FdntWarning
from fdnt_xp.great08.challenge import PARAMETERS, PSF_MAP, set_name
from fdnt_xp.great08.moffat import write_moffat
from fdnt_xp.great08.populations import analytic_psf
from fdnt_xp.great08.sets import Simulation, draw_set, shear_table
from fdnt_xp.great08.truth import TRUTH

_TRUTHS: Final = "truth"
"""Folder of the tables of galaxies."""


def begin_challenge(directory: str | os.PathLike[str], simulation: Simulation) -> list[int]:
    """Write what all sets share, or see that it was written for the same simulation.

    Parameters
    ----------
    directory : path
        A new or empty folder, or one that was begun with the same `simulation`.
    simulation : Simulation
        What to draw.

    Returns
    -------
    list of int
        Sets that have no image yet, for `write_set`.

    Raises
    ------
    CatalogError
        If the directory holds something else or was begun with other parameters, or something
        cannot be written.
    MissingExtraError
        If GalSim is not installed.
    """
    load_galsim()
    folder = make_folder(directory)
    if (folder / PARAMETERS).exists():
        _check_same(folder / PARAMETERS, simulation)
    else:
        if foreign := sorted(p.name for p in folder.iterdir() if not p.name.startswith(".")):
            raise CatalogError(
                f"{folder} is not empty and no simulation was begun in it, for it holds "
                f"{foreign[0]} but no {PARAMETERS}; choose a new folder"
            )
        _write_text(folder / PARAMETERS, json.dumps(_record(simulation), indent=2) + "\n")
    make_folder(folder / _TRUTHS)
    table = shear_table(simulation)
    for name in sorted(set(table["psf"])):
        _write_psf(folder, name, simulation)
    if not (folder / TRUTH).exists():
        write_catalog(table, folder / TRUTH)
    if not (folder / PSF_MAP).exists():
        rows = [f"{set_name(number)} {psf}" for number, psf in table.iterrows("set", "psf")]
        _write_text(folder / PSF_MAP, "\n".join(["set psf", *rows]) + "\n")
    numbers = range(1, simulation.n_sets + 1)
    return [number for number in numbers if not _image_path(folder, number).exists()]


def write_set(directory: str | os.PathLike[str], simulation: Simulation, number: int) -> None:
    """Draw a set and write its truth, then its image, which says that it is finished."""
    folder = Path(directory)
    drawn = draw_set(simulation, number)
    truth = folder / _TRUTHS / f"{set_name(number)}.ecsv"
    write_catalog(drawn.truth, truth, overwrite=True)  # of a set that was interrupted
    write_image(
        drawn.image,
        _image_path(folder, number),
        cell=simulation.cell,
        nx=simulation.grid,
        ny=simulation.grid,
    )


def remove_leftovers(directory: str | os.PathLike[str]) -> None:
    """Remove what processes that were killed had not finished; none may be at work."""
    for pattern in (".set*-????????.fit", f"{_TRUTHS}/.set*-????????.ecsv"):
        for path in Path(directory).glob(pattern):
            with suppress(OSError):
                path.unlink()


def _write_psf(folder: Path, name: str, simulation: Simulation) -> None:
    psf = analytic_psf(name)
    if simulation.psf_kind == "moffat":
        if not (path := folder / f"{name}.moffat").exists():
            write_moffat(psf, path)
    elif not (path := folder / f"{name}.fit").exists():
        star = psf.draw(simulation.cell, simulation.oversampling)
        write_image(star, path, oversamp=simulation.oversampling)


def _record(simulation: Simulation) -> dict[str, Any]:
    versions = {name: importlib.metadata.version(name) for name in ("galsim", "numpy")}
    return {
        "creator": "fdnt_xp",
        "parameters": asdict(simulation),
        "versions": {"fdnt_xp": fdnt_xp.__version__, **versions},
    }


def _check_same(path: Path, simulation: Simulation) -> None:
    """Refuse to go on with another simulation; warn of other versions."""
    try:
        begun = json.loads(path.read_text(encoding="utf-8"))
        parameters, versions = dict(begun["parameters"]), dict(begun["versions"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise CatalogError(f"cannot read {path}, which says what was begun here") from error
    now = _record(simulation)
    names = [*now["parameters"], *(parameters.keys() - now["parameters"].keys())]
    changed = [
        f"{name} = {parameters.get(name)} (now {now['parameters'].get(name)})"
        for name in names
        if parameters.get(name) != now["parameters"].get(name)
    ]
    if changed:
        raise CatalogError(
            f"{path.parent} was begun with other parameters: {', '.join(changed)}; choose "
            "another folder, or go on with the same"
        )
    if versions != now["versions"]:
        was, is_ = (
            ", ".join(f"{k} {v}" for k, v in one.items()) for one in (versions, now["versions"])
        )
        warnings.warn(
            f"the first sets were drawn with {was}, the others will be with {is_}",
            FdntWarning,
            stacklevel=3,
        )


def _image_path(folder: Path, number: int) -> Path:
    return folder / f"{set_name(number)}.fit"


def _write_text(path: Path, text: str) -> None:
    with new_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
