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
# # 5 · Seeing
#
# In Signpost Nav a block at the rim of a disc points to the goal, and is the longer the further away the goal is. This notebook
# looks at it through the robot's depth camera: what the camera is, how its images are cast and how far that is from PyBullet's own
# renderer, and how the belief's ellipse shrinks when the signpost comes into view (Fig. 16 of the paper).
#
# The walking here is **scripted**: to the signpost and no further. Only the encoder learns, in a minute or two. An agent that learns
# both takes hours on two cores (`python -m sb3_uspl.train --algo uspl_ppo --env SignpostNavDepth-v0`).

# %%
import importlib.util
import os

needed = ("sb3_uspl", "bullet_tasks", "pybullet", "matplotlib")
missing = [name for name in needed if importlib.util.find_spec(name) is None]
if missing:
    raise SystemExit(f"This notebook needs {missing}: run `pip install -e '.[zoo,notebooks]'` in the repository.")
FAST = os.environ.get("SB3_USPL_FAST_NOTEBOOKS") == "1"  # for the test suite: everything runs, nothing is learned

# %%
import math
import time

import gymnasium as gym
import matplotlib.pyplot as plt
import numpy as np
import torch as th
from matplotlib.patches import Circle, Ellipse, Rectangle

import bullet_tasks  # noqa: F401 (registers the environments)
from bullet_tasks.robots.quadruped import BODY_HEIGHT
from bullet_tasks.sensors import CameraPose, DepthCamera
from bullet_tasks.sensors.camera import SMALL
from sb3_uspl.encoder import ObservationEncoder, gaussian_nll
from sb3_uspl.observations import COMMON, PREVIOUS_ACTION, PRIVILEGED, TARGET
from sb3_uspl.pictures import DEPLOYMENT_COLOUR, SIGMA_COLOUR

th.set_num_threads(1)
rng = np.random.default_rng(0)

# %% [markdown]
# ## The camera

# %%
env = gym.make("SignpostNavDepth-v0", physics="compiled", render_mode="rgb_array")
obs, _ = env.reset(seed=1)
task, camera = env.unwrapped.task, env.unwrapped.sensors[0]
print({key: (value.shape, str(value.dtype)) for key, value in obs.items()})
print("lens:", camera.intrinsics)
print(f"on the body at {camera.position} m; 0 to 255 are {camera.near} to {camera.far} m")

figure, axes = plt.subplots(1, 3, figsize=(11, 3.0), dpi=90, layout="constrained")
axes[0].imshow(env.render())
axes[0].set_title("the scene; the goal (green) is not seen", fontsize="medium")
for axis, x in zip(axes[1:], (1.5, 2.5), strict=True):
    image = camera.depth(CameraPose(x, 0.0, BODY_HEIGHT, 0.0))  # of the body; the lens is before it
    shown = axis.imshow(image, cmap="viridis", vmin=0.0, vmax=camera.far)
    axis.set_title(f"{task.config.post_x - x:.2f} m before the signpost", fontsize="medium")
figure.colorbar(shown, ax=axes[2], label="depth (m)")
for axis in axes:
    axis.set_axis_off()
plt.show()

# %% [markdown]
# Depth is all there is, and only up to 2 m: from further away a signpost is nothing. The steps at the bottom are the floor.
#
# ## Our caster against PyBullet's renderer
#
# Training takes millions of images. PyBullet draws one with its software renderer (TinyRenderer); ours casts a ray a pixel
# against boxes and cylinders in compiled code. Do they show the same?

# %%
scene = env.unwrapped.scene
cameras = {name: DepthCamera(SMALL, back_end=back_end) for name, back_end in (("PyBullet", "tiny"), ("ours", "compiled"))}
poses = [CameraPose(2.6, -0.3, BODY_HEIGHT, 0.3)]
poses += [
    CameraPose(rng.uniform(1.5, 2.8), rng.uniform(-1.0, 1.0), BODY_HEIGHT, rng.uniform(-0.7, 0.7))
    for _ in range(5 if FAST else 60)
]
images = {}
for name, eye in cameras.items():
    eye.reset(scene, rng)
    eye.depth(poses[0])  # compiles, or loads the scene
    begin = time.process_time()
    images[name] = np.stack([eye.depth(pose) for pose in poses])
    print(f"{name:9s} {1000 * (time.process_time() - begin) / len(poses):6.2f} ms an image, of one core")
    eye.close()

