"""Write the tables and the figure of docs/benchmarks.md, each whole or not at all.

python benchmarks/write_tables.py               # all, half an hour of a quiet core
python benchmarks/write_tables.py peers bench   # those whose names begin so
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import click

from fdnt_xp.data.files import new_file
from fdnt_xp.errors import FdntError

HERE = Path(__file__).parent
DOCS = HERE.parent / "docs"
FDNT_XP = ("-c", "from fdnt_xp.app.cli import main; main()")
BENCH = (*FDNT_XP, "bench", "--markdown")
FIGURE = DOCS / "figures" / "peers.png"
COMMANDS = {
    "bench-numpy": BENCH,
    "bench-torch-float64": (*BENCH, "--backend", "torch"),
    "bench-torch-float32": (*BENCH, "--backend", "torch", "--dtype", "float32"),
    "bench-torch-float64-two-threads": (*BENCH, "--backend", "torch", "--threads", "2"),
    "bench-torch-float32-two-threads": (
        *(*BENCH, "--backend", "torch", "--dtype", "float32", "--threads", "2"),
    ),
    "peers": (
        *("benchmarks/peers.py", "--markdown", "--snr", "200,20"),
        *("--plot", str(FIGURE), "--overwrite"),
    ),
    "roofline": ("benchmarks/roofline.py", "--markdown"),
    "scaling": ("benchmarks/scaling.py", "--markdown", "--largest", "1000000"),
}
"""Arguments of Python, by the name of the table. Two threads are timed by the wall clock: on a
machine that does anything else they say nothing, and docs/benchmarks.md leaves them out."""
TIMED = {"kernels": "test_bench_kernels.py", "shapes": "test_bench_shapes.py"}
"""Files of pytest-benchmark, by the name of the table."""


def main() -> None:
    wanted = tuple(sys.argv[1:]) or ("",)
    names = [name for name in (*COMMANDS, *TIMED) if name.startswith(wanted)]
    if not names:
        raise FdntError(f"no table {' '.join(wanted)}; known are {', '.join((*COMMANDS, *TIMED))}")
    for name in names:
        text = run(*COMMANDS[name]) if name in COMMANDS else timed(TIMED[name])
        with new_file(DOCS / "tables" / f"{name}.md", overwrite=True) as temporary:
            temporary.write_text(text, encoding="utf-8")
        click.echo(f"written    docs/tables/{name}.md")


def run(*arguments: str) -> str:
    """Return what Python prints."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    if "--threads" in arguments:
        del environment["OMP_NUM_THREADS"]
    done = subprocess.run(
        [sys.executable, *arguments],
        cwd=HERE.parent,
        env=environment,
        check=True,
        stdout=subprocess.PIPE,
        text=True,
    )
    return done.stdout


def timed(file: str) -> str:
    """Return the tables of a file of benchmarks."""
    with tempfile.TemporaryDirectory() as folder:
        path = str(Path(folder) / "bench.json")
        run(
            *("-m", "pytest", "--quiet", f"benchmarks/{file}", "--benchmark-only"),
            *("--benchmark-timer=time.process_time", f"--benchmark-json={path}"),
        )
        return run("benchmarks/tables.py", path)


if __name__ == "__main__":
    main()
