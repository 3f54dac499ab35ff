"""Policies: files, and their voltages."""

import json
import os
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt

from . import _core
from . import distributions as _distributions
from ._core import MAX_VOLTAGE_V
from .device import QubeDeviceEnv
from .distributions import Distribution
from .envs import Float32s, QubeEnv, QubeVectorEnv
from .errors import ActionError, PolicyError, SettingsError
from .settings import as_json, as_number, as_path, as_text, is_whole, shown


class Policy:
    """A policy: a network, the classical controller, an excitation, or the name of a controller outside of this program.
    Its files are those of the program. Policies are equal if their files have equal bytes."""

    def __init__(self, core: _core.Policy) -> None:
        """Wraps a policy of the compiled part. Callers use `Policy.load`, `Policy.from_bytes` or `qube_hil.train`."""
        self._core = core

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> "Policy":
        """Reads a policy file. Raises a `PolicyError` if it cannot be read, and a `SettingsError` if ``path`` is no path."""
        return cls(_core.Policy.load(as_path("path", path, "the path of a policy file")))

    @classmethod
    def from_bytes(cls, data: bytes | bytearray | memoryview) -> "Policy":
        """Reads the bytes of a policy file, such as those that `to_bytes` returns, from any bytes-like object. Raises a
        `PolicyError` if they are no policy, and a `SettingsError` if ``data`` has no bytes."""
        try:
            read = bytes(memoryview(data))
        except TypeError as error:
            raise SettingsError(f"data = {shown(data)}: give the bytes of a policy file") from error
        return cls(_core.Policy.from_bytes(read))

    @classmethod
    def from_layers(
        cls,
        layers: Sequence[tuple[npt.ArrayLike, npt.ArrayLike | None]],
        *,
        action_scale_v: float,
        activation: str = "tanh",
        output: str = "linear",
        observation: Sequence[str] | None = None,
        history: int | None = None,
        filter_rad_s: float | None = None,
        clip_observation: float | None = None,
        plant: Mapping[str, Any] | None = None,
    ) -> "Policy":
        """Makes a policy of the layers of a multilayer perceptron.

        Args:
            layers: Weights ``[outputs, inputs]`` and biases ``[outputs]`` (or None) of each layer, the last with one output.
            action_scale_v: Voltage for an output of 1, V; negative where the signs differ.
            activation: ``tanh``, ``relu``, ``elu`` or ``silu``, in all hidden layers.
            output: ``linear`` or ``tanh``.
            observation: Entries of the observation in the network's order, a list of names or one text with commas as
                for the option of `qube-hil import`; None for the program's own.
            history: Number of last commands in the program's own observation, 0 to 4; None stands for 0. An
                ``observation`` names its commands itself.
            filter_rad_s: Corner of the velocity filter in training, rad/s, for the policy's record; None stands for
                200.
            clip_observation: Magnitude at which each entry of the observation, as the network sees it, is clipped; None
                clips nothing.
            plant: Plant for which the network was trained, with the entries of a plant file; None stands for the Qube. The
                policy runs on this plant only.

        Raises:
            PolicyError: Layers of these shapes or numbers make no network of 1 to 4 hidden layers of at most 256 neurons,
                an entry of the observation is unknown or named twice, or the value of another argument is refused.
            SettingsError: An argument is of another type.
        """
        names, history = _named(observation), _as_history(history)
        activation = as_text("activation", activation, "tanh, relu, elu or silu")
        output = as_text("output", output, "linear or tanh")
        scale_v = as_number("action_scale_v", action_scale_v, _A_VOLTAGE)
        arrays = _as_layers(layers)
        entries = len(names.split(",")) if names is not None else 6 + (history or 0)
        _check_chain(arrays, entries, is_own=names is None)
        return cls(
            _core.Policy.from_layers(
                arrays,
                activation,
                output,
                scale_v,
                names,
                history,
                _as_corner(filter_rad_s),
                _as_limit(clip_observation),
                _as_plant(plant),
            )
        )

    @classmethod
    def from_onnx(
        cls,
        path: str | os.PathLike[str],
        *,
        action_scale_v: float | None = None,
        observation: Sequence[str] | None = None,
        history: int | None = None,
        filter_rad_s: float | None = None,
        clip_observation: float | None = None,
        plant: Mapping[str, Any] | None = None,
    ) -> "Policy":
        """Makes a policy of an ONNX file, as `qube-hil import` does. A file of another program needs ``action_scale_v``
        and its other conventions, named as for `from_layers`. A file that this program exported contains its
        conventions: it takes no arguments, and gives exactly the policy that was exported."""
        names, history = _named(observation), _as_history(history)
        file = as_path("path", path, "the path of an ONNX file")
        scale_v = None if action_scale_v is None else as_number("action_scale_v", action_scale_v, _A_VOLTAGE)
        corner_rad_s, limit = _as_corner(filter_rad_s), _as_limit(clip_observation)
        return cls(_core.Policy.from_onnx(file, scale_v, names, history, corner_rad_s, limit, _as_plant(plant)))

    @classmethod
    def from_torch(cls, module: Any, *, action_scale_v: float, **named: Any) -> "Policy":
        """Makes a policy of a ``torch.nn.Sequential`` of ``Linear`` layers with ``Tanh``, ``ReLU``, ``ELU`` or ``SiLU``
        between them, and ``Tanh`` at the end or nothing. ``named`` is as for `from_layers`."""
        layers, activation, output = _layers_of(_listed(module, "a torch.nn.Sequential"))
        return cls.from_layers(
            layers, action_scale_v=action_scale_v, activation=activation, output=output, **named
        )

    @classmethod
    def from_sb3(
        cls,
        model: Any,
        *,
        action_scale_v: float = 5.0,
        normalised: bool | None = None,
        **named: Any,
    ) -> "Policy":
        """Makes a policy of the actor of a Stable-Baselines3 model: PPO or A2C, SAC, or TD3, with a policy of the kind
        ``MlpPolicy`` and at most 256 neurons a layer. The default layers of TD3 have 400 and 300: train it with
        ``policy_kwargs=dict(net_arch=[256, 256])``.

        Args:
            model: The model, in memory or from the ``load`` of its class.
            action_scale_v: Voltage for an action of 1, V; 5 in the environments of this package.
            normalised: True if ``VecNormalize`` scaled the observations in training, False if it did not. None takes the
                answer from the model's environment; for a model without one, such as one that ``load`` has read without
                ``env``, a ``UserWarning`` says that it cannot be known.
            named: As for `from_layers`. Without ``observation`` and ``history``, the history is that of the model's
                environment, and without ``filter_rad_s`` the recorded sensors and plant are those of the environment, if it
                is a simulation of this package; a model without one needs ``history`` where its observation has commands.

        Raises:
            PolicyError: ``VecNormalize`` or another wrapper changes the observations or actions of the model's environment,
                or ``normalised`` is true; the
                features extractor is not the default one; PPO or A2C has ``squash_output``; the policy has an LSTM, or no
                known actor; or as for `from_layers`.
        """
        normaliser = getattr(model, "get_vec_normalize_env", lambda: None)()
        if normalised or (normaliser is not None and getattr(normaliser, "norm_obs", True)):
            raise PolicyError(
                "the model sees observations that VecNormalize has scaled: train it without, or with norm_obs=False"
            )
        policy = getattr(model, "policy", None)
        if policy is None:
            raise PolicyError(f"{shown(model)} has no policy: give a model of Stable-Baselines3")
        # SB3's default extractor only flattens the observation.
        extractor = getattr(getattr(policy, "actor", policy), "features_extractor", None)
        if extractor is not None and type(extractor).__name__ != "FlattenExtractor":
            raise PolicyError(
                f"the features extractor {type(extractor).__name__} comes before the actor and is unknown: train with "
                "the default features_extractor_class, FlattenExtractor"
            )
        if hasattr(policy, "lstm_actor"):
            raise PolicyError(
                f"the policy {type(policy).__name__} has an LSTM before the actor, and a policy here has no memory: train "
                "the model without one"
            )
        if hasattr(policy, "mlp_extractor"):
            if getattr(policy, "squash_output", False):
                raise PolicyError(
                    "the policy has squash_output=True, a tanh outside of its modules: train it without squash_output"
                )
            modules = [*policy.mlp_extractor.policy_net, policy.action_net]
        elif hasattr(policy, "actor") and hasattr(policy.actor, "latent_pi"):
            modules = [*policy.actor.latent_pi, policy.actor.mu, _LastTanh()]
        elif hasattr(policy, "actor"):
            modules = list(policy.actor.mu)
        else:
            raise PolicyError(f"the policy {type(policy).__name__} has no known actor: give a model of PPO, A2C, SAC or TD3")
        layers, activation, output = _layers_of(modules)
        widest = max(len(bias if bias is not None else weight) for weight, bias in layers) if layers else 0
        if widest > _MAX_WIDTH:
            raise PolicyError(
                f"the actor has a layer of {widest} neurons, and a policy here at most {_MAX_WIDTH}: train the model with "
                "policy_kwargs=dict(net_arch=[256, 256])"
            )
        env = _environment_of(model)
        made = cls.from_layers(
            layers,
            action_scale_v=action_scale_v,
            activation=activation,
            output=output,
            **_with_history_of(env, named),
        )
        if named.get("filter_rad_s") is None and isinstance(env, (QubeEnv, QubeVectorEnv)):
            made = cls(made._core.seen_through(env._simulation))
        if normalised is None and getattr(model, "env", None) is None:
            warnings.warn(
                "the model has no environment, so that it cannot be known whether VecNormalize scaled its observations; if it "
                "did, this policy gives wrong voltages. Give normalised=False if it did not, or load the model with its "
                "environment (env=...)",
                UserWarning,
                stacklevel=2,
            )
        return made

    def to_bytes(self) -> bytes:
        """The bytes of the policy's file; equal policies give equal bytes."""
        return self._core.to_bytes()

    def save(self, path: str | os.PathLike[str], force: bool = False) -> None:
        """Writes the policy file, which appears whole or not at all. An existing file is replaced only with
        ``force``; a folder, a pipe, a device, a recording, and the record of a session or an experiment never."""
        file = as_path("path", path, "the path of a policy file")
        if not isinstance(force, (bool, np.bool_)):
            raise SettingsError(f"force = {shown(force)}: give True or False")
        self._core.save(file, bool(force))

    def to_onnx(self) -> bytes:
        """The bytes of an ONNX model, as `qube-hil export --onnx` writes it: from ``observation``, float32
        ``[n, observation_size]``, to ``voltage_v``, float32 ``[n, 1]`` within 5 V. Its metadata describe the computations
        before and after the network."""
        return self._core.to_onnx()

    def start(self) -> None:
        """Begins an episode: a classical controller swings up again, an excitation begins again. A network has no
        memory."""
        self._core.start()

    def act(self, observation: npt.ArrayLike) -> Float32s:
        """The action of an environment for an observation: a fraction of 5 V from -1 to 1.

        Takes ``[observation_size]`` and returns ``[1]``, or takes ``[n, observation_size]`` and returns ``[n, 1]``. A
        classical controller and an excitation remember the motion of one Qube, so that they take one observation at a
        time; `start` makes them forget it.
        """
        return self.voltage_v(observation) / np.float32(MAX_VOLTAGE_V)

    def voltage_v(self, observation: npt.ArrayLike) -> Float32s:
        """The voltage for an observation, V, within 5 V. The shapes are those of `act`."""
        given: Any = observation
        try:
            # A tensor of torch that requires a gradient gives no array.
            given = given.detach().cpu() if hasattr(given, "detach") else given
            observations = _as_real(given)
        except (TypeError, ValueError) as error:
            raise ActionError(f"the observation is not an array of numbers: {error}") from error
        if observations.ndim not in (1, 2):
            raise ActionError(
                f"the observation has the shape {observations.shape}: give {(self.observation_size,)} "
                f"or (n, {self.observation_size})"
            )
        rows = np.ascontiguousarray(np.atleast_2d(observations))
        voltages: Float32s = np.zeros((rows.shape[0], 1), np.float32)
        self._core.voltages(rows, voltages)
        return voltages[0] if observations.ndim == 1 else voltages

    @property
    def kind(self) -> str:
        """The kind: ``network``, ``classical``, ``excitation``, or ``external`` (a controller that the file only names)."""
        return self._core.kind

    @property
    def observation_size(self) -> int:
        """Length of the observation."""
        return self._core.observation_size

    @property
    def sizes(self) -> list[int] | None:
        """Sizes of the network's layers from the observation to the output; None without a network."""
        return self._core.sizes

    @property
    def training(self) -> dict[str, Any] | None:
        """The record of the training; None without a network."""
        training = self._core.training
        return None if training is None else json.loads(training)

    @property
    def randomisation(self) -> dict[str, Distribution] | None:
        """Distribution of each quantity of the simulated Qubes in training, by name, as environments and `train` take
        them for ``distributions``; None without a network, or if the file does not name them. A uniform distribution has
        the ends between which the training drew. Joint deviations and the Qubes of a distribution of given Qubes, if
        there are any, are in ``training["randomisation"]``."""
        known = self._core.randomisation
        if known is None:
            return None
        return {name: _distributions.read(it) for name, it in json.loads(known).items()}

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickles and copies by the bytes of the file: a copy begins with no memory of an episode."""
        return type(self).from_bytes, (self.to_bytes(),)

    def __eq__(self, other: object) -> bool:
        """Returns whether the other policy has the same bytes; the memory of an episode does not count."""
        if not isinstance(other, Policy):
            return NotImplemented
        return self.to_bytes() == other.to_bytes()

    def __hash__(self) -> int:
        return hash(self.to_bytes())

    def __repr__(self) -> str:
        sizes = "" if self.sizes is None else f" {self.sizes}"
        return f"<qube_hil.Policy: {self.kind}{sizes}>"


def _named(observation: Sequence[str] | None) -> str | None:
    """The entries of an observation as the option of `qube-hil import` takes them."""
    if observation is None or isinstance(observation, str):
        return observation
    try:
        return ",".join(observation)
    except TypeError as error:
        raise SettingsError(f"observation = {shown(observation)}: give names of entries") from error


def _as_real(values: Any) -> Float32s:
    """Real numbers in single precision; complex numbers, texts and dates raise a TypeError."""
    array = np.asarray(values)
    if array.dtype.kind not in "fiubO":
        raise TypeError(f"it has the type {array.dtype}")
    return array.astype(np.float32, copy=False)


def _as_layers(layers: Any) -> list[tuple[Float32s, Float32s]]:
    """Weights ``[outputs, inputs]`` and biases ``[outputs]`` of each layer as arrays of finite numbers."""
    arrays = []
    for number, layer in enumerate(_listed(layers, "layers"), 1):
        try:
            weight, bias = layer
            with np.errstate(over="ignore"):
                matrix = _as_real(weight)
                vector = np.zeros(len(matrix), np.float32) if bias is None else _as_real(bias)
        except (TypeError, ValueError) as error:
            raise PolicyError(
                f"layer {number} is not made of arrays of numbers: {error}. Give (weight, bias) for each layer"
            ) from error
        if matrix.ndim != 2 or vector.ndim != 1:
            raise PolicyError(
                f"layer {number} has the shapes {matrix.shape} and {vector.shape}: give [outputs, inputs] and [outputs]"
            )
        for name, array in [("weight", matrix), ("bias", vector)]:
            if not np.isfinite(array).all():
                raise PolicyError(
                    f"the {name} of layer {number} has an entry that is not a finite number in single precision: give finite "
                    "numbers"
                )
        arrays.append((matrix, vector))
    if not arrays:
        raise PolicyError("there are no layers: give at least one hidden layer and the output")
    return arrays


def _check_chain(layers: list[tuple[Float32s, Float32s]], entries: int, is_own: bool) -> None:
    """Checks that each layer has as many inputs as the layer before has outputs, that each bias fits its weight, and that
    the last layer has one output. In the first layer it finds transposed weights and, for this program's own observation,
    another number of last commands; the compiled part compares the first layer with other observations."""
    source = f"the observation has {entries} entries"
    first = layers[0][0].shape[1]
    if is_own and first != entries and 6 <= first <= 10 and layers[0][0].shape[0] != entries:
        raise PolicyError(
            f"layer 1 has {first} inputs, and {source}: give history={first - 6} if these are this program's own observation "
            f"with {first - 6} last commands, or name the entries by observation"
        )
    for number, (matrix, vector) in enumerate(layers, 1):
        outputs, inputs = matrix.shape
        if inputs != entries and (number > 1 or outputs == entries):
            hint = ""
            if outputs == entries:
                hint = ": the weights seem to be transposed, give [outputs, inputs]"
            raise PolicyError(f"layer {number} has a weight of {outputs} outputs and {inputs} inputs, and {source}{hint}")
        if len(vector) != outputs:
            raise PolicyError(
                f"layer {number} has a bias of {len(vector)} entries and a weight of {outputs} outputs: give one entry for "
                "each output"
            )
        entries, source = outputs, f"layer {number} has {outputs} outputs"
    if entries != 1:
        raise PolicyError(f"the last layer has {entries} outputs: give one, the voltage")


def _as_history(history: int | None) -> int | None:
    """A number of last commands in an observation."""
    if history is None:
        return None
    if not is_whole(history):
        raise SettingsError(f"history = {shown(history)}: give 0 to 4")
    if not 0 <= history <= 4:
        raise PolicyError(f"history = {shown(history)}: give 0 to 4")
    return history


#: The values of arguments, as messages name them.
_A_VOLTAGE = "a voltage from -100 to 100 that is not 0"


def _as_corner(filter_rad_s: object) -> float | None:
    """The corner of a velocity filter, rad/s; None for the program's own corner."""
    if filter_rad_s is None:
        return None
    return as_number("filter_rad_s", filter_rad_s, "a number from 1 to 10000, or None")


