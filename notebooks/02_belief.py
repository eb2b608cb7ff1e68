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
# # 2 · The belief
#
# The observation encoder turns what the robot has seen and done into a belief about what it cannot see: a mean μ and a standard
# deviation σ. This notebook trains it by maximum likelihood (Eq. 1), asks whether its σ can be believed, shows what a Gaussian
# does to "left or right", and why a quarter of the training episodes are *mismatched*.

# %%
import importlib.util
import os

missing = [name for name in ("sb3_uspl", "matplotlib", "scipy") if importlib.util.find_spec(name) is None]
if missing:
    raise SystemExit(f"This notebook needs {missing}: run `pip install -e '.[zoo,notebooks]'` in the repository.")
FAST = os.environ.get("SB3_USPL_FAST_NOTEBOOKS") == "1"  # for the test suite: everything runs, nothing is learned

# %%
from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np
import torch as th
from scipy.stats import norm

from sb3_uspl import minimal
from sb3_uspl.pictures import SIGMA_COLOUR

th.set_num_threads(1)
th.manual_seed(0)
rng = np.random.default_rng(0)

# %% [markdown]
# ## An explorer's experience
#
# No reinforcement learning yet. A scripted robot in Target Reaching (notebook 1) walks to a wall chosen at random, and to the
# other one if the episode goes on, with a shaky hand. Its choice does not depend on the target.


# %%
def explore(n):
    world = minimal.TargetReaching(n, rng)
    heading = rng.choice([-0.8, 0.8], n)
    action, running = np.zeros((n, 2), dtype=np.float32), np.ones(n, dtype=bool)
    record = {name: [] for name in ("tokens", "truth", "running")}
    for _ in range(world.HORIZON):
        common, truth = world.observe()
        for name, value in zip(record, (np.concatenate([common, action], axis=1), truth, running), strict=True):
            record[name].append(value)
        heading = np.where(np.abs(world.position[:, 0] - heading) < 0.12, -heading, heading)
        way = np.stack([heading - world.position[:, 0], -world.position[:, 1]], axis=1)
        action = np.clip(10.0 * way + rng.normal(0.0, 0.5, way.shape), -1.0, 1.0).astype(np.float32)
        _, ended = world.step(action)
        running = running & ~ended
    return {name: np.stack(values) for name, values in record.items()}


episodes = explore(8 if FAST else 1500)
print({name: array.shape for name, array in episodes.items()})

# %% [markdown]
# ## Maximum likelihood
#
# Eq. 1 asks the encoder to make the truth as little surprising as possible: $-\log\mathcal N(o_p\,|\,\mu,\sigma^2)$ is the price
# of a decision. A wide σ costs $\log\sigma$, a narrow one costs $(o_p-\mu)^2/2\sigma^2$ if it is wrong.

# %%
encoder = minimal.Encoder(64)
optimizer = th.optim.Adam(encoder.parameters(), 3e-3)
losses = [minimal.update_encoder(encoder, optimizer, episodes, [], minimal.USPL, rng) for _ in range(2 if FAST else 50)]
test = explore(12 if FAST else 1000)
with th.no_grad():
    mean, log_std, _ = encoder(th.as_tensor(test["tokens"]))
mean, std = mean.numpy()[..., 0], log_std.exp().numpy()[..., 0]
truth, running = test["truth"][..., 0], test["running"]

share_left = (truth[0] < 0).mean()
knows_nothing = 0.4 * np.sqrt(share_left * (1 - share_left))
figure, axes = plt.subplots(1, 2, figsize=(9, 2.8), dpi=90, layout="constrained")
axes[0].plot(losses, color="0.3")
axes[0].set(xlabel="8 updates each", ylabel="Eq. 1", title="training")
for i in range(12):
    length = int(running[:, i].sum())
    axes[1].plot(std[:length, i], color=SIGMA_COLOUR, alpha=0.7)
axes[1].axhline(knows_nothing, linestyle=":", color="0.5")
axes[1].set(xlabel="decision", ylabel="σ", title="σ in twelve new episodes (they end at the target)", ylim=(0.0, None))
plt.show()
print(f"standard deviation of a coin with {share_left:.0%} at -0.2, the rest at +0.2: {knows_nothing:.3f}")
print(f"the encoder's σ at the first decision, on average: {std[0].mean():.3f}, its mean {mean[0].mean():+.3f}")

# %% [markdown]
# After its first observations, of which 400 updates have not taught it enough yet (exercise 1), the encoder says about what
# somebody says who knows nothing (dotted). At the first wall σ collapses, if the episode outlives it.
#
# ## What a Gaussian does to "left or right"
#
# The truth is -0.2 or +0.2, never between. The most likely *Gaussian* is centred between them, where nothing ever is.

# %%
x = np.linspace(-0.8, 0.8, 400)
figure, axes = plt.subplots(1, 2, figsize=(9, 2.6), dpi=90, layout="constrained")
late = np.flatnonzero((running.sum(0) > 18) & (truth[0] > 0))
i = late[0] if len(late) else 0
for axis, t, title in ((axes[0], 0, "at the start"), (axes[1], int(running[:, i].sum()) - 1, "at the end of the episode")):
    axis.fill_between(x, norm.pdf(x, mean[t, i], std[t, i]), color=SIGMA_COLOUR, alpha=0.4)
    axis.axvline(-0.2, color="0.6", linestyle="--")
    axis.axvline(0.2, color="0.6", linestyle="--")
    axis.plot(truth[t, i], 0.0, "*", color="gold", markeredgecolor="black", markersize=15, clip_on=False, zorder=5)
    axis.set(title=f"{title}: μ = {mean[t, i]:+.2f}, σ = {std[t, i]:.3f}", xlabel="privileged observation")
