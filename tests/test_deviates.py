"""The counter-based generator: published words, the same numbers everywhere, Gaussian."""

from __future__ import annotations

import numpy as np
import pytest
from array_api_extra.testing import assert_close, assert_equal
from scipy import stats

from fdnt_xp.fourier.deviates import threefry, unit_deviates

# Threefry-2x32, 20 rounds: the known answers that its authors distribute (Random123,
# kat_vectors); counter, key, result.
KNOWN = [
    ((0x00000000, 0x00000000), (0x00000000, 0x00000000), (0x6B200159, 0x99BA4EFE)),
    ((0xFFFFFFFF, 0xFFFFFFFF), (0xFFFFFFFF, 0xFFFFFFFF), (0x1CB996FC, 0xBB002BE7)),
    ((0x243F6A88, 0x85A308D3), (0x13198A2E, 0x03707344), (0xC4923A9C, 0x483DF7A0)),
]


def signed(word):
    return np.array([word], dtype=np.uint32).view(np.int32)


@pytest.mark.parametrize(("counter", "key", "expected"), KNOWN)
def test_the_published_words(counter, key, expected, xp, to_xp):
    words = threefry(
        tuple(to_xp(signed(word)) for word in key), tuple(to_xp(signed(word)) for word in counter)
    )
    for word, wanted in zip(words, expected, strict=True):
        assert_equal(word, to_xp(signed(wanted)), xp=xp)


def test_keys_may_be_plain_numbers(xp, to_xp):
    counter = tuple(to_xp(signed(word)) for word in KNOWN[2][0])
    key = tuple(int(signed(word)[0]) for word in KNOWN[2][1])
    assert_equal(threefry(key, counter)[0], to_xp(signed(KNOWN[2][2][0])), xp=xp)


def draw(xp, to_xp, names, modes, dtype, seed=7):
    return unit_deviates(
        to_xp(np.asarray(names, dtype=np.int64)),
        to_xp(np.asarray(modes, dtype=np.int64)),
        seed=seed,
        dtype=dtype,
    )


def test_every_library_draws_the_same(xp, dtype, to_xp):
    names, modes = [3, -1, 2**40 + 3], [0, 5, 1199]
    host = unit_deviates(np.array(names), np.array(modes), seed=-12345678901, dtype=np.float64)
    ours = draw(xp, to_xp, names, modes, dtype, seed=-12345678901)
    single = "32" in str(dtype)
    for one, wanted in zip(ours, host, strict=True):
        # float32 keeps 24 of the 32 bits of a word.
        assert_close(one, to_xp(wanted, dtype), rtol=0, atol=3e-6 if single else 1e-15, xp=xp)


def test_order_and_batch_change_nothing(xp, dtype, to_xp, to_np):
    re, im = draw(xp, to_xp, [10, 20, 30], [1, 2, 3, 4], dtype)
    again, _ = draw(xp, to_xp, [30], [4, 2], dtype)
    np.testing.assert_array_equal(to_np(again)[0], to_np(re)[2, [3, 1]])
    _, other = draw(xp, to_xp, [20, 10], [1, 2, 3, 4], dtype)
    np.testing.assert_array_equal(to_np(other), to_np(im)[[1, 0]])


def test_names_and_seeds_all_differ():
    modes = np.arange(4)
    names = np.array([0, 1, 2**32, 2**32 + 1, -1, 2**62])
    drawn = [unit_deviates(names, modes, seed=s, dtype=np.float64)[0] for s in (0, 1, -1, 2**32)]
    assert len(np.unique(np.stack(drawn))) == 4 * 6 * 4


def test_they_are_gaussian_and_independent():
    re, im = unit_deviates(np.arange(400), np.arange(500), seed=1, dtype=np.float64)
    z = np.sqrt(2.0) * np.stack([re, im])
    assert stats.kstest(z.ravel(), "norm").pvalue > 1e-3
    n = re.size
    for shifted in (np.roll(z, 1, axis=1), np.roll(z, 1, axis=2), z[::-1]):
        # The mean of n products of unit deviates: 4 standard errors.
        assert abs(np.mean(z * shifted)) < 4.0 / np.sqrt(n)
    power = re**2 + im**2
    assert np.mean(power) == pytest.approx(1.0, abs=4.0 / np.sqrt(n))
    assert np.mean(power**2) == pytest.approx(2.0, abs=4.0 * np.sqrt(20.0 / n))


def test_the_rarest_words_stay_finite(xp, dtype, to_xp, to_np):
    # |z|² = -ln u, and u must not round to 0: a million words come within a few of the end.
    re, im = draw(xp, to_xp, np.arange(1000), np.arange(1000), dtype)
    power = to_np(re) ** 2 + to_np(im) ** 2
    assert np.all(np.isfinite(power))
    assert np.max(power) < 32 * np.log(2.0) + 1.0