def _as_limit(clip_observation: object) -> float | None:
    """The magnitude at which an observation is clipped; None if it is not clipped."""
    if clip_observation is None:
        return None
    return as_number("clip_observation", clip_observation, "a number above 0, or None")


def _as_plant(plant: object) -> str | None:
    """A plant as JSON; None for the Qube."""
    if plant is None:
        return None
    return as_json(plant, "plant")


#: Wrappers of Gymnasium that change observations or actions. `ClipAction` clips actions as a policy here does.
_CHANGING_WRAPPERS = (
    gymnasium.ObservationWrapper,
    gymnasium.ActionWrapper,
    gymnasium.vector.VectorObservationWrapper,
    gymnasium.vector.VectorActionWrapper,
)


def _environment_of(model: Any) -> QubeEnv | QubeVectorEnv | QubeDeviceEnv | None:
    """The environment of a model of Stable-Baselines3, without its wrappers; None if it is none of this package. Raises a
    `PolicyError` for a wrapper that changes the observations or actions, because a policy would see and request others."""
    env: Any = getattr(model, "env", None)
    while env is not None and not isinstance(env, (QubeEnv, QubeVectorEnv, QubeDeviceEnv)):
        if isinstance(env, _CHANGING_WRAPPERS) and not isinstance(env, gymnasium.wrappers.ClipAction):
            raise PolicyError(
                f"the wrapper {type(env).__name__} changes the observations or actions of the model's environment, and a policy "
                "here sees them unchanged: train the model without it"
            )
        # A wrapper holds one environment, and a vector of environments several alike.
        several = getattr(env, "envs", None)
        holders = ("venv", "_envs", "env")
        inside = next((getattr(env, name) for name in holders if hasattr(env, name)), None)
        env = several[0] if several else inside
    return env


