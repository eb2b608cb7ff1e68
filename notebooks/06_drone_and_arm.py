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
# # 6 · The drone and the arm
#
# What the robots of the other notebooks lack is a place. Here it is a property of their own bodies and of what they touch: by how
# much the sensors lie, and which of two cubes is the right one. Nobody can look for that; it has to be *made to show itself*. The
# quadrotor lands in order to calibrate (Figs. 14 and 7 of the paper), the arm weighs in order to identify (Fig. 13). Both agents
# come with the repository; nothing is trained here.

# %%
import importlib.util
import os
from pathlib import Path

needed = ("sb3_uspl", "bullet_tasks", "pybullet", "matplotlib")
missing = [name for name in needed if importlib.util.find_spec(name) is None]
if missing:
    raise SystemExit(f"This notebook needs {missing}: run `pip install -e '.[zoo,notebooks]'` in the repository.")
FAST = os.environ.get("SB3_USPL_FAST_NOTEBOOKS") == "1"  # for the test suite: everything runs, with few episodes
AGENTS = Path(importlib.util.find_spec("sb3_uspl").origin).parent.parent / "trained_agents" / "uspl_ppo"
DRONE, ARM = "BiasedQuadrotor-v0", "BlindMassStack-v0"
paths = {name: AGENTS / f"{name}_1" / f"{name}.zip" for name in (DRONE, ARM)}
for name, path in paths.items():
    if not path.is_file():
        raise SystemExit(
            f"There is no trained agent {path}: run this notebook in a clone of the repository, or train one with "
            f"`python -m sb3_uspl.train --algo uspl_ppo --env {name}` and copy it there."
        )

# %%
import gymnasium as gym
import matplotlib.pyplot as plt
import numpy as np
import torch as th

import bullet_tasks  # noqa: F401 (registers the environments)
from sb3_uspl import USPLPPO
from sb3_uspl.evaluation import EVALUATION_SEED
from sb3_uspl.pictures import DEPLOYMENT_COLOUR, PRIVILEGED_COLOUR, SIGMA_COLOUR

th.set_num_threads(1)
seeds = EVALUATION_SEED + np.arange(3 if FAST else 50)

# %% [markdown]
# Both policies, deployed and privileged, are one network that is shown different things, so one loop plays them all. `note` says
# what to write down of the world at each decision.


# %%
def play(env, model, seed, note, privileged=False, sigma=lambda decision: None, pictures=False):
    """One episode: what was noted, belief and pictures at each decision, and whether it succeeded."""
    obs, _ = env.reset(seed=int(seed))
    story, state, over = {"noted": [], "mean": [], "std": [], "picture": []}, None, False
    while not over:
        truth = obs["privileged"][None] if privileged else None
        told = sigma(len(story["mean"]))  # None: the encoder's own σ
        action, state = model.policy.act(obs, state, deterministic=True, privileged=truth, uncertainty=told)
        story["noted"].append(note(env.unwrapped))
        story["mean"].append(state.belief_mean[0])
        story["std"].append(state.uncertainty[0])
        if pictures:
            story["picture"].append(env.render())
        obs, _, terminated, truncated, info = env.step(action)
        over = terminated or truncated
    story["noted"].append(note(env.unwrapped))
    return {**story, "truth": obs["privileged"], "success": info["is_success"]}


def draw_strip(story, moments, titles, labels, limit):
    """Pictures of some moments, and below them the belief, purple, and the hidden truth, gold."""
    _, axes = plt.subplots(2, len(moments), figsize=(2.1 * len(moments), 3.6), dpi=90, layout="constrained")
    for t, title, (above, below) in zip(moments, titles, axes.T, strict=True):
        above.imshow(story["picture"][t])
        above.set_axis_off()
        above.set_title(title, fontsize="small")
        places = np.arange(len(labels))
        mean, std = story["mean"][t], story["std"][t]
        below.bar(places, 2 * std, 0.6, bottom=mean - std, color=SIGMA_COLOUR, alpha=0.45)
        below.plot(places, mean, "_", color=SIGMA_COLOUR, markersize=14, markeredgewidth=2.5)
        below.plot(places, story["truth"], "D", color="gold", markeredgecolor="black", markersize=5)
        below.set(xlim=(-0.6, len(labels) - 0.4), ylim=(-limit, limit), xticks=places)
        below.set_xticklabels(labels, fontsize="x-small")
        below.tick_params(axis="y", labelleft=t == moments[0])
    axes[1, 0].set_ylabel("privileged units", fontsize="small")
    plt.show()


