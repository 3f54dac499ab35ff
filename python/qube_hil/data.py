"""What the program has written: recordings of rollouts, and sessions."""

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy.typing as npt

from . import _core
from .policies import Policy


class Recording(dict[str, npt.NDArray[Any]]):
    """A rollout, one entry a tick: a dictionary of arrays by name, each ``[ticks]``.

    ``pandas.DataFrame(recording)`` and ``polars.DataFrame(recording)`` make tables of it. The columns: ``tick``,
    ``time_s`` (since the first tick), ``phase`` (settling, running or braking), the state that the policy sees
    (``theta_rad``, ``alpha_rad``, ``theta_dot_rad_s``, ``alpha_dot_rad_s``), ``wanted_v``, ``voltage_v`` (sent),
    ``reward`` (0 outside of running), the sample (``has_sample``, ``device_time_s``, ``theta_counts``, ``alpha_counts``,
    ``measured_theta_rad``, ``measured_alpha_rad``, ``tachometer_rad_s``, ``current_a``, ``applied_v``,
    ``sample_to_act_us``), and the timing (``lateness_us``, ``turnaround_us``, ``skipped_periods``). Numbers that a tick
    does not have are NaN.
    """

    header: dict[str, Any]
    """The record before the rollout: device, settings, seed, versions."""
    outcome: dict[str, Any] | None
    """The record after the rollout: ending, steps, latencies; None in a recording that is cut off."""
    return_: float
    """Sum of the rewards."""
    is_whole: bool
    """Whether every byte is as it was written."""
    _policy: bytes

    @property
    def policy(self) -> Policy:
        """The policy that drove the rollout."""
        return Policy.from_bytes(self._policy)


def recording(path: str | os.PathLike[str]) -> Recording:
    """Reads a recording and checks every byte of it."""
    read = _core.read_recording(os.fspath(path))
    made = Recording(read["columns"])
    made.header = json.loads(read["header"])
    made.outcome = None if read["outcome"] is None else json.loads(read["outcome"])
    made.return_ = read["return"]
    made.is_whole = read["whole"]
    made._policy = read["policy"]
    return made


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
    """Mean of the returns."""
    policy: Path | None
    """File of its policy; None before it is trained."""
    recordings: list[Path]
    """Recordings of the finished rollouts, in the order of ``returns``."""


class Session:
    """A session's folder, for reading only: nothing in it changes, and it may be in use."""

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.folder = Path(folder)
        read = json.loads(_core.read_session(os.fspath(folder)))
        #: Names of psi, in the order of the search space.
        self.psi_names: list[str] = read["psi"]
        #: Candidates in order.
        self.candidates: list[Candidate] = [self._candidate(it) for it in read["candidates"]]
        best = read["recommended"]
        #: The verified candidate with the highest mean return, whose policy is the one to use; None before there is one.
        self.recommended: Candidate | None = None if best is None else self.candidates[best]

    def _candidate(self, read: dict[str, Any]) -> Candidate:
        policy, psi = read["policy"], read["psi"]
        return Candidate(
            number=read["number"],
            purpose=read["purpose"],
            psi=dict(zip(self.psi_names, psi, strict=True)) if psi else {},
            returns=read["returns"],
            successes=read["successes"],
            mean_return=read["mean_return"],
            policy=None if policy is None else Path(policy),
            recordings=[Path(path) for path in read["recordings"]],
        )

    def __repr__(self) -> str:
        return f"<qube_hil.Session {self.folder}: {len(self.candidates)} candidates>"
