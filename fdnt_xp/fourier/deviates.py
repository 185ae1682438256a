"""Random numbers that belong to a galaxy: the same on every library, in any order or batch.

A counter-based generator has no state. The deviate of a galaxy at a Fourier mode is a hash
of (seed, identifier of the galaxy, number of the mode), by Threefry-2x32 with 20 rounds of
Salmon et al. 2011 [1]_, which needs nothing but additions, rotations and exclusive ors of
32-bit words.

References
----------
.. [1] Salmon, Moraes, Dror & Shaw 2011, Parallel random numbers: as easy as 1, 2, 3, SC '11.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from fdnt_xp.arrays import Array, DType, array_namespace, blocks_in_cache

_ROTATIONS: Final = ((13, 15, 26, 6), (17, 29, 16, 24))
_PARITY: Final = 0x1BD11BDA
_GROUPS: Final = 5
"""Of four rounds, each followed by an addition of the key."""
_HALF_TURN: Final = 2.0**31


def unit_deviates(
    identifiers: Array, modes: Array, *, seed: int, dtype: DType
) -> tuple[Array, Array]:
    """Return complex Gaussian deviates of unit power, one for each galaxy and mode.

    Parameters
    ----------
    identifiers : array of int64 or int32, shape (n_gal,)
        Names of the galaxies as numbers; galaxies of one name have the same deviates.
    modes : array of integers, shape (n_k,)
        Numbers of the modes, not negative and below 2³¹.
    seed : int
        Any integer; 64 bits of it are used.
    dtype : dtype
        Of the result.

    Returns
    -------
    re, im : array, shape (n_gal, n_k)
        Independent, of mean 0 and variance 1/2 each. The words behind them are the same to
        the bit on every library; logarithm and cosine differ in their last digit.
    """
    xp = array_namespace(identifiers=identifiers, modes=modes)
    low, high = _words(identifiers)
    key = threefry(_seed_words(seed), (low, high))
    number = xp.astype(modes, xp.int32)[None, :]
    whole = xp.broadcast_to(number, (int(low.shape[0]), int(number.shape[1])))
    parts = []
    for rows in blocks_in_cache(whole):
        words = key[0][rows, None], key[1][rows, None]
        first, second = threefry(words, (number, xp.zeros_like(number)))
        # |z|² is exponential, the angle uniform: Box and Muller's transform.
        radius = xp.sqrt(-xp.log(_fraction(first, dtype)))
        angle = (2.0 * math.pi) * _fraction(second, dtype)
        parts.append((radius * xp.cos(angle), radius * xp.sin(angle)))
    re, im = (xp.concat(part) for part in zip(*parts, strict=True))
    return re, im


def threefry(key: tuple[Array, Array], counter: tuple[Array, Array]) -> tuple[Array, Array]:
    """Return two random words for each key and counter, by Threefry-2x32-20.

    Parameters
    ----------
    key : pair of int32 arrays, or of int
        Words of the key; they broadcast against the counter.
    counter : pair of int32 arrays

    Notes
    -----
    The words are unsigned in the definition. Signed words have the same bits: addition
    wraps on all libraries, and what a right shift drags in from the sign is masked away.
    """
    xp = array_namespace(counter=counter[0])
    parity = _PARITY if isinstance(key[0], int) else xp.full_like(key[0], _PARITY)
    keys = (key[0], key[1], key[0] ^ key[1] ^ parity)
    x0, x1 = counter[0] + keys[0], counter[1] + keys[1]
    for group in range(_GROUPS):
        for bits in _ROTATIONS[group % 2]:
            x0 = x0 + x1
            x1 = (x1 << bits) | ((x1 >> (32 - bits)) & ((1 << bits) - 1))
            x1 = x1 ^ x0
        x0 = x0 + keys[(group + 1) % 3]
        x1 = x1 + keys[(group + 2) % 3] + (group + 1)
    return x0, x1


def _seed_words(seed: int) -> tuple[int, int]:
    """Return the low and the high word of a seed, as signed numbers."""
    low, high = (int(np.uint32(seed >> shift & 0xFFFFFFFF).view(np.int32)) for shift in (0, 32))
    return low, high


def _words(number: Array) -> tuple[Array, Array]:
    """Return the low and the high 32 bits of whole numbers, as int32."""
    xp = array_namespace(number=number)
    if number.dtype == xp.int32:  # all that JAX has without float64
        return number, number >> 31
    high = number >> 32
    low = number & 0xFFFFFFFF
    low = xp.where(low >= 1 << 31, low - (1 << 32), low)
    return xp.astype(low, xp.int32), xp.astype(high, xp.int32)


def _fraction(word: Array, dtype: DType) -> Array:
    """Return a word as a number in (0, 1]."""
    xp = array_namespace(word=word)
    fraction = (xp.astype(word, dtype) + (_HALF_TURN + 0.5)) * (0.5 / _HALF_TURN)
    # In float32 the least one would round to 0, whose logarithm is no number.
    return xp.maximum(fraction, xp.full_like(fraction, 0.25 / _HALF_TURN))
