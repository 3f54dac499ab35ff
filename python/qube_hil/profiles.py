"""Profiles of identified Qubes, as the arguments ``profile`` and ``spread`` name them."""

import math
import os
from numbers import Real
from typing import Any

from .errors import SettingsError
from .identification import Identified

_SPREAD = 0.1
"""Spread without the argument, that of the command ``train``."""


def around(
    profile: str | os.PathLike[str] | Identified | None, spread: float | None
) -> dict[str, Any] | None:
    """The arguments ``profile`` and ``spread`` for the compiled part; None without a profile."""
    if profile is None:
        if spread is not None:
            raise SettingsError(f"spread = {spread!r} without profile: give profile too, or no spread")
        return None
    given: Any = _SPREAD if spread is None else spread
    if not isinstance(given, Real) or math.isnan(given) or not 0 <= given <= 1:
        raise SettingsError(f"spread = {spread!r}: give a number from 0 to 1")
    if isinstance(profile, Identified):
        return {"path": None, "text": profile.profile, "spread": float(given)}
    if isinstance(profile, (str, os.PathLike)):
        return {"path": os.fspath(profile), "text": None, "spread": float(given)}
    raise SettingsError(
        f"profile = {profile!r}: give the path of a profile, lab, ideal, or the result of identify"
    )