difference = np.abs(images["ours"] - images["PyBullet"])
figure, axes = plt.subplots(1, 3, figsize=(10, 2.6), dpi=90, layout="constrained")
for axis, (name, image) in zip(axes, [*images.items(), ("difference", difference)], strict=True):
    shown = axis.imshow(image[0], cmap="viridis" if name != "difference" else "magma", vmin=0.0, vmax=2.0)
    axis.set_title(name, fontsize="medium")
    axis.set_axis_off()
figure.colorbar(shown, ax=axes[2], label="m")
plt.show()
for limit in (0.001, 0.01, 0.1):
    print(f"pixels that differ by more than {100 * limit:4.1f} cm: {(difference > limit).mean():7.3%}")
print(f"median {1000 * np.median(difference):.3f} mm, greatest {difference.max():.2f} m")

# %% [markdown]
# Where they differ they differ by a lot, and it is on an edge: one sees the block, or the rim of the disc (which PyBullet draws with
# 24 sides), the other what is behind it.
#
# ## What the image tells
#
# Four goals, seen from the same place, with the signpost's middle 2.15 m ahead:


# %%
def draw_map(axis, scene, goal):
    axis.add_patch(Circle((0, 0), task.config.platform_radius, facecolor="0.92"))
    for shape in scene.shapes:
        if shape.name.startswith("post"):
            (x, y, _), (a, b, _) = shape.centre, shape.half_extents
            corner, turn = (x - a, y - b), math.degrees(shape.yaw)
            axis.add_patch(Rectangle(corner, 2 * a, 2 * b, angle=turn, rotation_point="center", color="goldenrod"))
    axis.plot(*goal, "*", color="gold", markeredgecolor="black", markersize=13, zorder=5)
    axis.set(xlim=(-4.7, 5.6), ylim=(-4.7, 4.7), aspect="equal", xticks=[], yticks=[])


figure, axes = plt.subplots(2, 4, figsize=(10, 4.4), dpi=90, layout="constrained")
for (above, below), seed in zip(axes.T, (1, 2, 4, 5), strict=True):
    env.reset(seed=seed)
    draw_map(above, env.unwrapped.scene, task.goal)
    above.plot(2.5, 0.0, ">", color=DEPLOYMENT_COLOUR, markersize=9)
    below.imshow(camera.depth(CameraPose(2.5, 0.0, BODY_HEIGHT, 0.0)), cmap="viridis", vmin=0.0, vmax=camera.far)
    below.set_axis_off()
plt.show()

# %% [markdown]
# The slant of the block is the direction, its length the distance. Both take some reading: a network's work.
#
# ## Walks to the signpost
#
# A scripted robot walks to somewhere before the signpost, turns to it, and stops when it is near. It does not know the goal, so its
# walk gives nothing away (notebook 2).


# %%
def walk(seed):
    """An episode of the script: what the encoder needs, and where the robot was."""
    obs, _ = env.reset(seed=int(seed))
    via, arrived = np.array([rng.uniform(1.6, 2.4), rng.uniform(-0.9, 0.9)]), False
    post, action = np.array([task.config.post_x, 0.0]), np.zeros(1, dtype=np.float32)
    steps = {key: [] for key in (COMMON, TARGET, PREVIOUS_ACTION, PRIVILEGED)}
    while True:
        for key in (COMMON, TARGET, PRIVILEGED):
            steps[key].append(obs[key])
        steps[PREVIOUS_ACTION].append(action)
        here = 8.0 * obs[COMMON][:2].astype(float)
        arrived = arrived or math.dist(here, via) < 0.35
        if (arrived and math.dist(here, post) < 2.0) or len(steps[COMMON]) >= 79:
            return {key: np.stack(values) for key, values in steps.items()} | {"goal": np.array(task.goal)}
        way = (post if arrived else via) - here
        turn = math.remainder(math.atan2(way[1], way[0]) - math.atan2(obs[COMMON][3], obs[COMMON][2]), math.tau)
        action = np.clip([turn / (math.pi / 4) + rng.normal(0.0, 0.2)], -1.0, 1.0).astype(np.float32)
        obs = env.step(action)[0]