# %% [markdown]
# ## The drone: what cannot be read
#
# The quadrotor's altitude, roll and pitch sensors read false by constant amounts (up to 0.6 m and 0.2 rad), and it is to hover
# level at 1.5 m. Two pilots written by hand: one believes the readings, the other descends first, and reads the sensors when the
# ground carries it, where altitude, roll and pitch *are* zero.

# %%
drone_env = gym.make(DRONE, physics="compiled", render_mode="rgb_array")
drone_task = drone_env.unwrapped.task


def fly_to(altitude, roll=0.0, pitch=0.0):
    """The action that asks for these readings."""
    c = drone_task.config
    return np.clip([pitch / c.angle_range, roll / c.angle_range, (altitude - c.middle_altitude) / c.altitude_range], -1, 1)


def pilot(lands, seed):
    """True and read altitude over an episode, the biases and whether the hover succeeded."""
    obs, _ = drone_env.reset(seed=int(seed))
    believed, over, altitudes = None if lands else np.zeros(3), False, []
    while not over:
        read = obs["common"][:3] * (4.0, 0.5, 0.5)  # m, rad, rad
        altitudes.append((drone_env.unwrapped.robot.state.altitude, read[0]))
        if obs["common"][7] > 0.5:  # standing on the ground
            believed = read
        action = fly_to(read[0] - 0.5) if believed is None else fly_to(1.5 + believed[0], *believed[1:])
        obs, _, terminated, truncated, info = drone_env.step(action.astype(np.float32))
        over = terminated or truncated
    return np.array(altitudes), drone_task.biases, info["is_success"]


figure, axes = plt.subplots(1, 2, figsize=(9, 2.8), dpi=90, sharey=True, layout="constrained")
for axis, lands, title in zip(axes, (False, True), ("believes its sensors", "lands first"), strict=True):
    altitudes, biases, success = pilot(lands, seeds[0])
    time = drone_task.decision_period * np.arange(len(altitudes))
    axis.axhspan(1.35, 1.65, color="0.9")
    axis.plot(time, altitudes[:, 0], color=DEPLOYMENT_COLOUR, label="true altitude")
    axis.plot(time, altitudes[:, 1], "--", color="0.4", label="as it is read")
    rate = np.mean([pilot(lands, seed)[2] for seed in seeds])
    axis.set(title=f"{title}: {rate:.0%} of {len(seeds)} flights", xlabel="time (s)")
axes[0].set_ylabel("altitude (m)")
axes[1].legend(fontsize="small")
plt.show()
print("biases of this flight: {:+.2f} m, {:+.2f} rad, {:+.2f} rad".format(*biases))

# %% [markdown]
# The band is where the hover counts, if it is level as well: the first flight is high enough by luck, and tilted. The two curves of
# a flight have the same shape: **nothing in the readings of a flight says by how much they are wrong**, however long one looks.
# Landing makes the difference visible. (The second flight ends where the first goes on: a success ends the episode.)
#
# ## What the trained drone does (Fig. 14)

# %%
drone = USPLPPO.load(paths[DRONE], device="cpu")


def note_flight(world):
    state = world.robot.state
    return state.altitude, state.roll, state.pitch


def first_touch(story):
    """The first decision at which the quadrotor is on the ground (or a landing gear's length from it)."""
    low = np.flatnonzero(np.array(story["noted"])[:, 0] < 0.02)
    return int(low[0]) if len(low) else None


