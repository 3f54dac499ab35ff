"""Settings of a simulation, which are those of the program's files, and checks of arguments."""

import json
import math
import os
from collections.abc import Iterable, Mapping
from numbers import Real
from typing import Any, TypeGuard

import numpy as np

from .errors import SettingsError


#: Most characters of a refused value in a message.
_LONGEST = 200


def shown(value: object) -> str:
    """A value as messages show it: its beginning if it is long, such as a recording."""
    text = " ".join(repr(value).splitlines())
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}..."


def as_text(name: str, value: object, wanted: str) -> str:
    """An argument that is a text; ``wanted`` describes the accepted texts."""
    if isinstance(value, str):
        return value
    raise SettingsError(f"{name} = {shown(value)}: give {wanted}")


def as_path(name: str, value: object, wanted: str) -> str:
    """An argument that is a path; ``wanted`` describes the accepted paths."""
    path = os.fspath(value) if isinstance(value, (str, os.PathLike)) else value
    return as_text(name, path, wanted)


def as_number(name: str, value: object, wanted: str) -> float:
    """An argument that is a number; ``wanted`` describes the accepted numbers."""
    if isinstance(value, Real) and not isinstance(value, bool):
        try:
            return float(value)
        except OverflowError:
            pass
    raise SettingsError(f"{name} = {shown(value)}: give {wanted}")


def is_whole(value: object) -> TypeGuard[int]:
    """Returns whether an argument is a whole number; `True` and `False` are none."""
    return isinstance(value, (int, np.integer)) and not isinstance(value, bool)


def as_texts(name: str, values: object, wanted: str) -> list[str]:
    """An argument that lists texts or paths; ``wanted`` describes the accepted entries."""
    if isinstance(values, Iterable) and not isinstance(values, (bytes, bytearray, Mapping)):
        listed = list(values)
        if all(isinstance(one, (str, os.PathLike)) for one in listed):
            return [as_path(name, one, wanted) for one in listed]
    raise SettingsError(f"{name} = {shown(values)}: give {wanted}")


def as_model(model: object) -> str | None:
    """The argument ``model``."""
    if model is None:
        return None
    return as_text("model", model, "nominal, handcrafted, nominal-handcrafted or robust")


def refuse_options(options: object, remedy: str) -> None:
    """Refuses options of ``reset``, of which there are none; ``remedy`` names the alternative."""
    if options:
        raise SettingsError(f"options = {shown(options)}: reset takes none. {remedy}")


def _fault(value: object, name: str) -> str | None:
    """The first value below the entry ``name`` that JSON cannot hold, with the accepted values."""
    if isinstance(value, (np.generic, np.ndarray)):
        value = value.tolist()
    if value is None or isinstance(value, (str, int)):
        return None
    if isinstance(value, float):
        return None if math.isfinite(value) else f"{name} = {value}: give a finite number"
    if isinstance(value, Mapping):
        parts = [(f"{name}.{key}" if name else str(key), part) for key, part in value.items()]
    elif isinstance(value, (list, tuple)):
        parts = [(f"{name}[{index}]", part) for index, part in enumerate(value)]
    else:
        return f"{name} = {shown(value)}: give a number, a text, a list or a mapping"
    found = (_fault(part, whose) for whose, part in parts)
    return next((it for it in found if it is not None), None)


def as_json(settings: object, argument: str = "") -> str:
    """Settings as JSON, in which numbers and arrays of numpy count as Python's own. ``argument`` is the name of the
    argument that holds them; without it, each is an argument of its own."""

    def plain(value: object) -> object:
        if isinstance(value, (np.generic, np.ndarray)):
            return value.tolist()
        if isinstance(value, Mapping):
            return dict(value)
        raise TypeError(f"{shown(value)} is no number, text, list or mapping")

    prefix = f"{argument}: " if argument else ""
    try:
        fault = _fault(settings, "")
        if fault is None:
            return json.dumps(settings, allow_nan=False, default=plain)
    except (TypeError, ValueError, RecursionError) as error:
        raise SettingsError(f"{prefix}the values cannot be written as JSON: {error}") from error
    raise SettingsError(f"{prefix}{fault}")


def written(settings: str | Mapping[str, Any], argument: str) -> str:
    """The settings as JSON. A name stands for settings of the program. ``thesis``: true states, and
    a box of 2.3 rad for the arm. ``machine``: encoders, and the velocity filter that runs on a real
    Qube. ``robust``: as ``machine``, with the last two commands in the observation and a box of
    1.7 rad, for policies that are to run on a Qube. ``argument`` is the name of the argument."""
    if not isinstance(settings, (str, Mapping)):
        raise SettingsError(f"{argument} = {shown(settings)}: give thesis, machine, robust, or a mapping")
    return as_json(settings if isinstance(settings, str) else dict(settings), argument)