def first_sight(episode):
    """The first decision at which the image shows something above its lower half: the signpost, not the floor."""
    seen = (episode[TARGET][:, 0, :14] < 250).any(axis=(1, 2))
    return int(seen.argmax()) if seen.any() else len(seen) - 1


training = [walk(seed) for seed in range(6 if FAST else 5000)]
test = [walk(10_000 + i) for i in range(6 if FAST else 120)]
n_images = sum(len(episode[COMMON]) for episode in training)
n_seen = sum(len(episode[COMMON]) - first_sight(episode) for episode in training)
print(f"{len(training)} walks, {n_images} images, {n_seen} of them since the signpost was seen; {len(test)} walks for tests")

# %% [markdown]
# Most images show nothing, and what one has shown must be remembered. Here the memory is the running maximum of learned features
# (`memory="max"`): what has been found stays found.

# %%
space = env.observation_space
sizes = dict(hidden=(64,), trunk=(64,), embedding=(64,))
th.manual_seed(0)
encoder = ObservationEncoder(space, n_action=1, memory="max", overrides=sizes)


def collate(episodes):
    """Tokens and truth of whole episodes, one after another, and their lengths."""
    tokens = {
        key: th.as_tensor(np.concatenate([e[key] for e in episodes])) for key in (COMMON, TARGET, PREVIOUS_ACTION, PRIVILEGED)
    }
    return tokens, tokens.pop(PRIVILEGED), th.as_tensor([len(e[COMMON]) for e in episodes])


def look(episodes):
    """Mean and standard deviation along each episode."""
    with th.no_grad():
        tokens, _, lengths = collate(episodes)
        belief, _ = encoder(tokens, lengths)
    parts = np.cumsum(lengths)[:-1]
    return list(zip(np.split(belief.mean.numpy(), parts), np.split(belief.std.numpy(), parts), strict=True))


encoder.features.update_normalizers(collate(training)[0])
ROUNDS, BATCH = (1, 4) if FAST else (16, 100)
optimizer = th.optim.Adam(encoder.parameters(), 2e-3)
schedule = th.optim.lr_scheduler.CosineAnnealingLR(optimizer, ROUNDS)
curve, begin = [], time.process_time()
for _ in range(ROUNDS):
    order, losses = rng.permutation(len(training)), []
    for rows in np.split(order, range(BATCH, len(order), BATCH)):
        tokens, truth, lengths = collate([training[i] for i in rows])
        loss = gaussian_nll(encoder(tokens, lengths)[0], truth, beta=0.5)
        optimizer.zero_grad()
        loss.backward()
        th.nn.utils.clip_grad_norm_(encoder.parameters(), 1.0)
        optimizer.step()
        losses.append(loss.item())
    schedule.step()
    last = [np.abs(mean[-1] - e[PRIVILEGED][-1]).mean() for (mean, _), e in zip(look(test), test, strict=True)]
    curve.append((np.mean(losses), np.mean(last)))
print(f"{time.process_time() - begin:.0f} s of one core")

figure, axes = plt.subplots(1, 2, figsize=(8, 2.4), dpi=90, layout="constrained")
titles = ("Eq. 1 (as beta-NLL)", "error before the signpost, new walks")
for axis, values, title in zip(axes, zip(*curve, strict=True), titles, strict=True):
    axis.plot(values, color="0.3")
    axis.set(xlabel="round", title=title)
plt.show()

# %% [markdown]
# ## The ellipse shrinks (Fig. 16)
#
# A new walk, one that sees the signpost late: where the robot is, what it believes (±σ), and what its camera shows.

