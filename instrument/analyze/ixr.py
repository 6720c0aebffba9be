"""Intrinsic cross-polarization ratio for a leakage, leakage for an IXR, and what removal of leakage is worth in dB."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np

from instrument.checked import checked
from instrument.errors import InputError
from instrument.units import plain

Kind = Literal["mueller", "jones"]


@checked
def ixr_of_leakage(leakage: Any, kind: Kind = "mueller") -> Any:
    """IXR in dB for a leakage out of I (any shape), a fraction above 0 and up to 1, of a station's Mueller matrix.

    IXR_M is one over the largest leakage; a station of condition number k leaks (k² - 1)/(k² + 1), and its IXR_J is
    ((k + 1)/(k - 1))² (Carozzi & Woan 2011). A small leakage d has IXR_M = 1/d and IXR_J = 4/d².
    """
    d = plain(leakage, float, "leakage")
    if not np.all((d > 0) & (d <= 1)):
        raise InputError(f"leakage = {leakage} must be a fraction above 0 and at most 1: 0.3 % is 0.003")
    # (k+1)/(k-1) of k² = (1+d)/(1-d), without the difference of near numbers
    ratio = 1 / d if kind == "mueller" else ((1 + np.sqrt((1 - d) * (1 + d))) / d) ** 2
    return 10 * np.log10(ratio)


@checked
def leakage_of_ixr(ixr_db: Any, kind: Kind = "mueller") -> Any:
    """Largest leakage out of I, a fraction (any shape), of a station with an IXR in dB; inverse of `ixr_of_leakage`."""
    db = plain(ixr_db, float, "ixr_db")
    if not np.all(db >= 0):
        raise InputError(f"ixr_db = {ixr_db} must be 0 dB or more")
    ratio = 10 ** (db / 10)
    return 1 / ratio if kind == "mueller" else 2 * np.sqrt(ratio) / (1 + ratio)


@checked
def removal_table(ixr_db: float = 25.0, removed: Sequence[float] = (0.0, 0.3, 0.5, 0.7, 0.9, 0.97)) -> Any:
    """What a station of `ixr_db` (IXR_M) is as good as when a share of its leakage is removed: an astropy table.

    The leakage falls by 1 - removed, its power by the square of that. The paper's case: 70 % removed from 25 dB is
    30.2 dB (it prints 35).
    """
    from astropy.table import QTable

    share = np.asarray(removed, float)
    if not np.all((share >= 0) & (share < 1)):
        raise InputError(f"removed = {removed} must be shares from 0 to below 1")
    left = leakage_of_ixr(ixr_db) * (1 - share)
    out = QTable()
    out["removed_percent"], out["leakage_percent"] = 100 * share, 100 * left
    out["power_left"] = (1 - share) ** 2
    out["ixr_m_db"], out["ixr_j_db"] = ixr_of_leakage(left), ixr_of_leakage(left, "jones")
    return out
