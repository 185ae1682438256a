"""Exceptions and warnings, and when each is raised.

The rule of the house: **raise for the caller's mistake, flag for the galaxy's fault.**
A call that cannot mean anything (wrong rank, mixed libraries, a PSF of zero) raises one
of the classes below, and the message says what was given, what was expected, and which
argument. A galaxy that cannot be measured (NaN pixels, no flux, no root) never raises:
its row is NaN and its flags say why (`fdnt_xp.flags`).

=====================  ==========================================================
class                  raise it when
=====================  ==========================================================
`FdntValueError`       a value is outside what the argument may hold
`RangeError`           the value is a number outside a known interval
`ShapeMismatchError`   an array has the wrong rank or does not fit its companions
`FdntTypeError`        an argument is of the wrong type altogether
`NamespaceError`       arrays of two libraries, dtypes or devices are mixed
`CatalogError`         a file cannot be read, understood, or written
`MissingExtraError`    an optional package is needed and absent
`FdntWarning`          the result stands but the caller should know something
=====================  ==========================================================

Every class inherits `FdntError` and the built-in that a caller would catch anyway.
"""

from __future__ import annotations


class FdntError(RuntimeError):
    """Base class of everything that `fdnt_xp` raises on purpose."""


class FdntValueError(FdntError, ValueError):
    """An argument has the right type but a value that cannot be used."""


class FdntTypeError(FdntError, TypeError):
    """An argument is of a type that cannot be used."""


class ShapeMismatchError(FdntValueError):
    """An array has the wrong rank, or a shape that does not fit its companions."""


class NamespaceError(FdntTypeError):
    """Arrays of different libraries, dtypes or devices were mixed in one call."""


class RangeError(FdntValueError):
    """A number lies outside the interval that the argument allows.

    Parameters
    ----------
    name : str
        The argument.
    value : float
        What was given.
    minimum, maximum : float or None
        The interval; None where it is open.
    """

    def __init__(
        self, name: str, value: float, minimum: float | None, maximum: float | None
    ) -> None:
        self.name, self.value, self.minimum, self.maximum = name, value, minimum, maximum
        low = "-inf" if minimum is None else f"{minimum:g}"
        high = "inf" if maximum is None else f"{maximum:g}"
        super().__init__(f"{name} = {value:g} is outside the allowed range [{low}, {high}]")

    def __reduce__(self) -> tuple[object, ...]:
        """Pickle by the constructor's arguments (exceptions cross process borders)."""
        return (type(self), (self.name, self.value, self.minimum, self.maximum))


class CatalogError(OSError, FdntError):
    """A file could not be read, understood, or written."""

    # OSError comes first for its `__new__`, by which clusters bring errors home.


class MissingExtraError(FdntError, ImportError):
    """An optional package is needed for what was asked, and is not installed."""


class FdntWarning(UserWarning):
    """The result stands, but the caller should know something about it."""
