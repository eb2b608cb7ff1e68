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
# # 3 · Blur and reward
#
# USPL changes two things in what PPO sees, both driven by the encoder's uncertainty σ (notebook 2): the privileged observation
# is blurred (Eq. 3 and 4), and the reward is scaled (Eq. 2). This notebook turns their knobs, works out what they make a robot
# *want*, and at the end trains without the one and without the other.

# %%
import importlib.util
import os

missing = [name for name in ("sb3_uspl", "matplotlib", "ipywidgets") if importlib.util.find_spec(name) is None]
if missing:
    raise SystemExit(f"This notebook needs {missing}: run `pip install -e '.[zoo,notebooks]'` in the repository.")
FAST = os.environ.get("SB3_USPL_FAST_NOTEBOOKS") == "1"  # for the test suite: everything runs, nothing is learned

# %%
import time
from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np
import torch as th
from ipywidgets import FloatLogSlider, FloatSlider, interact

from sb3_uspl import minimal
from sb3_uspl.pictures import DEPLOYMENT_COLOUR, PRIVILEGED_COLOUR, SIGMA_COLOUR
from sb3_uspl.schedules import cosine_progress
from sb3_uspl.uncertainty import blur_continuous, blur_discrete, reward_coefficient

th.set_num_threads(1)
rng = np.random.default_rng(0)

# %% [markdown]
# ## Eq. 2: the reward
#
# $$\hat r = [(1-d)(1-\ell)+d]\,r,\qquad d = \mathrm{clip}(C_{\min}-\log\bar\sigma,\,0,\,C_{\max})+\delta$$
#
# Above $\sigma=e^{C_{\min}}$ only δ is left of the reward; below, it grows with every halving of σ. Each picture is drawn once
# with the paper's constants; in a running notebook the sliders below it redraw it.


# %%
def draw_reward(sigma_of_no_reward=0.2, sigma_of_full_reward=0.01, delta=0.05, progress=1.0):
    c_min = np.log(sigma_of_no_reward)
    c_max = c_min - np.log(sigma_of_full_reward)
    sigma = np.geomspace(0.004, 0.6, 300)
    plt.figure(figsize=(6.2, 2.8), dpi=90, layout="constrained")
    for level in (0.0, 0.5, progress):
        factor = reward_coefficient(sigma[:, None], level, c_min, c_max, delta)
        plt.plot(sigma, factor, color=SIGMA_COLOUR, alpha=0.3 + 0.7 * level, label=f"ℓ = {level:g}")
    plt.axvline(sigma_of_no_reward, color="0.6", linestyle=":")
    plt.xscale("log")
    plt.xlabel("mean uncertainty σ")
    plt.ylabel("factor on the reward")
    plt.legend()
    plt.show()


draw_reward()
for sigma in (0.2, 0.1, 0.05, 0.01):
    print(f"σ = {sigma:4.2f}: the reward counts {reward_coefficient(np.array([[sigma]]), 1.0)[0]:4.2f} times")

# %%
interact(
    draw_reward,
    sigma_of_no_reward=FloatLogSlider(0.2, min=-2, max=0),
    sigma_of_full_reward=FloatLogSlider(0.01, min=-3, max=-1),
    delta=FloatSlider(0.05, min=0.0, max=0.5, step=0.01),
    progress=FloatSlider(1.0, min=0.0, max=1.0),
)

# %% [markdown]
# The scale matters: a privileged value that nobody can guess must have a standard deviation of about 0.2, so that ignorance lies
# where the factor is smallest. With values ten times larger σ would hardly ever come below 0.2, and no reward would be left.
#
# ## Eq. 3: the blur
#
# $\hat o_p = \mathrm{clip}(o_p + \ell K\sigma\epsilon)$, with $\epsilon$ uniform in $[-1, 1]$. Take Target Reaching: the truth is
# -0.2 or +0.2. How often is each value shown if the truth is **+0.2**?


# %%
def show_many(sigma, gain, progress, n=4_000 if FAST else 40_000):
    truth = np.full((n, 1), 0.2)
    return blur_continuous(truth, np.full_like(truth, sigma), rng.uniform(-1, 1, (n, 1)), gain, progress, -0.2, 0.2)[:, 0]


def draw_blur(gain=10.0, progress=1.0):
    _, axes = plt.subplots(1, 4, figsize=(10, 2.3), dpi=90, sharey=True, layout="constrained")
    for axis, sigma in zip(axes, (0.2, 0.05, 0.02, 0.005), strict=True):
        shown = show_many(sigma, gain, progress)
        axis.hist(
            shown, bins=np.linspace(-0.21, 0.21, 22), weights=np.full(len(shown), 1 / len(shown)), color=PRIVILEGED_COLOUR
        )
        axis.set(title=f"σ = {sigma}", xlabel="shown", ylim=(0, 1))
    axes[0].set_ylabel("share of the decisions")
    plt.show()


