"""Arrays and files with something wrong about them, and what a command must make of them."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
from click.testing import CliRunner
from hypothesis import strategies as st

from fdnt_xp.app.cli import main

_ODD = st.sampled_from([np.nan, np.inf, -np.inf, 0.0, -1.0, 1e308, -1e308, 1e30, 1e-320])
_ODD_WHOLE = st.sampled_from([-1, 0, 7, 10**9, -(2**63)])


@st.composite
def damaged(draw, array):
    """Return an array with something odd about its values, type or shape, or as it is."""
    array = np.array(array)
    odd = _ODD if array.dtype.kind == "f" else _ODD_WHOLE
    match draw(st.sampled_from(["", "", "value", "value", "scale", "flat", "type", "shape"])):
        case "value":
            array[draw(st.integers(0, len(array) - 1))] = draw(odd)
            array.flat[draw(st.integers(0, array.size - 1))] = draw(odd)
        case "scale":
            array = array * 10.0 ** draw(st.integers(-320, 308))
        case "flat":
            array = np.full_like(array, draw(odd))
        case "type":
            kind = draw(st.sampled_from(["f2", "f4", ">f8", "i4", "u1", "?", "c16", "O", "U5"]))
            array = array.astype(kind)
        case "shape":
            shapes = [array[..., None], array[0], array[:0], array[..., :0], array[..., :3]]
            array = draw(st.sampled_from([*shapes, array.T, array[1:]]))
    return array


@st.composite
def damaged_bytes(draw, content):
    """Return a file cut short, with bytes changed, or something else altogether."""
    match draw(st.sampled_from(["cut", "change", "header", "noise", "empty", "zip"])):
        case "cut":
            return content[: draw(st.integers(0, len(content) - 1))]
        case "change":
            some = bytearray(content)
            for _ in range(draw(st.integers(1, 20))):
                some[draw(st.integers(0, len(some) - 1))] = draw(st.integers(0, 255))
            return bytes(some)
        case "header":
            card = 80 * draw(st.integers(0, 9))
            odd = draw(st.sampled_from([b"NAXIS1  = -5", b"BITPIX  = 7", b"END", b"\xff", b""]))
            return content[:card] + odd.ljust(80) + content[card + 80 :]
        case "noise":
            return draw(st.binary(min_size=1, max_size=400))
        case "zip":
            return gzip.compress(content)[: draw(st.integers(20, 400))]
    return b""


def refused_or_done(arguments, *, refused=None):
    """Run a command: it says in one line what is wrong and leaves nothing, or it is done."""
    before = {file: file.read_bytes() for file in Path().iterdir()}
    result = CliRunner().invoke(main, [str(argument) for argument in arguments])
    assert "Traceback" not in result.output
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    if refused is not None:
        assert (result.exit_code != 0) is refused, result.output
    after = {file: file.is_file() and file.read_bytes() for file in Path().iterdir()}
    if result.exit_code == 0:
        assert set(after) - set(before) <= {Path("out.fits"), Path("nowhere.fits")}
        return
    assert after == before
    lines = [line for line in result.output.splitlines() if line.startswith("Error: ")]
    assert len(lines) == 1, result.output
