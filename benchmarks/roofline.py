"""Operations and bytes that a galaxy costs, counted, and where the time goes, by profilers.

    python benchmarks/roofline.py
    python benchmarks/roofline.py --markdown

torch tells the shape of every operation that `measure_shapes` asks for; NumPy does the same
ones. An operation counts as it is commonly counted: 2 m n k for a matrix product, 2.5 N log2 N
for the transform of N real numbers, one for each number that comes out of anything else, an
exponential or a sine included. Its bytes are those of its arguments and results, wherever they
come from. Times are torch's own profile of the same call, on one thread in float64; the second
table is Python's profile of NumPy.
"""

from __future__ import annotations

import argparse
import cProfile
import math
import os
import pstats
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import click
import numpy as np
import torch
from torch.profiler import ProfilerActivity, profile
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

import fdnt_xp as fx
from fdnt_xp.app.backends import load_backend
from fdnt_xp.app.bench import fft_of
from fdnt_xp.app.bench_stamps import BenchStamps, make_stamps

KINDS = {
    "transform": ("_fft",),
    "matrix product": ("mm", "bmm", "matmul", "addmm", "dot", "mv"),
    "exponential, sine": ("exp", "sin", "cos", "log", "polar", "sgn", "sqrt", "pow", "atanh"),
    "gather": ("index", "index_select", "gather", "take", "searchsorted"),
    "copy, join": ("cat", "copy_", "clone", "_to_copy", "stack", "zeros", "fill_", "view_as_real"),
    "views, allocation": (
        *("view", "reshape", "slice", "select", "expand", "unsqueeze", "squeeze", "as_strided"),
        *("empty", "empty_like", "empty_strided", "permute", "transpose", "t", "resize_", "real"),
        *("imag", "view_as_complex", "_reshape_alias", "lift_fresh", "detach", "alias", "narrow"),
        *("result_type", "resolve_conj", "resolve_neg", "unbind", "split", "item", "to"),
    ),
    "sum, extreme, sort": ("sum", "amax", "amin", "max", "min", "all", "any", "sort", "mean"),
}
DEVICE_BANDWIDTH = 4.8e12
"""Of an H200, by its data sheet, bytes per second."""
SHOWN = 14
"""Functions of Python's profile."""
REST = "arithmetic"
"""Kinds of operations by their names in torch; what is in none is arithmetic."""


def kind_of(name: str) -> str:
    for kind, names in KINDS.items():
        if any(name == one or (one.startswith("_fft") and name.startswith(one)) for one in names):
            return kind
    return REST


@dataclass(kw_only=True)
class Count:
    """What one kind of operation took, of all galaxies."""

    calls: int = 0
    operations: float = 0.0
    bytes: float = 0.0
    seconds: float = 0.0


class Counting(TorchDispatchMode):
    """Counts the operations that run inside, and the bytes they read and write."""

    def __init__(self) -> None:
        super().__init__()
        self.counts: dict[str, Count] = defaultdict(Count)

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        out = func(*args, **(kwargs or {}))
        name = func.overloadpacket.__name__
        read, written = tensors(args), tensors(out)
        if kind_of(name) != "views, allocation" and not is_view(name, read, written):
            count = self.counts[kind_of(name)]
            count.calls += 1
            count.bytes += sum(map(n_bytes, [*read, *written]))
            count.operations += operations(name, read, written)
        return out


def tensors(tree: object) -> list[torch.Tensor]:
    return [leaf for leaf in tree_leaves(tree) if isinstance(leaf, torch.Tensor)]


def is_view(name: str, read: list[torch.Tensor], written: list[torch.Tensor]) -> bool:
    """Return whether nothing was computed, as when an array is reshaped."""
    known = {tensor.untyped_storage().data_ptr() for tensor in read if tensor.numel()}
    same = all(tensor.untyped_storage().data_ptr() in known for tensor in written)
    return same and not name.endswith("_")


def n_bytes(tensor: torch.Tensor) -> int:
    return min(tensor.numel() * tensor.element_size(), tensor.untyped_storage().nbytes())


def operations(name: str, read: list[torch.Tensor], written: list[torch.Tensor]) -> float:
    n_out = float(sum(tensor.numel() for tensor in written))
    kind = kind_of(name)
    if kind == "transform":
        n_one = math.prod(read[0].shape[-2:])
        return 2.5 * read[0].numel() * math.log2(n_one)
    if kind == "matrix product":
        return 2.0 * n_out * read[0].shape[-1]
    if kind in ("gather", "copy, join"):
        return 0.0
    if kind == "sum, extreme, sort":
        return float(read[0].numel())
    return n_out


def counted(call: Callable[[], object]) -> dict[str, Count]:
    """Count a call, then profile it."""
    call()
    with Counting() as counting:
        call()
    with profile(activities=[ProfilerActivity.CPU]) as profiled:
        call()
    for event in profiled.key_averages():
        name = event.key.removeprefix("aten::")
        counting.counts[kind_of(name)].seconds += 1e-6 * event.self_cpu_time_total
    return counting.counts


def roofs() -> dict[str, float]:
    """Return what the machine can do on one thread, each the best of several runs, per second."""
    large = torch.zeros(2**25, dtype=torch.float64)
    small = torch.ones(2**13, dtype=torch.float64)
    square = torch.ones((512, 512), dtype=torch.float64)
    out_large, out_small, out_square = (torch.empty_like(one) for one in (large, small, square))
    copied = 16.0 * large.numel() / best(lambda: out_large.copy_(large), 5)
    product = 2.0 * 512**3 / best(lambda: torch.mm(square, square, out=out_square), 20)
    times = small.numel() / best(lambda: torch.mul(small, small, out=out_small), 2000)
    exponential = small.numel() / best(lambda: torch.exp(small, out=out_small), 2000)
    return {
        "memory, GB/s copied": 1e-9 * copied,
        "matrix product, Gflop/s": 1e-9 * product,
        "arithmetic in cache, 10⁹/s": 1e-9 * times,
        "exponentials in cache, 10⁹/s": 1e-9 * exponential,
    }


