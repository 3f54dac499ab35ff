"""Tests of ONNX models: exported by the program, computed by onnxruntime, and imported again."""

import json
import re

import numpy as np
import onnxruntime
import pytest
from conftest import SHIPPED, program

import qube_hil
from qube_hil import Policy

RANDOM = np.random.default_rng(18)


def layers(inputs, hidden=(64, 64), scale=1.0):
    """Returns random layers whose outputs are of the order of 1."""
    sizes = [inputs, *hidden, 1]
    return [
        (scale * RANDOM.normal(size=(after, before)) / before**0.5, 0.1 * RANDOM.normal(size=after))
        for before, after in zip(sizes, sizes[1:])
    ]


POLICIES = {
    "nominal, true states": lambda: Policy.load(SHIPPED / "nominal.safetensors"),
    "robust, encoders, filter and two commands": lambda: Policy.load(SHIPPED / "robust.safetensors"),
    "tanh, four commands": lambda: Policy.from_layers(layers(10), action_scale_v=5.0, history=4),
    "elu, another filter": lambda: Policy.from_layers(
        layers(6, (256, 128)), activation="elu", action_scale_v=2.0, filter_rad_s=50.0
    ),
    "silu, tanh at the output": lambda: Policy.from_layers(
        layers(7), activation="silu", output="tanh", action_scale_v=5.0, history=1
    ),
    "relu, the other sign and order, clipped": lambda: Policy.from_layers(
        layers(6),
        activation="relu",
        action_scale_v=-6.0,
        observation=["theta_dot", "-1*cos_alpha", "-1*sin_alpha", "cos_theta", "sin_theta", "alpha_dot"],
        clip_observation=0.9,
    ),
}


def observations(size, count=20_000):
    """Returns random observations in the range of an episode, some of them of fast arms and pendulums."""
    theta, alpha = RANDOM.uniform(-2.0, 2.0, count), RANDOM.uniform(-7.0, 7.0, count)
    velocities = RANDOM.normal(scale=[[1.5], [1.0]], size=(2, count))
    commands = RANDOM.uniform(-1.0, 1.0, (size - 6, count))
    rows = [np.sin(theta), np.cos(theta), np.sin(alpha), np.cos(alpha), *velocities, *commands]
    return np.stack(rows, axis=1).astype(np.float32)


@pytest.mark.parametrize("name", POLICIES)
def test_an_exported_policy_gives_the_same_voltages_in_onnxruntime_and_is_imported_unchanged(name, tmp_path):
    policy = POLICIES[name]()
    policy.save(tmp_path / "p.safetensors")
    program("export", "--onnx", tmp_path / "p.safetensors")
    model = (tmp_path / "p.onnx").read_bytes()
    assert model == policy.to_onnx()

    session = onnxruntime.InferenceSession(model, providers=["CPUExecutionProvider"])
    seen = observations(policy.observation_size)
    (voltages,) = session.run(["voltage_v"], {"observation": seen})
    assert voltages.shape == (len(seen), 1)
    # Full scale is -5 to 5 V. Both programs round to single precision at each layer, so for one observation in about
    # ten thousand the voltages differ by more than a millionth of full scale.
    differences = np.abs(voltages - policy.voltage_v(seen)) / 10.0
    assert np.quantile(differences[np.abs(voltages) < 5.0], 0.999) <= 1e-6
    assert differences.max() <= 2e-6
    assert np.abs(voltages).max() <= 5.0 and np.abs(voltages).std() > 0.01

    assert Policy.from_onnx(tmp_path / "p.onnx").to_bytes() == policy.to_bytes()
    program("import", tmp_path / "p.onnx", "--out", tmp_path / "again.safetensors")
    assert (tmp_path / "again.safetensors").read_bytes() == (tmp_path / "p.safetensors").read_bytes()


def test_the_file_describes_the_graph_and_names_the_computations_outside_of_it(tmp_path):
    policy = POLICIES["elu, another filter"]()
    model = policy.to_onnx()
    session = onnxruntime.InferenceSession(model, providers=["CPUExecutionProvider"])
    entries = session.get_modelmeta().custom_metadata_map
    assert session.get_modelmeta().producer_name == "qube-hil"
    description = entries["qube_hil.graph"]
    for missing in ["filter", "sines", "last commands", "guard", "1 mV", "10 ms"]:
        assert missing in description.split("does not contain")[1], missing
    named = json.loads(entries["qube_hil.policy"])["controller"]
    assert named["sizes"] == [6, 256, 128, 1] and named["activation"] == "elu"
    assert named["conventions"]["period_s"] == 0.01
    assert named["training"]["sensors"]["corner_rad_s"] == 50.0
    assert [it.name for it in session.get_inputs() + session.get_outputs()] == ["observation", "voltage_v"]
    # The model names the version of its operators, 17.
    assert re.search(rb"B\x04\n\x00\x10\x11", model)


def test_wrong_exports_and_imports_are_refused(tmp_path):
    nominal = Policy.load(SHIPPED / "nominal.safetensors")
    nominal.save(tmp_path / "p.safetensors")
    program("export", "--onnx", tmp_path / "p.safetensors")
    program("export", "--onnx", tmp_path / "p.safetensors", code=2)
    program("export", "--onnx", tmp_path / "p.safetensors", "--force")
    program("export", "--onnx", "--format", "csv", tmp_path / "p.safetensors", code=2)
    program("export", "--onnx", tmp_path / "p.onnx", code=2)
    program("import", tmp_path / "p.onnx", "--history", 2, code=2)
    for named in [{"action_scale_v": 5.0}, {"action_scale_v": 0.0}]:
        with pytest.raises(qube_hil.PolicyError, match="names its conventions|not 0"):
            Policy.from_onnx(tmp_path / "p.onnx", **named)
    # Every other convention needs an action scale, so that none is ignored.
    for named in [
        {"observation": ["sin_theta"]}, {"history": 2}, {"filter_rad_s": 50.0}, {"clip_observation": 1.0}
    ]:
        (name,) = named
        with pytest.raises(qube_hil.PolicyError, match=f"{name} without action_scale_v"):
            Policy.from_onnx(tmp_path / "p.onnx", **named)
    cut = tmp_path / "cut.onnx"
    cut.write_bytes((tmp_path / "p.onnx").read_bytes()[:-100])
    for path, message in [(cut, "or is damaged"), (tmp_path / "missing.onnx", "missing.onnx")]:
        with pytest.raises(qube_hil.PolicyError, match=message):
            Policy.from_onnx(path)


def test_a_classical_controller_has_no_network_to_export(swing_up):
    with pytest.raises(qube_hil.PolicyError, match="no network"):
        qube_hil.recording(swing_up).policy.to_onnx()