story = play(drone_env, drone, seeds[0], note_flight, pictures=True)
last = len(story["mean"]) - 1
touch = first_touch(story) or last // 2
moments = [0, touch // 2, touch - 1, min(touch + 1, last), min(touch + 5, last), last]
altitudes = np.array(story["noted"])[:, 0]
titles = [f"{drone_task.decision_period * t:.1f} s, at {altitudes[t]:.2f} m" for t in moments]
draw_strip(story, moments, titles, ["altitude", "roll", "pitch"], 0.65)
print("hover held:", story["success"])

# %% [markdown]
# Purple is the belief about the three biases, gold the truth, which is hidden from the policy. In the air, the belief is wide. On
# the ground it closes on the truth, and the quadrotor takes off again. Fifty flights, laid on top of each other at the moment
# of the first touch-down:

# %%
stories = [play(drone_env, drone, seed, note_flight) for seed in seeds]
landed = [story for story in stories if first_touch(story) is not None]
print(f"success in {np.mean([s['success'] for s in stories]):.0%} of {len(stories)} flights; landed in {len(landed)} of them")

figure, axes = plt.subplots(1, 2, figsize=(9, 2.9), dpi=90, sharex=True, layout="constrained")
for story in landed[:40]:
    time = drone_task.decision_period * (np.arange(len(story["mean"])) - first_touch(story))
    axes[0].plot(time, np.array(story["noted"])[:-1, 0], color=DEPLOYMENT_COLOUR, alpha=0.25)
    axes[1].plot(time, np.stack(story["std"]).mean(1), color=SIGMA_COLOUR, alpha=0.25)
axes[0].set(xlabel="time since touch-down (s)", ylabel="true altitude (m)")
axes[1].set(xlabel="time since touch-down (s)", ylabel="mean σ")
axes[1].axvline(0.0, color="0.6", linestyle=":")
axes[1].set_ylim(0.0, None)
plt.show()

print("                      σ of altitude, roll, pitch     error")
for label, shift in (("just before the ground", -1), ("1 s after touch-down", 5)):
    at = [(s, first_touch(s) + shift) for s in landed if 0 <= first_touch(s) + shift < len(s["mean"])]
    sigma = np.mean([s["std"][t] for s, t in at], axis=0)
    error = np.mean([np.abs(s["mean"][t] - s["truth"]) for s, t in at], axis=0)
    print(f"{label:23s}", np.round(sigma, 3), "          ", np.round(error, 3))

# %% [markdown]
# Only the altitude's σ falls before the ground is reached: whoever is still flying at a small *reading* has excluded the biases with
# which that would be underground. (There the encoder is a little too sure: its error is as large as its σ.) Roll and pitch become
# known at the touch, all at once, and the σ that is shown follows within a second (it is smoothed, App. C.3.1).
#
# ## The uncertainty set by hand (Fig. 7)
#
# Now the *privileged* policy: it is shown the true biases from the first moment on. Only σ is ours. Three settings, as in the
# paper: high for 5 s and low from then on; high for 2 s and low for 1 s in turns; the encoder's own. And one more: low at once.

# %%
HIGH, LOW = 0.25, 0.02
period = drone_task.decision_period
settings = {
    "high, from 5 s on low": lambda t: HIGH if t * period < 5 else LOW,
    "high and low in turns": lambda t: HIGH if t * period % 3 < 2 else LOW,
    "the encoder's": lambda t: None,
    "low from the start": lambda t: LOW,
}
shape = dict(sharex=True, sharey="row", height_ratios=(2, 1))
figure, axes = plt.subplots(2, 4, figsize=(11, 4.0), dpi=90, layout="constrained", **shape)
for (above, below), (name, sigma) in zip(axes.T, settings.items(), strict=True):
    told = [play(drone_env, drone, seed, note_flight, privileged=True, sigma=sigma) for seed in seeds]
    above.axhspan(1.35, 1.65, color="0.9")
    for story in told[:8]:
        time = period * np.arange(len(story["mean"]))
        above.plot(time, np.array(story["noted"])[:-1, 0], color=PRIVILEGED_COLOUR, alpha=0.6)
        shown = [np.mean(story["std"][t]) if sigma(t) is None else sigma(t) for t in range(len(time))]
        below.plot(time, shown, color=SIGMA_COLOUR, alpha=0.6, drawstyle="steps-post")
    rate = np.mean([story["success"] for story in told])
    above.set_title(f"{name}: {rate:.0%}", fontsize="medium")
    below.set(xlabel="time (s)", ylim=(0.0, 0.4))
    went_down = np.mean([first_touch(story) is not None for story in told])
    print(f"{name:22s} success {rate:4.0%}   touches the ground in {went_down:4.0%} of the flights")
axes[0, 0].set_ylabel("true altitude (m)")
axes[1, 0].set_ylabel("σ shown")
plt.show()

# %% [markdown]
# While σ is high, this policy, which *is shown the answer*, goes down and stays at or near the ground; when σ falls, it takes off, and
# when σ rises again, it comes back down. That is what the blur has taught it: a high σ means that what it is shown is not to be
# trusted. Told from the start that it knows, it does not land, and although it is shown the true biases it hovers in the wrong place
# nearly always. In training that never happened: σ was low after landings only. Such a policy can be trusted as far as its σ.
#
# ## The arm: what has to be weighed
#
# Three cubes; the robot knows which one is green (1 kg). It is to put the *red* one (0.75 kg) on it, not the blue one, whose mass
# differs from red's by 15-35 % either way. It cannot see colours, but its hand weighs what it lifts. The scale multiplies by an
# unknown factor between 1/2 and 2. Let us weigh all three by hand:

# %%
arm_env = gym.make(ARM, physics="compiled", render_mode="rgb_array")
arm_task = arm_env.unwrapped.task
LOW_HEIGHT, CARRYING, OPEN, CLOSE = 0, 2, 0, 1


def weigh(cube):
    """Lift a cube, read the scale (kg), put it down."""
    arm_env.step(np.array([cube, LOW_HEIGHT, CLOSE]))
    obs = arm_env.step(np.array([cube, CARRYING, CLOSE]))[0]
    arm_env.step(np.array([cube, LOW_HEIGHT, OPEN]))
    return 0.25 * np.exp(0.5 * obs["common"][19:22].max())


readings = {"red": [], "green": [], "blue": []}
for seed in np.arange(20 if FAST else 200):
    arm_env.reset(seed=int(seed))
    for name in readings:
        readings[name].append(weigh(getattr(arm_task, name)))
readings = {name: np.array(values) for name, values in readings.items()}

figure, axes = plt.subplots(1, 2, figsize=(9, 2.8), dpi=90, layout="constrained")
edges = (np.geomspace(0.25, 2.2, 30), np.linspace(0.5, 1.1, 40))
for name, colour in (("red", "#D52A24"), ("blue", "#264FCC")):
    axes[0].hist(readings[name], edges[0], color=colour, alpha=0.5, label=name)
    axes[1].hist(readings[name] / readings["green"], edges[1], color=colour, alpha=0.5, label=name)
axes[0].set(xscale="log", xlabel="reading (kg)", title="what the scale says", ylabel="episodes")
axes[0].set_xticks([0.3, 0.5, 1.0, 2.0], ["0.3", "0.5", "1", "2"])
axes[0].minorticks_off()
axes[1].set(xlabel="reading / reading of green", title="what it says beside what it says of green")
axes[1].legend()
plt.show()
raw = np.abs(np.log(readings["red"] / 0.75)) < np.abs(np.log(readings["blue"] / 0.75))
calibrated = np.abs(readings["red"] / readings["green"] - 0.75) < np.abs(readings["blue"] / readings["green"] - 0.75)
print(f"whose reading is nearer to 0.75 kg? red in {raw.mean():.0%}; calibrated with green: in {calibrated.mean():.0%}")

# %% [markdown]
# One reading says next to nothing. The green cube is worth nothing in itself, and everything as a weight: it calibrates the scale.
#
# ## What the trained arm does (Fig. 13)

# %%
arm = USPLPPO.load(paths[ARM], device="cpu")


def note_weighing(world):
    """The cube that hangs free, so that the scale reads, by its colour; None if there is none."""
    state, task = world.robot.state, world.task
    return {task.red: "red", task.green: "green", task.blue: "blue"}[state.held] if state.load > 0 else None


weighings = [play(arm_env, arm, seed, note_weighing) | {"blue": 0.3 * (arm_task.blue - 1)} for seed in seeds]
right = [seed for seed, story in zip(seeds, weighings, strict=True) if story["success"] and "red" in story["noted"]]
story = play(arm_env, arm, right[0] if right else seeds[0], note_weighing, pictures=True)
moments = range(len(story["mean"]))[:9]
titles = [f"{t + 1}: weighs {story['noted'][t]}" if story["noted"][t] else f"{t + 1}" for t in moments]
draw_strip(story, moments, titles, ["red cube", "bias"], 0.75)
print("red stands on green:", story["success"])

# %% [markdown]
# Left bar: which cube is red (-0.3 the left one, 0 the middle one, 0.3 the right one); right bar: the logarithm of the scale's
# factor. Is this the reason why it weighs? Let us sort all the decisions of fifty episodes by what had been weighed until then.

# %%
rows = {"nothing": [], "green only": [], "another only": [], "green and another": []}
for story in weighings:
    green, another = False, False
    for t, noted in enumerate(story["noted"][:-1]):
        green, another = green or noted == "green", another or noted in ("red", "blue")
        key = list(rows)[green + 2 * another]
        believed = story["mean"][t][0]
        rows[key].append((*story["std"][t], abs(believed - story["truth"][0]) < abs(believed - story["blue"])))
success = np.mean([story["success"] for story in weighings])
length = np.mean([len(story["mean"]) for story in weighings])
print(f"success in {success:.0%} of {len(seeds)} episodes, after {length:.1f} decisions on average")
print("weighed so far      decisions   σ of red   σ of bias   mean nearer to red than to blue")
for key, values in rows.items():
    if values:
        red, bias, right = np.mean(values, axis=0)
        print(f"{key:18s}  {len(values):9d}   {red:8.3f}   {bias:9.3f}   {right:10.0%}")
both = np.mean([{"green"} < {noted for noted in story["noted"] if noted} for story in weighings])
print(f"both green and another were weighed in {both:.0%} of the episodes")

# %% [markdown]
# Line by line: before anything is weighed, which of two cubes is red is a coin's throw. Green alone tells the bias and nothing of
# red. Another cube alone tells the bias roughly, as its mass is known roughly, and red only where the reading would be beyond the
# range of the bias. Both together tell everything.
#
# ## And told that it knows?

# %%
print("shown        told σ           success   weighed green and another   decisions")
for privileged in (False, True):
    for name, told in (("the encoder's", None), ("0.25, always", 0.25), ("0.01, always", 0.01)):
        tries = [play(arm_env, arm, seed, note_weighing, privileged, lambda t, told=told: told) for seed in seeds]
        both = np.mean([{"green"} < {noted for noted in story["noted"] if noted} for story in tries])
        rate, length = np.mean([s["success"] for s in tries]), np.mean([len(s["mean"]) for s in tries])
        print(f"{'the truth' if privileged else 'the belief':12s} {name:15s} {rate:8.0%} {both:25.0%} {length:15.1f}")
drone_env.close()
arm_env.close()

# %% [markdown]
# The drone obeys the σ that it is told; the arm hardly listens. It weighs whatever it is told, even if it is shown the truth: to weigh
# has become what it does first. Not every agent has to be as sensitive to σ as the paper's; whether yours is, is one loop to find out.
#
# ## Exercises
#
# 1. Which of the drone's three σ could fall without landing? Write a pilot that finds out the altitude's bias in the air, and say
#    what it risks.
# 2. Change `LOW` to 0.01, which no encoder has ever said. Where does the drone hover, and why might that be?
# 3. The arm could weigh red and blue and leave green alone. In how many episodes would that be enough (the card says 58 %)?
# 4. Film both: `python -m sb3_uspl.record_video --algo uspl_ppo --env BlindMassStack-v0 -f trained_agents --film arm.mp4`.
# 5. Put the agents on motors and rotors: `python -m sb3_uspl.evaluate --algo uspl_ppo --env BiasedQuadrotor-v0 --physics full`.