def best(call: Callable[[], object], repeats: int) -> float:
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return min(times)


def by_function(stamps: BenchStamps) -> list[tuple[str, float]]:
    """Return the share of NumPy's time in each function, with what it calls of NumPy itself."""
    psf = fx.Psf.from_image(stamps.star)
    run = lambda: fx.measure_shapes(stamps.pixels, psf, noise_variance=stamps.variance)  # noqa: E731
    run()
    profiler = cProfile.Profile(time.process_time)
    profiler.runcall(run)
    stats = pstats.Stats(profiler).stats
    whole = sum(own for _, _, own, _, _ in stats.values())
    home = Path(fx.__file__).parent
    shares: dict[str, float] = defaultdict(float)
    for (file, _, name), (_, _, own, _, callers) in stats.items():
        if str(home) in file:
            shares[f"{Path(file).relative_to(home).with_suffix('')}.{name}"] += own
        for (caller, _, caller_name), (_, _, _, with_all) in callers.items():
            if str(home) in caller and str(home) not in file:
                where = Path(caller).relative_to(home).with_suffix("")
                shares[f"{where}.{caller_name}"] += with_all
    return sorted(((n, t / whole) for n, t in shares.items()), key=lambda pair: -pair[1])


def lines(stamps: BenchStamps, *, markdown: bool) -> Iterator[str]:
    n_gal = len(stamps.pixels)
    backend = load_backend("torch")
    torch.set_num_threads(1)
    pixels, psf = (
        backend.from_numpy(stamps.pixels),
        fx.Psf.from_image(backend.from_numpy(stamps.star)),
    )
    shapes = fx.measure_shapes(pixels, psf, noise_variance=stamps.variance)
    counts = counted(lambda: fx.measure_shapes(pixels, psf, noise_variance=stamps.variance))
    floor = counted(fft_of(pixels, backend, 1))["transform"]
    whole = Count(
        calls=sum(c.calls for c in counts.values()),
        operations=sum(c.operations for c in counts.values()),
        bytes=sum(c.bytes for c in counts.values()),
        seconds=sum(c.seconds for c in counts.values()),
    )
    size = stamps.pixels.shape[-1]
    yield (
        f"{n_gal} galaxies, {size} x {size} pixels, float64, "
        f"{float(np.mean(shapes.n_iter.numpy())):.1f} evaluations of the tests in the mean"
    )
    yield ""
    heads = ("kind", "operations a galaxy", "kB a galaxy", "µs a galaxy", "10⁹ op/s", "GB/s")
    yield from table_head(heads, markdown=markdown)
    named = sorted(counts.items(), key=lambda pair: -pair[1].seconds)
    for name, count in [("the FFT alone", floor), *named, ("all", whole)]:
        per_second = max(count.seconds, 1e-12)
        cells = (
            name,
            f"{count.operations / n_gal:,.0f}",
            f"{1e-3 * count.bytes / n_gal:,.0f}",
            f"{1e6 * count.seconds / n_gal:.1f}",
            f"{1e-9 * count.operations / per_second:.2f}",
            f"{1e-9 * count.bytes / per_second:.1f}",
        )
        yield table_row(cells, markdown=markdown)
    yield ""
    yield device_line(whole.bytes / n_gal)
    yield ""
    yield from table_head(("what the machine can do, one thread", ""), markdown=markdown)
    for name, rate in roofs().items():
        yield table_row((name, f"{rate:.3g}"), markdown=markdown)
    yield ""
    yield from table_head(("function, NumPy", "share"), markdown=markdown)
    shares = by_function(stamps)
    for name, share in shares[:SHOWN]:
        yield table_row((f"`{name}`", f"{share:.1%}"), markdown=markdown)
    rest = sum(share for _, share in shares[SHOWN:])
    yield table_row((f"{len(shares) - SHOWN} others", f"{rest:.1%}"), markdown=markdown)


def device_line(bytes_each: float) -> str:
    rate = int(float(f"{DEVICE_BANDWIDTH / bytes_each:.2g}"))
    return (
        "Where each array goes through the memory of a device of "
        f"{DEVICE_BANDWIDTH / 1e12:g} TB/s, "
        f"these bytes bound it to {rate:,} galaxies/s; float32 halves them."
    )


def table_head(cells: tuple[str, ...], *, markdown: bool) -> Iterator[str]:
    yield table_row(cells, markdown=markdown)
    if markdown:
        yield "|---" * len(cells) + "|"


def table_row(cells: tuple[str, ...], *, markdown: bool) -> str:
    if markdown:
        return f"| {' | '.join(cells)} |"
    return f"{cells[0]:<46}" + "".join(f"{cell:>21}" for cell in cells[1:])


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--n", type=int, default=1024, help="galaxies")
    parser.add_argument("--stamp-size", type=int, default=48)
    parser.add_argument("--snr", type=float, default=200.0)
    parser.add_argument("--markdown", action="store_true", help="print tables for the docs")
    options = parser.parse_args()
    stamps = make_stamps(options.n, options.stamp_size, options.snr)
    for line in lines(stamps, markdown=options.markdown):
        click.echo(line)


if __name__ == "__main__":
    main()
