"""Refuse arrays that are born on whatever device and dtype happen to be the default.

Usage: python tools/check_devices.py PATH...

Every call `xp.zeros(...)`, `xp.fft.fftfreq(...)`, ... must pass `device=` and `dtype=`.
`xp.asarray` keeps the dtype of what it is given, so there `dtype=` is asked for only where
that is a literal. A line that is right all the same says why: `# default device: reason`.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from pathlib import Path

CREATORS = {"arange", "asarray", "empty", "eye", "full", "linspace", "ones", "zeros"}
CREATORS |= {"fftfreq", "rfftfreq"}
EXEMPTION = "# default device:"


def missing_keywords(call: ast.Call) -> set[str]:
    """Return which of `device` and `dtype` a creation call lacks; nothing for other calls."""
    if not (isinstance(call.func, ast.Attribute) and call.func.attr in CREATORS):
        return set()
    owner = ast.unparse(call.func.value)
    if owner.removesuffix(".fft").rpartition(".")[2] != "xp":
        return set()
    given = {keyword.arg for keyword in call.keywords}
    if None in given:  # **keywords
        return set()
    needed = {"device", "dtype"}
    if call.func.attr == "asarray" and call.args:
        literal = isinstance(call.args[0], ast.Constant | ast.List | ast.Tuple | ast.UnaryOp)
        needed = needed if literal else {"device"}
    return {name for name in needed if name not in given}


def check(path: Path) -> Iterator[str]:
    """Yield a message for each creation call of a file that lacks a keyword."""
    source = path.read_text(encoding="utf-8")
    lines = source.splitlines()
    for node in ast.walk(ast.parse(source, str(path))):
        if isinstance(node, ast.Call) and (missing := missing_keywords(node)):
            last = node.end_lineno or node.lineno
            if not any(EXEMPTION in line for line in lines[node.lineno - 1 : last]):
                wanted = " and ".join(f"{name}=" for name in sorted(missing))
                yield f"{path}:{node.lineno}: {ast.unparse(node.func)}(...) without {wanted}"


def main(arguments: list[str]) -> int:
    """Check files and folders; return 1 if anything was found."""
    paths = [Path(argument) for argument in arguments]
    files = [f for path in paths for f in (sorted(path.rglob("*.py")) if path.is_dir() else [path])]
    messages = [message for file in files for message in check(file)]
    print(*messages, sep="\n", end="\n" if messages else "")
    return 1 if messages else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