def _with_history_of(env: QubeEnv | QubeVectorEnv | QubeDeviceEnv | None, named: dict[str, Any]) -> dict[str, Any]:
    """The arguments of `Policy.from_layers`, with the history of an environment if they do not name the observation."""
    if env is None or named.get("observation") is not None or named.get("history") is not None:
        return named
    space: Any = env.single_observation_space if isinstance(env, QubeVectorEnv) else env.observation_space
    return {**named, "history": space.shape[0] - 6}


def _listed(given: Any, wanted: str) -> list[Any]:
    try:
        return list(given)
    except TypeError as error:
        raise PolicyError(f"{shown(given)} cannot be listed: give {wanted}") from error


#: Most neurons of a layer.
_MAX_WIDTH = 256


class _LastTanh:
    """The tanh that SAC's actor applies to its mean outside of its modules."""


#: Activations by the names of torch's classes.
_ACTIVATIONS = {"Tanh": "tanh", "_LastTanh": "tanh", "ReLU": "relu", "ELU": "elu", "SiLU": "silu"}


def _array_of(tensor: Any) -> Any:
    """The numbers of a tensor of torch."""
    try:
        return tensor.detach().cpu().numpy()
    except (TypeError, RuntimeError) as error:
        kind = getattr(tensor, "dtype", type(tensor).__name__)
        raise SettingsError(
            f"a Linear layer has numbers of the type {kind}, which numpy lacks: give module.float(), or a model of float32"
        ) from error


