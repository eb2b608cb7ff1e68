"""What ``-optimize`` tries. The zoo's own sampler would replace ``policy_kwargs`` and with it the encoder's settings."""

from typing import Any

import optuna
from rl_zoo3 import hyperparams_opt

USPL_FAMILY = ("uspl_ppo", "rma", "rewreg", "privrecons")
_POWERS = {"n_steps": (4, 8), "batch_size": (8, 11), "encoder_batch_size": (10, 13)}
"""Least and greatest power of two."""
_CHOICES: dict[str, list[Any]] = {
    "n_epochs": [4, 5, 8, 10],
    "clip_range": [0.1, 0.2, 0.3],
    "encoder_updates": [4, 8, 16],
}
_LOGARITHMIC = {
    "one_minus_gamma": (2e-3, 5e-2),
    "one_minus_gae_lambda": (1e-2, 1e-1),
    "learning_rate": (1e-4, 2e-3),
    "action_std": (0.2, 0.7),
    "encoder_learning_rate": (2e-4, 4e-3),
}
_ENCODER_ONLY = ("encoder_batch_size", "encoder_updates", "encoder_learning_rate")


def _sample(trial: optuna.Trial, names: set[str]) -> dict[str, Any]:
    raw: dict[str, Any] = {}
    for name in sorted(names & set(_POWERS)):
        raw[f"{name}_pow"] = trial.suggest_int(f"{name}_pow", *_POWERS[name])
    for name in sorted(names & set(_CHOICES)):
        raw[name] = trial.suggest_categorical(name, _CHOICES[name])
    for name in sorted(names & set(_LOGARITHMIC)):
        raw[name] = trial.suggest_float(name, *_LOGARITHMIC[name], log=True)
    hyperparams = convert_params(raw)
    for name in hyperparams:
        trial.set_user_attr(name, hyperparams[name])
    return hyperparams


def sample_uspl_params(trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]) -> dict[str, Any]:
    """
    Draw hyperparameters of ``USPLPPO`` and what derives from it. Networks, warm-up and ramp stay those of the configuration.

    :param trial: of the study
    :param n_actions: unused
    :param n_envs: unused
    :param additional_args: unused
    :return: constructor arguments that replace the configuration's
    """
    return _sample(trial, {*_POWERS, *_CHOICES, *_LOGARITHMIC})


def sample_resel_params(trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]) -> dict[str, Any]:
    """
    Draw hyperparameters of ``RESeLPPO``, whose encoder is trained with its policy.

    :param trial: of the study
    :param n_actions: unused
    :param n_envs: unused
    :param additional_args: unused
    :return: constructor arguments that replace the configuration's
    """
    return _sample(trial, {*_POWERS, *_CHOICES, *_LOGARITHMIC} - set(_ENCODER_ONLY))


def convert_params(sampled_params: dict[str, Any]) -> dict[str, Any]:
    """
    Turn a study's numbers into constructor arguments, also for ``--trial-id``.

    :param sampled_params: as the study stores them: powers of two as exponents, discount factors as their distance from one
    :return: constructor arguments
    """
    hyperparams: dict[str, Any] = {}
    for name, value in sampled_params.items():
        if name.endswith("_pow"):
            hyperparams[name.removesuffix("_pow")] = 2**value
        elif name.startswith("one_minus_"):
            hyperparams[name.removeprefix("one_minus_")] = 1.0 - value
        else:
            hyperparams[name] = value
    return hyperparams


def register_samplers() -> None:
    """Make ``-optimize`` and ``--trial-id`` work with our algorithms."""
    for name in USPL_FAMILY:
        hyperparams_opt.HYPERPARAMS_SAMPLER[name] = sample_uspl_params
    hyperparams_opt.HYPERPARAMS_SAMPLER["resel_ppo"] = sample_resel_params
    for name in (*USPL_FAMILY, "resel_ppo"):
        hyperparams_opt.HYPERPARAMS_CONVERTER[name] = convert_params
