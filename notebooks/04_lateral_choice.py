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
# # 4 · Lateral Choice
#
# The same idea on a robot in PyBullet: a quadruped in a corridor, a goal at one of its ends, and nothing to sense but its own
# pose. You will build the scene, load the agent that comes with the repository (or train one in five minutes), film it, see
# its uncertainty over time (Fig. 10 of the paper) and set that uncertainty by hand (Fig. 15).

# %%
import importlib.util
import os

needed = ("sb3_uspl", "bullet_tasks", "pybullet", "matplotlib")
missing = [name for name in needed if importlib.util.find_spec(name) is None]
if missing:
    raise SystemExit(f"This notebook needs {missing}: run `pip install -e '.[zoo,notebooks]'` in the repository.")
FAST = os.environ.get("SB3_USPL_FAST_NOTEBOOKS") == "1"  # for the test suite: everything runs, with few episodes

# %%
import tempfile
from pathlib import Path

import gymnasium as gym
import matplotlib.pyplot as plt
import numpy as np
import torch as th
from IPython.display import Image, display
from stable_baselines3.common.env_util import make_vec_env

import sb3_uspl
from sb3_uspl import USPLPPO
from sb3_uspl.demo import film_seed
from sb3_uspl.evaluation import run_episodes, success_rate
from sb3_uspl.film import film
from sb3_uspl.pictures import DEPLOYMENT_COLOUR, PRIVILEGED_COLOUR, sigma_over_time

th.set_num_threads(1)
ENV = "LateralChoice-v0"

# %% [markdown]
# ## The scene
#
# A scene is data: named shapes, which PyBullet, the compiled physics and the depth camera all read.

# %%
env = gym.make(ENV, render_mode="rgb_array", max_episode_steps=6 if FAST else None)
seed = film_seed(env)  # the first evaluation episode whose goal lies behind the robot
obs, info = env.reset(seed=seed)
for shape in env.unwrapped.scene.shapes:
    print(shape)
print({key: value.shape for key, value in obs.items()}, "goal:", env.unwrapped.task.goal)
plt.figure(figsize=(8, 2.6), dpi=90)
plt.imshow(env.render())
plt.axis("off")
plt.show()

# %% [markdown]
# The `common` observation is the robot's pose; `privileged` is the goal, which the deployed robot is not told.
#
# ## The agent
#
# Training takes five minutes on one core:
#
# ```sh
# OMP_NUM_THREADS=1 python -m sb3_uspl.train --algo uspl_ppo --env LateralChoice-v0 --seed 1 -f logs
# ```
#
# Its result is in the repository. Set `AGENT` to your own to see yours.

# %%
AGENT = Path(sb3_uspl.__file__).parent.parent / "trained_agents/uspl_ppo/LateralChoice-v0_1/LateralChoice-v0.zip"
if not AGENT.is_file():
    raise SystemExit(f"{AGENT} is not there: run this notebook in a clone of the repository, or train as shown above.")
model = USPLPPO.load(AGENT, device="cpu")

# %% [markdown]
# ## A film

# %%
with tempfile.TemporaryDirectory() as folder:
    clips = film({"USPL": model}, env, [seed], Path(folder) / "film.gif")
    display(Image(data=(Path(folder) / "film.gif").read_bytes(), format="gif"))
print("reached the goal:", [clip.success for clip in clips])

# %% [markdown]
# ## Both policies, side by side
#
# The deployment policy (encoder's mean) and the privileged policy (true goal, same uncertainty) on the same episodes.

# %%
n = 4 if FAST else 40
# The compiled physics walks as PyBullet's does and is several times faster.
venv = make_vec_env(ENV, n_envs=min(n, 40), seed=0, env_kwargs=dict(physics="compiled"))
records = {policy: run_episodes(model, venv, n, policy=policy) for policy in ("deployment", "privileged")}
figure, axes = plt.subplots(2, 1, figsize=(8, 4), dpi=90, sharex=True, layout="constrained")
for axis, (policy, episodes), colour in zip(axes, records.items(), (DEPLOYMENT_COLOUR, PRIVILEGED_COLOUR), strict=True):
    for record in episodes[:12]:
        path = np.stack(record.positions)
        axis.plot(path[:, 0], path[:, 1], color=colour, alpha=0.6)
        axis.plot(*path[-1][:2], "o", color=colour, markersize=4)
    rate, low, high = success_rate(episodes)
    axis.set(title=f"{policy} policy: {rate:.0%} of {n} ({low:.0%}-{high:.0%})", ylabel="y (m)")
axes[1].set_xlabel("x (m)")
plt.show()

# %% [markdown]
# The privileged policy explores too, although it could see the goal: that is what USPL is for. Compare with notebook 1's vanilla.
#
# ## Uncertainty over time (Fig. 10)

# %%
task = env.unwrapped.task
with tempfile.TemporaryDirectory() as folder:
    picture = Path(folder) / "uncertainty.png"
    sigma_over_time({"USPL": records["deployment"]}, task.decision_period, picture, task.belief_in_world)
    display(Image(data=picture.read_bytes(), width=560))

# %% [markdown]
# About half of the episodes end at the first end (lowest panel), never having known. In the others σ collapses, and the error with it.
#
# ## The uncertainty set by hand (Fig. 15)
#
# σ is an input of the policy, so we can lie to it. The truth is shown as it is; only σ is replaced.

# %%
figure, axes = plt.subplots(1, 3, figsize=(11, 2.7), dpi=90, sharex=True, sharey=True, layout="constrained")
for axis, sigma in zip(axes, (0.25, 0.05, 0.005), strict=True):
    told = run_episodes(model, venv, n, policy="privileged", uncertainty=sigma)
    towards = np.mean(
        [np.sign(r.positions[min(12, len(r) - 1)][0] - r.positions[0][0]) == np.sign(r.truth[0][0]) for r in told]
    )
    for record in told[:12]:
        axis.plot(np.stack(record.positions)[:, 0], color=PRIVILEGED_COLOUR, alpha=0.6)
    axis.set(title=f"told σ = {sigma}: {success_rate(told)[0]:.0%} success", xlabel="decision")
    print(f"told σ = {sigma:5.3f}: first towards the goal in {towards:4.0%}, {np.mean([len(r) for r in told]):5.1f} decisions")
axes[0].set_ylabel("x (m)")
plt.show()
venv.close()
env.close()

# %% [markdown]
# All start as they always do: to the end that they face, although they are shown where the goal is. The difference is what comes
# then. Told all the time that it knows nothing, the robot turns and tries the other end, but not always in time or in the right
# place. Told from the first decision that it knows, which never happened in training, it has no reason to turn back: at the wrong
# end its path stops, over the edge (early) or on the spot (until the time is up), and success is the share of right first ends. σ
# decides whether it goes on looking, so σ must be honest: that is what notebook 2 is about. (In the paper's Fig. 15 the robot is
# told so after it has explored: exercise 1.)
#
# ## Exercises
#
# 1. Let the robot explore for 24 decisions, then set σ by hand (`model.policy.act(..., privileged=..., uncertainty=...)`): low, with
#    the true goal; low, with the wrong one; high again half-way. What does it do each time?
# 2. Film RMA beside USPL: `make demo` trains both.
# 3. Evaluate the agent with legs: `python -m sb3_uspl.evaluate --algo uspl_ppo --env LateralChoice-v0 --physics full`.
# 4. Find the σ at which the policy changes its mind, to within 0.01, by bisection.
