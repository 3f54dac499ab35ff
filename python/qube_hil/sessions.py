"""Sessions: candidates, returns, and the surrogate."""

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from . import _core
from .errors import SettingsError
from .settings import as_path, shown

Float64s = npt.NDArray[np.float64]

#: Description of the argument ``folder`` in messages.
_FOLDER = "the path of a session's folder"


@dataclass(frozen=True)
class Candidate:
    """A candidate of a session."""

    number: int
    """Number, in the order of the proposals."""
    purpose: str
    """Reason of the proposal."""
    psi: dict[str, float]
    """Its distribution parameters by name; empty for a candidate without any."""
    returns: list[float | None]
    """Return of each finished rollout; None where it has no result."""
    successes: int
    """Number of successful rollouts."""
    mean_return: float | None
    """Mean of the returns; None without any."""
    policy: Path | None
    """File of its policy; None before it is trained."""
    recordings: list[Path]
    """Recordings of the finished rollouts, in the order of ``returns``."""


class Surrogate:
    """The surrogate of a session: the Gaussian process of its report, fitted over psi to the mean returns of the
    candidates that the search has evaluated."""

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        """Fits the surrogate of the session in this folder. Callers use `Session.surrogate`."""
        self._core = _core.Surrogate(as_path("folder", folder, _FOLDER))
        #: Lower and upper end of each entry of psi, by name, in the order of the coordinates.
        self.ranges: dict[str, tuple[float, float]] = {
            name: (lower, upper) for name, lower, upper in self._core.ranges
        }
        #: The psi that the search recommends.
        self.recommended_psi: dict[str, float] = dict(
            zip(self.ranges, self._core.best, strict=True)
        )

    def posterior(
        self, psi: Mapping[str, npt.ArrayLike] | npt.ArrayLike
    ) -> tuple[Float64s, Float64s]:
        """Mean and standard deviation of the expected return, ``float64 [n]`` each.

        Args:
            psi: Points ``[n, entries]`` with the entries in the order of ``ranges``, or numbers or arrays ``[n]`` by name;
                a name that is left out stands for its entry of ``recommended_psi``. Points may lie outside of the ranges; one
                so far away that its return is no finite number raises a `SettingsError`.
        """
        if isinstance(psi, Mapping):
            unknown = [name for name in psi if name not in self.ranges]
            if unknown:
                known = ", ".join(self.ranges)
                raise SettingsError(f"psi has no entry {shown(unknown[0])}: give some of {known}")
            psi = self._points({**self.recommended_psi, **psi})
        try:
            points = np.atleast_2d(np.asarray(psi, np.float64))
        except (TypeError, ValueError) as error:
            raise SettingsError(f"the points are not an array of numbers: {error}") from error
        if points.ndim != 2:
            raise SettingsError(f"the points have the shape {points.shape}: give [n, entries]")
        means, deviations = self._core.posterior(points)
        return means, deviations

    def _points(self, psi: Mapping[str, Any]) -> Float64s:
        try:
            columns = np.broadcast_arrays(*(np.asarray(psi[name], np.float64) for name in self.ranges))
        except (TypeError, ValueError) as error:
            raise SettingsError(
                f"psi: give a number or an array [n] for each entry, all arrays of one length: {error}"
            ) from error
        return np.stack([np.atleast_1d(column) for column in columns], axis=1)


class Session:
    """The results in a session's folder. The folder is only read, so that a running session may be using it."""

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        path = as_path("folder", folder, _FOLDER)
        self.folder = Path(path)
        read = json.loads(_core.read_session(path))
        #: Names of psi, in the order of the search space.
        self.psi_names: list[str] = read["psi"]
        #: Candidates in order.
        self.candidates: list[Candidate] = [self._candidate(it) for it in read["candidates"]]
        best = read["recommended"]
        #: The best verified candidate, whose policy is the one to use: the highest mean return, but candidates whose rollouts
        #: all succeeded quietly come before all others. None if none is verified.
        self.recommended: Candidate | None = None if best is None else self.candidates[best]

    def surrogate(self) -> Surrogate:
        """Fits the surrogate to the returns that are in the folder now. Needs three candidates with rollouts."""
        return Surrogate(self.folder)

    def _candidate(self, read: dict[str, Any]) -> Candidate:
        policy, psi = read["policy"], read["psi"]
        return Candidate(
            number=read["number"],
            purpose=read["purpose"],
            psi=dict(zip(self.psi_names, psi, strict=True)) if psi else {},
            returns=read["returns"],
            successes=read["successes"],
            mean_return=read["mean_return"],
            policy=None if policy is None else self.folder / policy,
            recordings=[self.folder / path for path in read["recordings"]],
        )

    def __repr__(self) -> str:
        return f"<qube_hil.Session {self.folder}: {len(self.candidates)} candidates>"
