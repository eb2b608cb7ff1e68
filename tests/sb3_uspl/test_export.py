"""The exported policy acts as model.predict does, with a memory that the caller holds."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from sb3_uspl import USPLPPO, RESeLPPO
from sb3_uspl.deployment import DeploymentPolicy, _TransformerStep
from sb3_uspl.encoder.memory import TransformerMemory
from sb3_uspl.export import export_policy
from tests.sb3_uspl.toy import IMAGE, ToyEnv

pytestmark = pytest.mark.filterwarnings("ignore:.*torch.jit.*:DeprecationWarning")

EXAMPLE = Path(__file__).parents[2] / "docs" / "examples" / "run_exported_policy.py"
N_STEPS, EPISODE = 200, 70

VECTOR = spaces.Box(-1, 1, (3,), np.float32)
CASES = {
    "gru": (USPLPPO, "gru", None, None),
    "transformer": (USPLPPO, "transformer", IMAGE, spaces.Discrete(3)),
    "vector": (USPLPPO, "max", VECTOR, spaces.MultiDiscrete([2, 3])),
    "categorical": (USPLPPO, "max", None, None, {"categorical": True}),
    "number": (USPLPPO, "gru", None, spaces.Box(-1, 1, (), np.float32)),
    "resel": (RESeLPPO, "transformer", None, spaces.Box(-2, 3, (2,), np.float32)),
}


def make_model(algorithm=USPLPPO, memory="gru", target=None, action_space=None, sizes=None, normalize=False):
    venv = make_vec_env(lambda: ToyEnv(length=EPISODE, target=target, action_space=action_space), 8, seed=0)
    if normalize:
        venv = VecNormalize(venv, norm_obs_keys=["common", "target"] if target is not None else ["common"])
    more = {} if sizes is None else dict(discrete_privileged={0: [-0.1, 0.0, 0.1]})
    sizes = dict(hidden=(16,), trunk=(16,), embedding=(16,)) | (sizes or {})
    if algorithm is RESeLPPO:  # it hears its own continuous action: at high frequencies, untrained, rounding errors grow
        sizes["frequencies"] = 0
    kwargs = dict(memory=memory, encoder_kwargs=sizes) | (dict(one_hot=True) if more else {})
    if target is VECTOR:
        more["symmetries"] = [(np.diag([1.0, -1.0]), np.array([[-1.0]]))]
    model = algorithm("MlpPolicy", venv, n_steps=16, batch_size=64, policy_kwargs=kwargs, device="cpu", seed=0, **more)
    rng = th.Generator().manual_seed(0)
    with th.no_grad():  # an untrained policy hardly acts
        for parameter in model.policy.parameters():
            if parameter.dim() > 1:
                parameter.add_(0.1 * th.randn(parameter.shape, generator=rng))
    head, outputs = model.policy.action_net, []
    hook = head.register_forward_hook(lambda _module, _inputs, output: outputs.append(output[0]))
    predicted(model, observations(model, 50))
    hook.remove()
    head.bias.data -= th.stack(outputs).mean(dim=0)  # nor may it always do the same
    return model, venv


def observations(model, n):
    """Random, so that every step matters."""
    rng = np.random.default_rng(1)
    space = model.observation_space
    return [{key: part for key, part in _sample(space, rng).items() if key != "privileged"} for _ in range(n)]


def _sample(space, rng):
    return {
        key: (rng.integers(0, 256, part.shape) if part.dtype == np.uint8 else rng.uniform(-1, 1, part.shape)).astype(
            part.dtype
        )
        for key, part in space.spaces.items()
    }


def predicted(model, stream):
    actions, beliefs, state = [], [], None
    for step, obs in enumerate(stream):
        action, state = model.predict(obs, state, np.array([step % EPISODE == 0]), deterministic=True)
        actions.append(action)
        beliefs.append([getattr(state, "belief_mean", 0.0), getattr(state, "uncertainty", 0.0)])
    return np.array(actions), np.array(beliefs).reshape(len(stream), -1)


def load_example(path):
    namespace = {"__name__": "example"}
    exec(compile(EXAMPLE.read_text(), EXAMPLE, "exec"), namespace)
    return namespace["ExportedPolicy"](str(path))


@pytest.fixture(scope="module", params=["gru", "transformer", "vector", "categorical", "resel"])
def exported(request, tmp_path_factory):
    pytest.importorskip("onnxruntime")
    pytest.importorskip("onnxscript")
    model, _ = make_model(*CASES[request.param])
    folder = tmp_path_factory.mktemp(request.param)
    return model, export_policy(model, folder / "policy", "onnx", horizon=EPISODE), folder / "policy.onnx"


def test_onnx_acts_as_predict_does_over_200_steps_and_two_resets(exported):
    model, card, path = exported
    stream = observations(model, N_STEPS)
    wanted, believed = predicted(model, stream)
    policy = load_example(path)
    actions, beliefs = [], []
    for step, obs in enumerate(stream):
        if step % EPISODE == 0:
            policy.reset()
        actions.append(policy.act(obs))
        beliefs.append([policy.outputs.get(name, 0.0) for name in ("belief_mean", "next_uncertainty")])
    np.testing.assert_allclose(np.array(actions), wanted, atol=1e-5)
    np.testing.assert_allclose(np.array(beliefs).reshape(N_STEPS, -1), believed, atol=1e-5)
    _, counts = np.unique(wanted, axis=0, return_counts=True)
    assert counts.max() < 0.9 * N_STEPS
    assert card == json.loads(path.with_suffix(".json").read_text())
    assert card["decision_period_s"] == getattr(model, "decision_period", None)


@pytest.mark.parametrize("case", CASES)
def test_torchscript_acts_as_predict_does_for_any_number_of_robots(case, tmp_path):
    model, _ = make_model(*CASES[case])
    card = export_policy(model, tmp_path / "policy", "torchscript", horizon=8)
    script, module = th.jit.load(tmp_path / "policy.pt"), DeploymentPolicy(model.policy, 8)
    for n_robots in (1, 3):
        arrays = {part.name: part.start(n_robots) for part in module.inputs}
        state = None
        for obs in observations(model, 8):
            stacked = {key: np.stack([value] * n_robots) for key, value in obs.items()}
            action, state = model.predict(stacked, state, deterministic=True)
            arrays.update({key: th.as_tensor(value) for key, value in stacked.items()})
            outputs = dict(zip(card["outputs"], script(*arrays.values()), strict=True))
            np.testing.assert_allclose(outputs["action"].numpy(), action, atol=1e-5)
            arrays.update({part["input"]: outputs[part["output"]] for part in card["memory"]})


def test_the_memory_matters(tmp_path):
    """Otherwise the tests above would say little."""
    model, _ = make_model()
    stream = observations(model, 20)
    fresh = np.array([model.predict(obs, deterministic=True)[0] for obs in stream])
    assert np.abs(predicted(model, stream)[0] - fresh).max() > 1e-2


def test_normalisation_of_the_training_is_inside(tmp_path):
    model, venv = make_model(normalize=True)
    rng = np.random.default_rng(2)
    venv.reset()
    for _ in range(30):
        venv.step(rng.uniform(-1, 1, (8, 1)).astype(np.float32))
    card = export_policy(model, tmp_path / "policy", "torchscript", normalize=venv)
    script = th.jit.load(tmp_path / "policy.pt")
    arrays = {part.name: part.start(1) for part in DeploymentPolicy(model.policy, 8).inputs}
    for obs in observations(model, 5):
        seen = venv.normalize_obs({**obs, "privileged": np.zeros(1, np.float32)})
        outputs = dict(
            zip(card["outputs"], script(th.as_tensor(obs["common"])[None], *list(arrays.values())[1:]), strict=True)
        )
        action, _ = model.predict({"common": seen["common"]}, deterministic=True)
        np.testing.assert_allclose(outputs["action"][0].numpy(), action, atol=1e-5)
        assert np.abs(model.predict(obs, deterministic=True)[0] - action).max() > 1e-4


@pytest.mark.parametrize("shared_keys", [True, False])
def test_ring_is_the_cache_up_to_its_size_and_then_forgets_the_oldest(shared_keys):
    th.manual_seed(0)
    memory, horizon = TransformerMemory(8, n_heads=2, head_width=4, shared_keys=shared_keys), 6
    ring = _TransformerStep(memory, horizon)
    features = th.randn(2, 3 * horizon, 8)
    features[1, :horizon] = 5.0  # two robots whose pasts differ long ago only
    features[1, horizon:] = features[0, horizon:]
    state, cached = ring.initial_state(2), memory.initial_state(2)
    for t in range(3 * horizon):
        output, state = ring.step(features[:, t], state)
        expected, cached = memory.step(features[:, t], cached)
        if t < horizon:
            th.testing.assert_close(output, expected)
        agree = th.allclose(output[0], output[1], atol=1e-5)
        assert agree == (t >= 2 * horizon - 1)


def test_example_needs_neither_torch_nor_sb3(exported, tmp_path):
    code = (
        f"import runpy, sys; sys.argv = ['x', {str(exported[2])!r}]; runpy.run_path({str(EXAMPLE)!r}, "
        "run_name='__main__'); assert not {'torch', 'stable_baselines3', 'sb3_uspl'} & set(sys.modules)"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert len(result.stdout.splitlines()) == 5


def test_card_is_valid_json_and_says_what_the_file_takes(tmp_path):
    model, _ = make_model(*CASES["transformer"])
    card = export_policy(model, tmp_path / "a" / "policy", "torchscript", horizon=12, environment="Toy")
    text = (tmp_path / "a" / "policy.json").read_text()
    assert "Infinity" not in text and "NaN" not in text
    module = DeploymentPolicy(model.policy, 12)
    assert card["inputs"] == [part.name for part in module.inputs]
    assert {part["name"] for part in card["observation"]} | {part["input"] for part in card["memory"]} == set(card["inputs"])
    assert {part["output"] for part in card["memory"]} < set(card["outputs"])
    keys = next(part for part in card["memory"] if part["input"] == "keys")
    memory = model.policy.encoder.memory
    assert keys["shape"] == [1, memory.n_key_heads, 12, memory.head_width] and keys["initial"] == 0.0
    assert card["environment"] == "Toy" and card["observation"][0]["low"] == -1.0


def test_what_cannot_be_exported_is_refused(tmp_path, monkeypatch):
    model, venv = make_model()
    with pytest.raises(ValueError, match="onnx"):
        export_policy(model, tmp_path / "policy", "tflite")
    with pytest.raises(ValueError, match="horizon"):
        export_policy(model, tmp_path / "policy", "torchscript", horizon=0)
    with pytest.raises(ValueError, match="USPLPPO, RMA or RESeLPPO"):
        export_policy(PPO("MultiInputPolicy", venv, device="cpu"), tmp_path / "policy", "torchscript")
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"pip install -e \"\.\[export\]\""):
        export_policy(model, tmp_path / "policy", "onnx")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("algorithm", [USPLPPO, RESeLPPO])
def test_export_leaves_a_model_that_has_just_learned_as_it_is(algorithm, tmp_path):
    model, _ = make_model(algorithm)
    model.learn(256)
    before = {name: value.clone() for name, value in model.policy.state_dict().items()}
    export_policy(model, tmp_path / "policy", "torchscript")
    assert type(model.policy.encoder.memory).__name__ == "GRUMemory"
    assert all(parameter.requires_grad for parameter in model.policy.encoder.parameters())
    th.testing.assert_close(dict(model.policy.state_dict()), before)
