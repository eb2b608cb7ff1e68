# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation:
#       extension: .py
#       format_name: percent
#       format_version: '1.3'
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # 7 · Your own environment
#
# From a plain Gymnasium environment to one that USPL can learn: what to call privileged, how to scale it, and how to read the
# log when it goes wrong. Needs to know SB3, not the notebooks before.

# %%
import importlib.util
import os

missing = [name for name in ("sb3_uspl", "stable_baselines3", "matplotlib") if importlib.util.find_spec(name) is None]
if missing:
    raise SystemExit(f"This notebook needs {missing}: run `pip install -e '.[zoo,notebooks]'` in the repository.")
FAST = os.environ.get("SB3_USPL_FAST_NOTEBOOKS") == "1"  # for the test suite: everything runs, nothing is learned

# %%
import time

import gymnasium as gym
import matplotlib.pyplot as plt
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env

from sb3_uspl import RMA, USPLPPO, PrivilegedObservation
from sb3_uspl.evaluation import evaluate
from sb3_uspl.pictures import DEPLOYMENT_COLOUR, PRIVILEGED_COLOUR, SIGMA_COLOUR

th.set_num_threads(1)

# %% [markdown]
# ## A plain environment
#
# Two boxes, a prize in one of them. You may shake them, and hear where it is, or open one, and that is it. As it is often the
# case in simulation, the observation holds something that the real player will not have: its last entry is the prize's place.


# %%
class TwoBoxes(gym.Env):
    """Observation: time, what was heard (-1, 0, 1), place of the prize (-1, 1). Actions: shake, open left, open right."""

    decision_period = 1.0  # s; USPL's times (smoothing, blur) are in seconds

    def __init__(self, right=1.0, wrong=0.0, shaking=0.0):
        self.observation_space = spaces.Box(-1.0, 1.0, (3,), np.float32)
        self.action_space = spaces.Discrete(3)
        self.right, self.wrong, self.shaking = right, wrong, shaking

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.prize, self.t = self.np_random.choice([-1.0, 1.0]), 0
        return np.array([0.0, 0.0, self.prize], dtype=np.float32), {}

    def step(self, action):
        self.t += 1
        opened = {1: -1.0, 2: 1.0}.get(int(action))
        success = opened == self.prize
        reward = self.shaking if opened is None else self.right if success else self.wrong
        heard = self.prize if opened is None else 0.0
        obs = np.array([0.1 * self.t, heard, self.prize], dtype=np.float32)
        return obs, reward, opened is not None, self.t >= 10, {"is_success": success}


# %% [markdown]
# ## What is privileged, and its scale
#
# One wrapper: the privileged part by its index (or key, for a `Dict`), the rest is common. The **scale** brings a guess without
# information to a standard deviation of 0.2-0.25, because USPL's constants mean something on that scale only. Measure it:


# %%
def make(scale=0.25, **rewards):
    return PrivilegedObservation(TwoBoxes(**rewards), privileged=[2], scale=scale)


env = make()
samples = np.array([env.reset(seed=seed)[0]["privileged"] for seed in range(500)])
print(env.observation_space)
print(f"standard deviation of the privileged value over resets: {samples.std(axis=0)}")

# %% [markdown]
# What should be privileged? *What the robot would ask if it could ask one question*: low-dimensional, and constant or slow; it
# must make the task easy for a policy without memory, and it must be possible to find out. Not: noise, or what nobody can ever
# observe, because then σ never falls and Eq. 2 leaves no reward.
#
# ## Train, as PPO


# %%
class Log(BaseCallback):
    """Keeps every rollout's metrics."""

    def __init__(self):
        super().__init__()
        self.rows = []

    def _on_step(self):
        return True

    def _on_rollout_start(self):
        rate = np.mean(self.model.ep_success_buffer) if self.model.ep_success_buffer else np.nan
        self.rows.append({"success": rate, **self.model.logger.name_to_value})


def train(algorithm, scale=0.25, rewards=None, **arguments):
    begin = time.process_time()
    venv = make_vec_env(lambda: make(scale, **(rewards or {})), n_envs=32, seed=0)
    model = algorithm(
        "MlpPolicy",
        venv,
        n_steps=32,
        batch_size=256,
        n_epochs=8,
        learning_rate=1e-3,
        gamma=0.9,
        encoder_updates=8,
        encoder_batch_size=512,
        policy_kwargs=dict(encoder_kwargs=dict(hidden=(32,), trunk=(32,), embedding=(32,), leak=1.0)),
        seed=1,
        **arguments,
    )
    log = Log()
    model.learn(1024 if FAST else 30_000, callback=log)
    result = evaluate(model, venv, 10 if FAST else 200)
    print(
        f"deployment {result['success_rate']:6.1%} (privileged {result['privileged_success_rate']:6.1%}) after "
        f"{result['mean_length']:.1f} decisions; {time.process_time() - begin:.0f} s of one core"
    )
    return model, log.rows


