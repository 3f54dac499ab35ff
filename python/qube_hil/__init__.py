"""The Quanser Qube for robot learning: the simulator, the guard and the 100 Hz loop of the program ``qube-hil``.

Importing the package registers ``qube_hil/Qube-v0`` with Gymnasium.
"""

from ._core import MAX_STEPS, MAX_VOLTAGE_V, VERSION as __version__
from .device import QubeDeviceEnv
from .distributions import Constant, Distribution, Normal, Uniform
from .envs import QubeEnv, QubeVectorEnv, register
from .errors import (
    ActionError,
    BusyError,
    ClosedError,
    CopyError,
    DeviceError,
    EpisodeOverError,
    IdentificationError,
    LateError,
    PolicyError,
    QubeHilError,
    RecordingError,
    SessionError,
    SettingsError,
    TrainingError,
)
from .identification import (
    Estimate,
    Identified,
    IncompleteRecording,
    LeftOutRecording,
    identify,
)
from .learning import Trained, train
from .policies import Policy
from .recordings import Recording, recording
from .sessions import Candidate, Session, Surrogate

register()

__all__ = [
    "MAX_STEPS",
    "MAX_VOLTAGE_V",
    "ActionError",
    "BusyError",
    "Candidate",
    "ClosedError",
    "Constant",
    "CopyError",
    "DeviceError",
    "Distribution",
    "EpisodeOverError",
    "Estimate",
    "IdentificationError",
    "Identified",
    "IncompleteRecording",
    "LeftOutRecording",
    "LateError",
    "Normal",
    "Policy",
    "PolicyError",
    "QubeDeviceEnv",
    "QubeEnv",
    "QubeHilError",
    "QubeVectorEnv",
    "Recording",
    "RecordingError",
    "Session",
    "SessionError",
    "SettingsError",
    "Surrogate",
    "Trained",
    "TrainingError",
    "Uniform",
    "__version__",
    "identify",
    "recording",
    "train",
]