def _layers_of(modules: list[Any]) -> tuple[list[tuple[Any, Any]], str, str]:
    """The layers of modules in order, their activation and the function of the output."""
    layers: list[tuple[Any, Any]] = []
    activations: list[str] = []
    for module in modules:
        kind = type(module).__name__
        if kind in ("Identity", "Flatten"):
            continue
        if kind == "Linear":
            if len(layers) != len(activations):
                raise PolicyError("two Linear layers follow each other without an activation")
            bias = None if module.bias is None else _array_of(module.bias)
            layers.append((_array_of(module.weight), bias))
        elif kind in _ACTIVATIONS and getattr(module, "alpha", 1.0) == 1.0:
            if len(layers) != len(activations) + 1:
                raise PolicyError(f"the activation {kind} does not follow a Linear layer")
            activations.append(_ACTIVATIONS[kind])
        else:
            raise PolicyError(f"the module {kind} is unknown: give Linear, Tanh, ReLU, ELU (alpha 1) or SiLU")
    output = "linear"
    if layers and len(activations) == len(layers):
        if activations.pop() != "tanh":
            raise PolicyError("the last activation is no Tanh: end with Tanh or a Linear layer")
        output = "tanh"
    if len(set(activations)) > 1:
        raise PolicyError(f"the hidden layers have several activations: {activations}")
    return layers, (activations or ["tanh"])[0], output
