"""Peak memory of `fdnt-xp measure` against the number of stamps.

    python benchmarks/catalog_memory.py --stamps 50000,200000 [--jobs 2] [--suffix .fits]

Draws a cube of GREAT08's galaxies, a few hundred of them over and over with new noise, writes
it piece by piece, measures it by the command line in a process of its own, and prints what the
kernel says that process (or the largest of its own processes) had in memory at most, mapped
files included.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from astropy.io import fits

from fdnt_xp.data.catalog import read_catalog
from fdnt_xp.data.simulate import great08_image
from fdnt_xp.data.stamps import grid_stamps

CELL = 32
DIFFERENT = 256
SIGMA_OF_NOISE = 1000.0


def draw_cube(path: Path, psf_path: Path, n_gal: int) -> None:
    """Write a cube of `n_gal` stamps and its PSF; memory is that of a thousand."""
    drawn = great08_image(n_x=16, n_y=DIFFERENT // 16, cell=CELL, snr=None, seed=1)
    stamps = grid_stamps(drawn.image, CELL).read(0, DIFFERENT).stamps
    fits.PrimaryHDU(drawn.psf_image).writeto(psf_path)
    header = fits.PrimaryHDU(np.zeros((1, CELL, CELL), dtype="f4")).header
    header["NAXIS3"] = n_gal
    cube = fits.StreamingHDU(str(path), header)
    rng = np.random.default_rng(2)
    for start in range(0, n_gal, 1000):
        rows = np.arange(start, min(start + 1000, n_gal)) % DIFFERENT
        noise = SIGMA_OF_NOISE * rng.standard_normal((len(rows), CELL, CELL))
        cube.write((stamps[rows] + noise).astype(">f4"))
    cube.close()


def measure(folder: Path, n_gal: int, suffix: str, jobs: int) -> None:
    """Measure a cube, and print a line about it."""
    cube, psf, output = (folder / name for name in ("cube.fits", "psf.fits", f"out{suffix}"))
    draw_cube(cube, psf, n_gal)
    command = [sys.executable, "-c", "from fdnt_xp.app.cli import main; main()", "measure"]
    command += [str(cube), "--psf", str(psf), "-o", str(output), "--jobs", str(jobs), "--overwrite"]
    pid = os.fork()
    if pid == 0:  # so that the largest of the children is that of this measurement alone
        start = time.perf_counter()
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        seconds = time.perf_counter() - start
        peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
        size = cube.stat().st_size / 2**20
        n_measured = int(np.sum(np.isfinite(read_catalog(output)["eta1"])))
        print(
            f"{n_gal:>9} stamps, {size:>6.0f} MiB of pixels, {jobs} jobs, {suffix}: peak "
            f"{peak:.0f} MiB, {seconds:.0f} s, {n_measured} measured",
            flush=True,
        )
        os._exit(0)
    _, status = os.waitpid(pid, 0)
    if status:
        raise SystemExit(1)
    for file in (cube, psf, output):
        file.unlink()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--stamps", default="50000,200000")
    parser.add_argument("--suffix", default=".fits")
    parser.add_argument("--jobs", type=int, default=1)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        for n_gal in map(int, options.stamps.split(",")):
            measure(Path(name), n_gal, options.suffix, options.jobs)


if __name__ == "__main__":
    main()