draw_blur()
shown = show_many(0.2, 10.0, 1.0)
print(
    f"σ = 0.2: wrong end {(shown <= -0.2).mean():.0%}, right end {(shown >= 0.2).mean():.0%}, between {(np.abs(shown) < 0.2).mean():.0%}"
)

# %%
interact(draw_blur, gain=FloatSlider(10.0, min=0.0, max=50.0), progress=FloatSlider(1.0, min=0.0, max=1.0))
# %% [markdown]
# With the paper's K = 10 somebody who knows nothing is shown the right end in half of the decisions and the wrong one in two
# fifths. That is not quite nothing: who could remember what was shown would find out.

# %%
figure, axis = plt.subplots(figsize=(5.5, 2.6), dpi=90, layout="constrained")
for gain, dashes in ((2.0, ":"), (10.0, "-"), (40.0, "--")):
    looks = show_many(0.2, gain, 1.0).reshape(-1, 40)
    guesses = np.cumsum(np.sign(looks), axis=1)
    right = (guesses > 0).mean(0) + 0.5 * (guesses == 0).mean(0)
    axis.plot(1 + np.arange(40), right, dashes, color=PRIVILEGED_COLOUR, label=f"K = {gain:g}")
axis.set(xlabel="independent looks", ylabel="right guesses", ylim=(0.45, 1.02), title="σ = 0.2, majority of the looks")
axis.legend()
plt.show()

# %% [markdown]
# A policy without memory cannot count looks, but it can write them down: by walking a step towards each, so that its *position*
# is the sum. This is why the noise is held for some time (`blur_hold_time`, 0.2 s) rather than drawn at every decision, and why
# σ must not fall too early (smoothing).
#
# ## Eq. 4: discrete values
#
# A column's index cannot be blurred by adding noise. With probability ℓσ it is replaced by a value drawn from all.

# %%
truth, n = np.full((40_000, 1), 0.25), 40_000
for sigma in (0.5, 0.2, 0.02):
    replacement = rng.choice([0.0, 0.25, 0.5], (n, 1))
    shown = blur_discrete(truth, np.full_like(truth, sigma), rng.random((n, 1)), replacement, 1.0)
    print(f"σ = {sigma:4.2f}: another value is shown in {(shown != truth).mean():5.1%} of the decisions")

# %% [markdown]
# A third of the replacements are the truth itself. Compare with Eq. 3: at the σ of knowing nothing (0.2) the truth is shown in
# almost nine decisions out of ten. Eq. 4 is the weaker veil by far.
#
# ## The progress coefficient
#
# Both set in slowly (App. C.3.1): first the policy learns the task, then to doubt.

# %%
steps = np.linspace(0, 1, 200)
plt.figure(figsize=(5.5, 2.0), dpi=90, layout="constrained")
plt.plot(steps, [cosine_progress(step, 0.15, 0.4) for step in steps], color="0.3")
plt.xlabel("share of the training")
plt.ylabel("ℓ")
plt.show()

# %% [markdown]
# ## What does the scaled reward want?
#
# Before training, let us compute what each of four rules in Target Reaching earns under Eq. 2 at ℓ = 1, with an ideal σ: 0.2
# until the first wall has been reached, 0.01 after it.


# %%
def earn(rule, gamma=0.98, n=4000):
    """Discounted return with and without Eq. 2, and mean length."""
    world = minimal.TargetReaching(n, np.random.default_rng(0))
    running, length, known = np.ones(n, dtype=bool), np.zeros(n), np.zeros(n, dtype=bool)
    returns = np.zeros((2, n))
    for t in range(world.HORIZON):
        goal = rule(world, known)
        way = np.stack([goal - world.position[:, 0], -world.position[:, 1]], axis=1)
        sigma = np.where(known, 0.01, 0.2)[:, None]
        reward, ended = world.step(np.clip(10.0 * way, -1.0, 1.0))
        scaled = reward * minimal.reward_coefficient(sigma, 1.0, minimal.USPL)
        returns += gamma**t * running * np.stack([reward, scaled])
        length += running
        running &= ~ended
        known |= np.abs(world.position[:, 0]) > 0.66
    return *returns.mean(1), length.mean()


rules = {
    "knows: straight to the target": lambda world, known: world.target[:, 0],
    "knows: to the other wall first": lambda world, known: np.where(known, 1.0, -1.0) * world.target[:, 0],
    "left, then right": lambda world, known: np.where(known, 0.8, -0.8),
    "right, then left": lambda world, known: np.where(known, -0.8, 0.8),
}
print("                                  reward   scaled reward   decisions")
for name, rule in rules.items():
    plain, scaled, length = earn(rule)
    print(f"{name:32s}  {plain:6.2f}   {scaled:13.2f}   {length:9.1f}")