print("RMA:  ", end="")
train(RMA)
print("USPL: ", end="")
model, log = train(USPLPPO)

# %% [markdown]
# RMA opens at once, and is right in half of the cases. USPL's player shakes first. Let us watch it through `predict`, which never
# sees the privileged value:

# %%
names = ("shake", "open left", "open right")
for seed in (1, 2, 3):
    obs, _ = env.reset(seed=seed)
    prize, state, over, story = obs["privileged"][0], None, False, []
    while not over:
        action, state = model.predict(obs, state, deterministic=True)
        story.append(f"{names[int(action)]} (μ {state.belief_mean[0, 0]:+.2f}, σ {state.uncertainty[0, 0]:.2f})")
        obs, _, terminated, truncated, info = env.step(action)
        over = terminated or truncated
    print(f"prize at {prize:+.2f}: {', '.join(story)} -> {'right' if info['is_success'] else 'wrong'}")

# %% [markdown]
# ## Reading the log
#
# [docs/metrics.md](../docs/metrics.md) explains every metric. The four that tell how USPL is doing:

# %%
shown = (
    ("success", "success of the privileged policy", PRIVILEGED_COLOUR),
    ("uspl/uncertainty", "σ", SIGMA_COLOUR),
    ("uspl/prediction_error", "prediction error", "0.3"),
    ("uspl/reward_scale", "factor on the reward", DEPLOYMENT_COLOUR),
)


def draw(logs):
    figure, axes = plt.subplots(1, 4, figsize=(11, 2.5), dpi=90, layout="constrained")
    for (name, rows), dashes in zip(logs.items(), ("-", "--", ":"), strict=False):
        for axis, (key, title, colour) in zip(axes, shown, strict=True):
            axis.plot([row.get(key, np.nan) for row in rows], dashes, color=colour, label=name)
            axis.set(title=title, xlabel="rollout", ylim=(0.0, None))
    axes[0].legend(fontsize="x-small", loc="lower left")
    figure.align_labels()
    plt.show()


draw({"healthy": log})

# %% [markdown]
# Healthy: success is 1 when the warm-up ends and dips while blur and reward scaling set in. σ falls from its starting value, 0.5, to
# the scale of ignorance, 0.25, and stays there until the player finds out what shaking is for; then it falls on, and the prediction
# error with it. The factor on the reward first falls (what is gained without knowledge counts little), then rises as the policy
# learns to know first. Success comes back with it; it is that of the *exploring* privileged policy over the last 100 episodes,
# which still opens a box by chance in between. The deployment policy without exploration was measured above.
#
# ## What went wrong? A gallery
#
# **1. Negative rewards.** A cost for every shake and a penalty for the wrong box, no prize: to a PPO user the same task.

# %%
print("negative rewards: ", end="")
_, negative = train(USPLPPO, rewards=dict(right=0.0, wrong=-3.0, shaking=-0.2))
draw({"healthy": log, "negative rewards": negative})

# %% [markdown]
# The deployment policy guesses. Eq. 2 multiplies the reward by 0.05 while the player knows nothing and by up to 3 when it knows: if
# rewards are losses, **ignorance is bliss**. The symptom: σ stays up, and the factor stays at the bottom until the end. The cure: pay
# for success and progress, as the paper's tasks do, and let time be punished by the discount.
#
# **2. The uncertainty hack.** σ falls although nothing was looked at, the prediction error falls with it, and the deployment policy
# is at chance: the encoder reads the truth off the policy's behaviour. [Notebook 2](02_belief.ipynb) shows it; the cure is more
# mismatched episodes. Here it cannot happen: whoever opens a box is done.
#
# ## Exercises
#
# 1. Values that are too small: train with `scale=0.01`. Where do σ and the factor on the reward begin, and why? Did it matter here?
# 2. Set `warmup_timesteps=0, ramp_timesteps=0`. What becomes of the four curves?
# 3. Make the boxes rattle truthfully in 80 % of the shakes only. How often does the player shake now, and is σ honest about it?
# 4. Three boxes: what is the standard deviation of -1, 0, 1 with equal chances? Choose the scale. Then declare the value discrete
#    (`discrete_privileged={0: [...]}`), so that Eq. 4 applies to it.
# 5. Take an environment of your own. Write down the answer to "what would it ask?" before you write the wrapper.
