"""What is raised is what a caller would catch, says what it must, and survives pickling."""

from __future__ import annotations

import inspect
import pickle

import pytest

from fdnt_xp import errors
from fdnt_xp.errors import (
    CatalogError,
    FdntError,
    FdntTypeError,
    FdntValueError,
    FdntWarning,
    MissingExtraError,
    NamespaceError,
    RangeError,
    ShapeMismatchError,
)

CLASSES = [
    cls
    for _, cls in inspect.getmembers(errors, inspect.isclass)
    if issubclass(cls, Exception) and cls.__module__ == errors.__name__
]


def example(cls: type[Exception]) -> Exception:
    if cls is RangeError:
        return RangeError("gain", 2.0, 0.0, 1.0)
    return cls("what was given, what was expected")


@pytest.mark.parametrize("cls", CLASSES)
def test_every_class_is_documented(cls):
    assert cls.__doc__
    assert cls.__name__ == "FdntError" or f"`{cls.__name__}`" in errors.__doc__


@pytest.mark.parametrize("cls", CLASSES)
def test_every_class_survives_pickling(cls):
    error = example(cls)
    copy = pickle.loads(pickle.dumps(error))
    assert type(copy) is cls
    assert str(copy) == str(error)
    assert copy.__dict__ == error.__dict__


@pytest.mark.parametrize("cls", CLASSES)
def test_every_class_can_be_made_without_its_arguments(cls):
    # As tblib does, with which Dask sends the errors of its workers.
    assert type(cls.__new__(cls)) is cls


@pytest.mark.parametrize("cls", [cls for cls in CLASSES if cls is not FdntWarning])
def test_one_except_clause_catches_all(cls):
    with pytest.raises(FdntError):
        raise example(cls)


@pytest.mark.parametrize(
    ("cls", "builtin"),
    [
        (FdntError, RuntimeError),
        (FdntValueError, ValueError),
        (ShapeMismatchError, ValueError),
        (RangeError, ValueError),
        (FdntTypeError, TypeError),
        (NamespaceError, TypeError),
        (CatalogError, OSError),
        (MissingExtraError, ImportError),
        (FdntWarning, UserWarning),
    ],
)
def test_each_is_the_builtin_that_one_would_catch(cls, builtin):
    assert issubclass(cls, builtin)


def test_a_warning_is_no_error():
    assert not issubclass(FdntWarning, FdntError)


@pytest.mark.parametrize(
    ("minimum", "maximum", "interval"),
    [(0.0, 1.0, "[0, 1]"), (None, 1.0, "[-inf, 1]"), (0.0, None, "[0, inf]")],
)
def test_a_range_error_names_argument_value_and_interval(minimum, maximum, interval):
    error = RangeError("gain", 1.5, minimum, maximum)
    assert str(error) == f"gain = 1.5 is outside the allowed range {interval}"
    assert (error.name, error.value) == ("gain", 1.5)
    assert (error.minimum, error.maximum) == (minimum, maximum)
