"""Selects the function that fills the rows of returns: NumPy or compiled loops."""

from __future__ import annotations

from swath.drivers.extras import how_to_install
from swath.drivers.parser import DriverSettingsError
from swath.drivers.scanner.rows.slots import Fill, ReturnSlots


def filler(*, compiled: bool) -> Fill:
    """Return `ReturnSlots.fill` or its compiled equivalent.

    Raises:
        DriverSettingsError: numba is not installed.
    """
    if not compiled:
        return ReturnSlots.fill
    try:
        from swath.drivers.scanner.rows.compiled import fill
    except ImportError as error:
        raise DriverSettingsError(
            f"compiled decoding needs numba; install with: {how_to_install('process')} ({error})"
        ) from error
    return fill
