"""Every flag is one bit of an int32, with a name, a text, and one side to be on."""

from __future__ import annotations

import re

import pytest

from fdnt_xp import flags
from fdnt_xp.flags import FAILED, INFORMATION, Flag, flag_names, flag_text


@pytest.mark.parametrize("flag", Flag)
def test_a_flag_is_one_bit_of_an_int32(flag):
    assert int(flag).bit_count() == 1
    assert 0 < int(flag) < 2**31


def test_no_two_flags_share_a_bit():
    assert len({int(flag) for flag in Flag}) == len(list(Flag)) == len(Flag.__members__)


@pytest.mark.parametrize("flag", Flag)
def test_every_flag_has_a_text(flag):
    text = flag_text(flag.name)
    assert text
    assert not text.endswith(".")


def test_texts_are_of_flags_that_exist():
    assert set(flags._TEXT) == set(Flag.__members__)
    with pytest.raises(KeyError):
        flag_text("NO_SUCH_FLAG")


@pytest.mark.parametrize("flag", Flag)
def test_a_flag_either_fails_or_informs(flag):
    assert bool(flag & FAILED) != bool(flag & INFORMATION)


def test_masks_are_plain_positive_integers():
    # They are handed to array libraries as Python integers.
    assert 0 < int(INFORMATION) < 2**31
    assert 0 < int(FAILED) < 2**31
    assert int(FAILED) & int(INFORMATION) == 0
    assert int(FAILED) | int(INFORMATION) == sum(int(flag) for flag in Flag)


def test_names_come_lowest_bit_first():
    assert flag_names(0) == []
    for flag in Flag:
        assert flag_names(int(flag)) == [flag.name]
    everything = flag_names(sum(int(flag) for flag in Flag))
    assert [int(Flag[name]) for name in everything] == sorted(int(flag) for flag in Flag)


def test_unknown_bits_are_passed_over():
    assert flag_names((1 << 30) | int(Flag.NO_SIGNAL)) == ["NO_SIGNAL"]


def test_names_are_constants():
    assert all(re.fullmatch(r"[A-Z][A-Z_]+", name) for name in Flag.__members__)