plt.show()

# %% [markdown]
# This is why showing μ alone to a policy fails (notebook 1): μ ≈ 0 does not mean "in the middle", it means "no idea", and only
# σ tells these apart. USPL does not need the belief's shape, only a number that says *how much is still to be found out*.
#
# ## Can σ be believed?
#
# If beliefs are honest, the truth lies in the central 50 % interval in half of the cases, and so on. A **reliability diagram**
# draws the measured coverage over the promised one: above the diagonal the encoder is too modest, below it is overconfident.

# %%
z = np.abs((truth - mean) / std)
confidence = np.linspace(0.05, 0.99, 40)
half_width = norm.ppf(0.5 + confidence / 2)
groups = {
    "σ > 0.15 (knows nothing)": running & (std > 0.15),
    "0.03 < σ ≤ 0.15 (on the way)": running & (std > 0.03) & (std <= 0.15),
    "σ ≤ 0.03 (knows)": running & (std <= 0.03),
}
figure, axis = plt.subplots(figsize=(4.4, 3.6), dpi=90, layout="constrained")
axis.plot([0, 1], [0, 1], ":", color="0.5")
for label, mask in groups.items():
    if mask.any():
        axis.plot(confidence, [(z[mask] < h).mean() for h in half_width], label=f"{label}: {mask.sum()} decisions")
axis.set(xlabel="promised coverage", ylabel="measured coverage")
axis.legend(fontsize="x-small")
plt.show()
print("                                 mean σ   root of mean squared error")
for label, mask in groups.items():
    if mask.any():
        print(f"{label:30s}  {std[mask].mean():7.3f}   {np.sqrt(((truth - mean)[mask] ** 2).mean()):7.3f}")

# %% [markdown]
# The steep blue curve shows the Gaussian's limits: whoever knows nothing is always about one σ off, never much less and never
# much more, so that narrow intervals hardly ever hold the truth and wide ones always do. As a *shape* the belief is wrong. As a
# *number* it is right: in the table's first line, σ and the size of the error agree. On the way, at the walls, this short training
# leaves the encoder overconfident. Where it claims to know, it is too modest in nearly all decisions and badly wrong in a few (the
# green curve stays below 1), which is why the error there is larger than σ.
#
# ## Why some episodes are mismatched
#
# Now let a privileged policy act, one that knows the target and walks straight to it. Then **the behaviour gives the target
# away**: whoever sees the robot walk left need not look. The encoder is trained on exactly these episodes, and it will cheat
# unless it also sees episodes in which the policy was shown *another episode's* target. Same training, with and without:

# %%
short = dict(iterations=3, episodes=8, encoder_episodes=4) if FAST else dict(iterations=40, episodes=128, encoder_episodes=64)
cases = {
    "a quarter mismatched": replace(minimal.VANILLA, **short),
    "none mismatched": replace(minimal.VANILLA, mismatch_fraction=0.0, **short),
}
trained = {name: minimal.train(settings)[0] for name, settings in cases.items()}


# %%
def judge(agent, settings, policy, n_mismatched):
    """The last 200 episodes; mismatched ones walk to another episode's target."""
    n = 20 if FAST else 400
    played = minimal.play(agent, settings, n, np.random.default_rng(5), policy, n_mismatched=n_mismatched)
    return {name: array[:, n // 2 :] for name, array in played.items()}


figure, axes = plt.subplots(1, 2, figsize=(9, 2.9), dpi=90, sharey=True, layout="constrained")
print(f"{'encoder':22s} {'behaviour':28s} {'σ':>6s} {'error':>6s}   at decision 5")
for axis, (name, settings) in zip(axes, cases.items(), strict=True):
    for label, mismatched, dashes in (
        ("walks to its own target", 0, "-"),
        ("walks to another's target", 10 if FAST else 200, "--"),
    ):
        played = judge(trained[name], settings, "privileged", mismatched)
        alive = played["running"]
        sigma = np.array([played["std"][t][alive[t]].mean() for t in range(14) if alive[t].any()])
        error = np.abs(played["mean"] - played["truth"])[..., 0]
        wrong = np.array([error[t][alive[t]].mean() for t in range(14) if alive[t].any()])
        axis.plot(sigma, dashes, color=SIGMA_COLOUR, label=f"σ, {label}")
        axis.plot(wrong, dashes, color="0.3", label=f"error, {label}")
        print(f"{name:22s} {label:28s} {sigma[5]:6.3f} {wrong[5]:6.3f}")
    axis.set(title=name, xlabel="decision")
axes[0].legend(fontsize="x-small")
plt.show()

# %% [markdown]
# Without mismatched episodes σ falls within a few decisions although nothing has been found out. On its own policy's episodes
# this looks like excellent work: the error is small. But when the robot walks to another episode's target (in half of the cases
# the other side), the encoder is **certain and wrong**, more and more so, and a deployment policy has to walk to the wrong side
# every other time. With mismatched episodes σ falls later, and the error falls with it when there is real evidence.
# For USPL this decides everything: its blur and its reward are driven by σ, and a policy that may have the goal by pretending
# to know it (the paper's *uncertainty hack*) will never look for it.
#
# ## Exercises
#
# 1. Train the explorer's encoder for 5, 20 and 200 rounds. Where in the reliability diagram does too little training show?
# 2. Move the target's probability to 0.9. What is the σ of knowing nothing now? Compute it first: 0.4 √(p(1-p)).
# 3. Replace the Gaussian by a mixture of two. Which of USPL's equations would have to change, and to what?
# 4. How few mismatched episodes are enough? Try `mismatch_fraction` 0.05 and 0.5.
# 5. Smoothing (App. C.3.1) is the second brake against hacking. Set `smoothing_time=0` and compare σ over time.