# %% [markdown]
# Read it line by line. Under the task's own reward, going straight is best: this is what vanilla privileged learning teaches.
# Under Eq. 2 going straight earns next to nothing, **although the target is reached**, because nobody knew, and whoever
# finds out first earns thirty times as much and more. And there is a surprise: *right, then left* earns more than *left, then
# right*, though the target is more often at the left. A target found by chance at the first wall is hardly rewarded, one found
# by knowing is rewarded three times over. Eq. 2 has no interest in being lucky, and pays for exploration whether it was needed
# or not: here, for looking at the *less* likely side first, which costs 1.4 decisions on average. Taken to the extreme it would pay a
# policy that knows to go to the *wrong* wall first (second line); the blur is what keeps it from knowing.
#
# ## Without the one, without the other
#
# So much for wanting. Now train: USPL, USPL without the blur, USPL without the scaled reward, one seed each, with everything else as
# in notebook 1.

# %%
ablations = {
    "USPL": minimal.USPL,
    "without blur": replace(minimal.USPL, blur=False),
    "without reward scaling": replace(minimal.USPL, reward_scaling=False),
}
if FAST:
    ablations = {name: replace(s, iterations=3, episodes=8, encoder_episodes=4) for name, s in ablations.items()}
agents, logs = {}, {}
for name, settings in ablations.items():
    begin = time.process_time()
    agents[name], logs[name] = minimal.train(settings)
    print(f"{name:22s} {time.process_time() - begin:4.0f} s of one core")

# %%
n = 20 if FAST else 500
figure, axes = plt.subplots(2, 3, figsize=(10, 4.6), dpi=90, sharey="row", layout="constrained")
print("                         success of the deployment policy   decisions   mean σ   success of the privileged policy")
for (above, below), (name, settings) in zip(axes.T, ablations.items(), strict=True):
    above.plot([row["privileged"] for row in logs[name]], color=PRIVILEGED_COLOUR, label="privileged policy (training)")
    above.plot([row["deployment"] for row in logs[name]], color=DEPLOYMENT_COLOUR, label="deployment policy")
    above.plot([row["uncertainty"] for row in logs[name]], color=SIGMA_COLOUR, label="σ (training)")
    above.plot([row["progress"] for row in logs[name]], "--", color="0.5", label="ℓ")
    above.set(title=name, xlabel="iteration")
    deployed, knowing = (
        minimal.play(agents[name], settings, n, np.random.default_rng(7), who, progress=1.0)
        for who in ("deployment", "privileged")
    )
    for i in range(12):
        length = int(deployed["running"][:, i].sum())
        below.plot(deployed["tokens"][:length, i, 0], color=DEPLOYMENT_COLOUR, alpha=0.6)
    below.set(xlabel="decision", ylim=(-1.05, 1.05))
    print(
        f"{name:24s} {minimal.success_rate(deployed):20.1%} {deployed['running'].sum(0).mean():23.1f} "
        f"{deployed['std'][deployed['running']].mean():10.3f} {minimal.success_rate(knowing):20.1%}"
    )
axes[0, 0].legend(fontsize="x-small")
axes[1, 0].set_ylabel("x, deployment policy")
plt.show()

# %% [markdown]
# One training each proves little (notebook 8); the paper's Table 2 has more. Look at three things. Does the deployment policy turn
# at the first wall (lower row)? Does σ fall below that of knowing nothing, 0.2 (purple)? And how does the privileged policy do under
# the noise that it was trained with (table)? Without the blur, nothing keeps the privileged policy from using what it is shown.
# Without the scaled reward, nothing is paid for finding out *before* arriving: only the noise is left to teach it.
#
# ## Exercises
#
# 1. For which σ does the factor of Eq. 2 equal 1? What happens to a *negative* reward on both sides of it? (Notebook 7 shows a
#    run that was ruined by that.)
# 2. Show that Eq. 2 makes ignorance pay if all rewards are negative. What would you change in the task?
# 3. Compute the share of wrong ends in the blur's histogram by hand for any K and σ, and the K at which it exceeds 45 %.
# 4. Complete the paper's Table 2, small: `uncertainty_input=False`, and neither blur nor reward scaling ("only UI"), with three
#    seeds each. A minute of one core a training. Which of the differences are larger than those between seeds?
# 5. Which δ makes *left, then right* at least as good as *right, then left*? Use `dataclasses.replace` on `minimal.USPL` in `earn`.