# %%
beliefs = look(test)
chosen = int(np.argmax([first_sight(e) for e in test]))
episode, (mean, std) = test[chosen], beliefs[chosen]
env.reset(seed=10_000 + chosen)
sight, last = first_sight(episode), len(mean) - 1
moments = [0, sight - 1, min(sight + 1, last), last]
figure, axes = plt.subplots(2, 4, figsize=(10, 4.6), dpi=90, layout="constrained")
for (above, below), t in zip(axes.T, moments, strict=True):
    draw_map(above, env.unwrapped.scene, task.goal)
    centre, half = task.belief_in_world(mean[t], std[t])
    above.add_patch(Ellipse(centre, *(2 * half), facecolor=SIGMA_COLOUR, edgecolor=SIGMA_COLOUR, alpha=0.45))
    x, y, c, s = episode[COMMON][t]
    above.plot(*(8 * episode[COMMON][: t + 1, :2].T), color=DEPLOYMENT_COLOUR)
    above.arrow(8 * x, 8 * y, 0.5 * c, 0.5 * s, width=0.15, color=DEPLOYMENT_COLOUR, zorder=4)
    above.set_title(f"{task.decision_period * t:.1f} s: σ = {half[0]:.2f}, {half[1]:.2f} m", fontsize="medium")
    below.imshow(episode[TARGET][t, 0], cmap="viridis", vmin=0, vmax=255)
    below.set_axis_off()
plt.show()

# %% [markdown]
# And all of the new walks, laid on top of each other at the first sight of the signpost:

# %%
figure, axes = plt.subplots(1, 2, figsize=(9, 2.7), dpi=90, sharex=True, layout="constrained")
rows = {"1 s before the first sight": [], "1 s after it": [], "at the end of the walk": []}
for episode, (mean, std) in zip(test, beliefs, strict=True):
    sight, last = first_sight(episode), len(mean) - 1
    error = np.linalg.norm(8 * (mean - episode[PRIVILEGED]), axis=1)
    when = task.decision_period * (np.arange(len(mean)) - sight)
    axes[0].plot(when, 8 * std.mean(1), color=SIGMA_COLOUR, alpha=0.2)
    axes[1].plot(when, error, color="0.3", alpha=0.2)
    for key, t in zip(rows, (max(sight - 4, 0), min(sight + 4, last), last), strict=True):
        rows[key].append((*(8 * std[t]), error[t], error[t] < task.config.goal_radius))
axes[0].set(xlabel="time since the first sight (s)", ylabel="mean σ (m)", ylim=(0, None))
axes[1].set(xlabel="time since the first sight (s)", ylabel="error of the mean (m)", ylim=(0, None))
plt.show()
print("                            σ of x   σ of y   error (m)   mean within the goal's circle")
for key, values in rows.items():
    x, y, error, within = np.mean(values, axis=0)
    print(f"{key:26s} {x:7.2f} {y:8.2f} {error:11.2f} {within:16.0%}")
env.close()

# %% [markdown]
# The ellipse is as wide as the disc until the signpost is in sight, and shrinks within a second or two of looking, and the error
# with it. It does not become a point: an encoder that has seen so few signposts reads them coarsely, and its σ says so.
#
# ## Exercises
#
# 1. Noise: `DepthCamera(noise=DepthNoise(deviation=0.02, dropout=0.05))`. How much does the encoder of this notebook lose?
# 2. Replace `memory="max"` by `"gru"`. What does it cost, and where in the curves does it show? Then train on the walks' last ten
#    decisions only, and test on whole ones: why is the error so large before the signpost is seen?
# 3. From which places can the *length* of the signpost not be seen? Draw the belief's ellipse there: which way is it long?
# 4. Let the robot look from one side only (`via` with y > 0). Is the encoder's σ honest from the other side (notebook 2)?
# 5. Let the script walk to the belief's mean after its last look. In how many episodes does it reach the goal? Compare with the
#    table's last column.
