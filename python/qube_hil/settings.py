"""Settings of a simulation, which are those of the program's files, and checks of arguments."""

import json
import math
import os
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from .errors import SettingsError


def as_text(name: str, value: object, wanted: str) -> str:
    """An argument that is a text; ``wanted`` says what it names."""
    if isinstance(value, str):
        return value
    raise SettingsError(f"{name} = {value!r}: give {wanted}")


def as_texts(name: str, values: object, wanted: str) -> list[str]:
    """An argument that lists texts or paths; ``wanted`` says what they are."""
    if isinstance(values, Iterable) and not isinstance(values, (bytes, bytearray)):
        listed = list(values)
        if all(isinstance(one, (str, os.PathLike)) for one in listed):
            return [os.fspath(one) for one in listed]
    raise SettingsError(f"{name} = {values!r}: give {wanted}")


def as_model(model: object) -> str | None:
    """The argument ``model``."""
    if model is None:
        return None
    return as_text("model", model, "nominal, handcrafted, nominal-handcrafted or robust")


def refuse_options(options: object, remedy: str) -> None:
    """Refuses options of ``reset``, of which there are none; ``remedy`` says what to do instead."""
    if options:
        raise SettingsError(f"options = {options!r}: reset takes none. {remedy}")


def _not_finite(value: object, name: str) -> str | None:
    """The name and value of the first number that is not finite, below the entry ``name``."""
    if isinstance(value, (np.generic, np.ndarray)):
        value = value.tolist()
    if isinstance(value, float):
        return None if math.isfinite(value) else f"{name} = {value}"
    if isinstance(value, Mapping):
        parts = [(f"{name}.{key}" if name else str(key), part) for key, part in value.items()]
    elif isinstance(value, (list, tuple)):
        parts = [(f"{name}[{index}]", part) for index, part in enumerate(value)]
    else:
        parts = []
    found = (_not_finite(part, whose) for whose, part in parts)
    return next((it for it in found if it is not None), None)


def as_json(settings: object, whose: str) -> str:
    """Settings as JSON, in which numbers and arrays of numpy count as Python's own."""

    def plain(value: object) -> object:
        if isinstance(value, (np.generic, np.ndarray)):
            return value.tolist()
        if isinstance(value, Mapping):
            return dict(value)
        raise TypeError(f"{value!r} is no number, text, list or mapping")

    try:
        found = _not_finite(settings, "")
        if found is not None:
            raise SettingsError(f"{whose}: {found}: give a finite number")
        return json.dumps(settings, allow_nan=False, default=plain)
    except (TypeError, ValueError, RecursionError) as error:
        if isinstance(error, SettingsError):
            raise
        raise SettingsError(f"{whose} cannot be written as JSON: {error}") from error


def written(settings: str | Mapping[str, Any], argument: str) -> str:
    """The settings as JSON. A name stands for settings of the program. ``thesis``: true states, and
    a box of 2.3 rad for the arm. ``machine``: encoders, and the velocity filter that runs on the
    machine. ``robust``: as ``machine``, with the last two commands in the observation and a box of
    1.7 rad, for policies that are to run on a Qube. ``argument`` is the name of the argument."""
    if not isinstance(settings, (str, Mapping)):
        raise SettingsError(f"{argument} = {settings!r}: give thesis, machine, robust, or a mapping")
    return as_json(settings if isinstance(settings, str) else dict(settings), argument)
