"""Cuts: ranges, soft edges, functions; and clear words for what is no cut."""

from __future__ import annotations

import math

import numpy as np
import pytest
from array_api_extra.testing import assert_close

import fdnt_xp as fx
from fdnt_xp.errors import FdntTypeError, FdntValueError, RangeError, ShapeMismatchError
from fdnt_xp.shears.cuts import FrameQuantities, Selection

SNR = [5.0, 10.0, 20.0, math.nan]
SIZE = [1.0, 2.0, 0.0, 3.0]


@pytest.fixture
def quantities(to_xp, dtype):
    flux = to_xp([1.0, 2.0, 4.0, 8.0], dtype)
    return FrameQuantities(flux=flux, snr=to_xp(SNR, dtype), size=to_xp(SIZE, dtype))


@pytest.mark.parametrize(
    ("cut", "expected"),
    [
        (None, [1, 1, 1, 1]),
        (fx.Cut(quantity="snr", low=10.0), [0, 1, 1, 0]),
        (fx.Cut(quantity="snr", high=10.0), [1, 1, 0, 0]),
        (fx.Cut(quantity="size", low=0.5, high=2.5), [1, 1, 0, 0]),
        ({"snr": (8.0, None), "size": (0.5, None)}, [0, 1, 0, 0]),
        ([fx.Cut(quantity="snr", low=8.0), fx.Cut(quantity="flux", high=3.0)], [0, 1, 0, 0]),
        (lambda q: q.flux / 8.0, [0.125, 0.25, 0.5, 1.0]),
    ],
)
def test_what_each_galaxy_counts(cut, expected, quantities, xp, dtype, to_xp):
    weight = Selection.of(cut).weight(quantities)
    assert_close(weight, to_xp(expected, dtype), rtol=0, atol=0, xp=xp)


def test_a_soft_edge_is_the_logistic_function(quantities, xp, dtype, to_xp):
    cut = fx.Cut(quantity="snr", low=10.0, high=30.0, width=2.0)
    snr = np.array(SNR)
    expected = 1 / (1 + np.exp(-(snr - 10) / 2)) / (1 + np.exp(-(30 - snr) / 2))
    expected[3] = 0.0
    weight = Selection.of(cut).weight(quantities)
    assert_close(weight, to_xp(expected, dtype), rtol=1e-5, atol=0, xp=xp)


def test_what_is_hard_and_what_needs_noise():
    soft, hard = fx.Cut(quantity="flux", low=1.0, width=0.1), fx.Cut(quantity="snr", low=1.0)
    assert not Selection.of(soft).hard
    assert not Selection.of(soft).needs_noise
    assert Selection.of([soft, hard]).hard
    assert Selection.of({"snr": (1.0, None)}).needs_noise
    assert Selection.of(lambda q: q.flux).hard


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"quantity": "mag", "low": 1.0}, FdntValueError, "known are snr, flux, size"),
        ({"quantity": "snr"}, FdntValueError, "needs low, high or both"),
        ({"quantity": "snr", "low": 5.0, "high": 5.0}, FdntValueError, "keeps nothing"),
        ({"quantity": "snr", "low": math.nan}, FdntValueError, "keeps nothing"),
        ({"quantity": "snr", "low": 5.0, "width": -1.0}, RangeError, "width = -1"),
    ],
)
def test_ranges_that_are_none(options, error, message):
    with pytest.raises(error, match=message):
        fx.Cut(**options)


@pytest.mark.parametrize("cut", [3.0, "snr", {"snr": 10.0}, [1, 2]])
def test_what_is_no_cut(cut):
    with pytest.raises(FdntTypeError, match="cut"):
        Selection.of(cut)


@pytest.mark.parametrize("answer", [1.0, np.ones(3)])
def test_a_function_must_answer_for_each_galaxy(answer):
    quantities = FrameQuantities(flux=np.ones(4), snr=np.ones(4), size=np.ones(4))
    with pytest.raises(ShapeMismatchError, match=r"cut must return an array of the shape \(4,\)"):
        Selection.of(lambda _: answer).weight(quantities)
