"""The methods that are compared, on the same environments and with the settings of the zoo's entry for USPL."""

import functools
import inspect
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import torch as th
from sb3_contrib import RecurrentPPO
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv

import bullet_tasks  # noqa: F401 (registers the environments)
from benchmarks.machine import cores
from bullet_tasks.vec_env import BulletVecEnv
from sb3_uspl import RMA, USPLPPO, RESeLPPO
from sb3_uspl._configs import CONFIGS, load_entries
from sb3_uspl.encoder import PRESETS
from sb3_uspl.observations import HidePrivileged

_NOT_FOR_THE_MODEL = ("policy", "n_envs", "n_timesteps", "env_kwargs")
_WRAPPERS = ("env_wrapper", "vec_env_wrapper", "normalize", "frame_stack")
_NET_ARCH = [128, 128]
"""Actor and critic of ``USPLPolicy`` unless an entry says otherwise."""

Settings = dict[str, Any]
"""Arguments of a model."""


def make_env(env_id: str, **kwargs: Any) -> gym.Env:
    """
    Like ``gym.make``; a worker process that unpickles this function knows our environments.

    :param env_id: registered id
    :param kwargs: of the environment
    """
    return gym.make(env_id, **kwargs)


def make_venv(
    env_id: str | Callable[..., gym.Env],
    n_envs: int,
    vec_env_cls: type[VecEnv] = BulletVecEnv,
    hide_privileged: bool = False,
    seed: int = 0,
    vec_env_kwargs: dict[str, Any] | None = None,
    **env_kwargs: Any,
) -> VecEnv:
    """
    Environments as an SB3 user makes them, monitors included.

    :param env_id: registered id, or a function that makes the environment
    :param n_envs: number of environments
    :param vec_env_cls: vector environment
    :param hide_privileged: for methods that must do without
    :param seed: of the first environment
    :param vec_env_kwargs: of the vector environment; by default ``BulletVecEnv`` has a worker a core
    :param env_kwargs: of the environment
    """
    if vec_env_kwargs is None:
        vec_env_kwargs = {"n_workers": min(cores(), n_envs)} if vec_env_cls is BulletVecEnv else {}
    return make_vec_env(
        functools.partial(make_env, env_id) if isinstance(env_id, str) else env_id,
        n_envs,
        seed=seed,
        wrapper_class=HidePrivileged if hide_privileged else None,
        env_kwargs=env_kwargs,
        vec_env_cls=vec_env_cls,  # type: ignore[arg-type]
        vec_env_kwargs=vec_env_kwargs,
    )


def zoo_entry(algorithm: str, env_id: str) -> Settings:
    """
    The zoo's entry for an environment, or its default.

    :param algorithm: ``"uspl_ppo"``, ``"rma"``, ...
    :param env_id: registered id
    """
    entries = load_entries(CONFIGS / f"{algorithm}.yml")
    entry: Settings = {**entries.get(env_id, entries["default"])}
    if isinstance(entry.get("policy_kwargs"), str):
        # As the zoo reads it.
        entry["policy_kwargs"] = eval(entry["policy_kwargs"], {"dict": dict, "th": th})
    return entry


def zoo_settings(algorithm: str, env_id: str) -> Settings:
    """
    The part of :func:`zoo_entry` that is the model's.

    :param algorithm: see there
    :param env_id: see there
    :raises ValueError: for an entry that wraps its environments, which the benchmarks do not
    """
    entry = zoo_entry(algorithm, env_id)
    wrappers = [key for key in _WRAPPERS if entry.get(key)]
    if wrappers:
        raise ValueError(
            f"The entry of {env_id} in {algorithm}.yml has {wrappers}: teach benchmarks/contenders.py to use them."
        )
    return {key: value for key, value in entry.items() if key not in _NOT_FOR_THE_MODEL}


def memory_width(settings: Settings) -> int:
    """
    Features of the encoder's memory.

    :param settings: of USPL
    """
    kwargs = settings.get("policy_kwargs", {})
    sizes = {**PRESETS[kwargs.get("encoder", "small")], **(kwargs.get("encoder_kwargs") or {})}
    return int(sizes["trunk"][-1])


def _networks(settings: Settings) -> Settings:
    kwargs = settings.get("policy_kwargs", {})
    return {"net_arch": kwargs.get("net_arch", _NET_ARCH), "activation_fn": kwargs.get("activation_fn", th.nn.ELU)}


def _shared(settings: Settings, *algorithms: type[OnPolicyAlgorithm]) -> Settings:
    """What other algorithms understand of USPL's settings, save for the networks."""
    known = {name for algorithm in algorithms for name in inspect.signature(algorithm).parameters} - {"policy_kwargs"}
    return {key: value for key, value in settings.items() if key in known}


def _uspl(venv: VecEnv, settings: Settings) -> USPLPPO:
    return USPLPPO("MlpPolicy", venv, **settings)


def _rma(venv: VecEnv, settings: Settings) -> RMA:
    return RMA("MlpPolicy", venv, **settings)


def _ppo(venv: VecEnv, settings: Settings) -> PPO:
    return PPO("MultiInputPolicy", venv, policy_kwargs=_networks(settings), **_shared(settings, PPO))


def _recurrent(venv: VecEnv, settings: Settings) -> RecurrentPPO:
    policy_kwargs = {**_networks(settings), "lstm_hidden_size": memory_width(settings)}
    return RecurrentPPO("MultiInputLstmPolicy", venv, policy_kwargs=policy_kwargs, **_shared(settings, RecurrentPPO))


def _resel(venv: VecEnv, settings: Settings) -> RESeLPPO:
    given, arguments = settings.get("policy_kwargs", {}), _shared(settings, PPO, RESeLPPO)
    policy_kwargs = {key: given[key] for key in ("net_arch", "encoder", "encoder_kwargs", "memory") if key in given}
    # Its minibatches are whole environments.
    arguments["batch_size"] = max(1, arguments["batch_size"] // arguments["n_steps"]) * arguments["n_steps"]
    return RESeLPPO("MlpPolicy", venv, policy_kwargs=policy_kwargs, **arguments)


_BUILDERS: dict[str, Callable[..., OnPolicyAlgorithm]] = {
    "USPLPPO": _uspl,
    "RMA": _rma,
    "PPO": _ppo,
    "RecurrentPPO": _recurrent,
    "RESeLPPO": _resel,
}
METHODS = tuple(_BUILDERS)
"""PPO sees the privileged observation, exactly and at no cost: the floor. RecurrentPPO never sees it."""


def hides_privileged(method: str) -> bool:
    """
    Whether a method must not be given the privileged observation.

    :param method: one of ``METHODS``
    """
    return method == "RecurrentPPO"


def build(method: str, venv: VecEnv, settings: Settings) -> OnPolicyAlgorithm:
    """
    A model with the memory width, actor, critic and PPO settings of USPL's entry. It logs nothing.

    :param method: one of ``METHODS``
    :param venv: environments, without privileged observation if :func:`hides_privileged`
    :param settings: of USPL, see :func:`zoo_settings`; what a method does not know is left out
    :raises ValueError: for an unknown method
    """
    if method not in _BUILDERS:
        raise ValueError(f"Unknown method {method!r}; known: {METHODS}.")
    model = _BUILDERS[method](venv, settings)
    # Without this, every call of learn() leaves an empty folder in /tmp.
    model.set_logger(Logger(folder=None, output_formats=[]))
    return model
