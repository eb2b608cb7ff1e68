"""Films of the deployment policy: what the robot does beside what it believes. Needs matplotlib (extra ``zoo``)."""

import importlib.util
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure, SubFigure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Ellipse, Patch, Polygon, Rectangle
from PIL import Image
from stable_baselines3.common.base_class import BaseAlgorithm

from bullet_tasks.scene import SceneSpec
from bullet_tasks.shapes import Box, Shape
from sb3_uspl._arguments import PAPER_DECISION_PERIOD
from sb3_uspl.chosen_uncertainty import ChosenUncertainty
from sb3_uspl.observations import PRIVILEGED, TARGET, is_image
from sb3_uspl.pictures import DEPLOYMENT_COLOUR, SIGMA_COLOUR, BeliefInWorld, on_map
from sb3_uspl.policies import DeploymentState, USPLPolicy

FRAMES_PER_SECOND = 8.0
"""Decisions a second in the film; twice real time for decisions of 0.25 s."""
FIRST_FRAME_TIME, LAST_FRAME_TIME = 1.0, 2.5
"""s for which the beginning and the end of an episode stand still."""
GIF_COLOURS = 200
_MP4_PACKAGES = ("imageio", "imageio_ffmpeg")
_WIDTH, _DPI = 10.0, 90
_ROW_HEIGHT = {True: 4.6, False: 3.9}  # inches an agent, by whether the panels lie one above the other
_WIDE = 2.0  # ratio of width to height from which the picture lies above the map instead of beside it
_PARKED_HEIGHT = -50.0  # m; shapes below are out of use in this episode
_MARGIN = 0.5  # m around the scene
_OPEN_FIELD = ((-1.0, -1.0), (1.0, 1.0))  # the map of an environment without a scene, in its own unit
_LEAST_THICKNESS, _ROBOT_LENGTH = 0.035, 0.045  # share of the map's width
_CAMERA_INSET = (0.66, 0.66, 0.33, 0.33)  # left, bottom, width and height in shares of the panel
_CHOSEN_COLOUR = "#D55E00"
_LEAST_BOUND, _GREATEST_BOUND, _BAR_WIDTH = 0.3, 2.0, 0.62  # privileged units; times the values; share of a dimension's room
_GROUND, _REACHED, _FAILED, _ERROR_COLOUR = "#3b4452", "#1b7f3b", "#b3261e", "#333333"


@dataclass
class Clip:
    """One episode of a policy, at every decision and once after the last one."""

    seed: int
    scene: SceneSpec | None
    goal: np.ndarray | None
    """On the map, ``(2,)``; None if the environment has no map."""
    truth: np.ndarray
    """Privileged observation at the start, ``(n_privileged,)``."""
    bounds: np.ndarray
    """Lower and upper ones of the privileged observation, ``(2, n_privileged)``."""
    policy: str = "deployment"
    goal_is_place: bool = True
    """Whether the task has a goal to go to; else ``goal`` is where the truth lies on the map."""
    choices: Mapping[int, Sequence[float]] = field(default_factory=dict)
    """Values of the discrete dimensions of the privileged observation."""
    success: bool = False
    poses: list[tuple[float, float, float]] = field(default_factory=list)
    """x, y (m) and yaw (rad); zeros without a map."""
    means: list[np.ndarray] = field(default_factory=list)
    stds: list[np.ndarray] = field(default_factory=list)
    """The belief, ``(n_privileged,)``."""
    chosen: list[float | None] = field(default_factory=list)
    """Uncertainty that the policy was shown in place of the encoder's, to the scale of ``sigmas``."""
    centres: list[np.ndarray] = field(default_factory=list)
    half_widths: list[np.ndarray] = field(default_factory=list)
    sigmas: list[float] = field(default_factory=list)
    errors: list[float] = field(default_factory=list)
    pictures: list[np.ndarray] = field(default_factory=list)
    """Of ``env.render()``; empty if the environment gives none."""
    views: list[np.ndarray] = field(default_factory=list)
    """Of the robot's camera, uint8 ``(height, width)``; empty if it has none."""


def record_clip(
    model: BaseAlgorithm,
    env: gym.Env,
    seed: int,
    uncertainty: ChosenUncertainty | None = None,
    policy: str = "deployment",
) -> Clip:
    """
    Run one episode, deterministic.

    :param model: with a ``USPLPolicy``
    :param env: with ``belief_in_world``, itself or its task, for a map; without, everything is in privileged units
    :param seed: of the episode
    :param uncertainty: shown to the policy in place of the encoder's
    :param policy: "deployment", or "privileged": the policy is shown the truth in place of the belief's mean, as in Fig. 7
    :return: the episode
    :raises ValueError: for an unknown policy, or if the model has no belief
    """
    network = model.policy
    world: Any = env.unwrapped
    if not isinstance(network, USPLPolicy):
        raise ValueError(f"{type(model).__name__} has no observation encoder, so there is no belief to film.")
    if policy not in ("deployment", "privileged"):
        raise ValueError(f"policy='{policy}': choose 'deployment' or 'privileged'.")
    belief_in_world = map_of(env)
    period = decision_period_of(env)
    obs, info = env.reset(seed=seed)
    clip = _new_clip(env, seed, obs[PRIVILEGED], policy)
    camera = env.observation_space.spaces.get(TARGET)  # type: ignore[attr-defined]
    has_camera = camera is not None and is_image(camera)
    state: DeploymentState | None = None
    over = False
    while True:
        chosen = None if uncertainty is None else uncertainty.at(len(clip.means), period)
        shown = obs[PRIVILEGED][None] if policy == "privileged" else None
        action, state = network.act(obs, state, deterministic=True, privileged=shown, uncertainty=chosen)  # type: ignore[arg-type]
        mean, std = state.belief_mean[0], state.uncertainty[0]
        centre, half_widths, sigma, error = on_map(belief_in_world, mean, std, obs[PRIVILEGED])
        level = None if chosen is None else on_map(belief_in_world, mean, np.full_like(std, chosen), obs[PRIVILEGED])[2]
        clip.poses.append((0.0, 0.0, 0.0) if clip.goal is None else _pose(world, info, clip.poses))
        clip.means.append(mean)
        clip.stds.append(std)
        clip.chosen.append(level)
        clip.centres.append(centre)
        clip.half_widths.append(half_widths)
        clip.sigmas.append(sigma)
        clip.errors.append(error)
        if env.render_mode == "rgb_array":
            clip.pictures.append(env.render())  # type: ignore[arg-type]
        if has_camera:
            clip.views.append(_as_grey(obs[TARGET], camera))
        if over:
            clip.success = bool(info.get("is_success", False))
            return clip
        obs, _, terminated, truncated, info = env.step(action)
        over = terminated or truncated


def _as_grey(image: np.ndarray, space: spaces.Box) -> np.ndarray:
    """First channel, from black to white within the bounds of the space."""
    if image.dtype == np.uint8:
        return image[0].copy()
    low, high = space.low[0].astype(float), space.high[0].astype(float)
    return np.rint(255.0 * np.clip((image[0] - low) / (high - low), 0.0, 1.0)).astype(np.uint8)


def map_of(env: gym.Env) -> BeliefInWorld:
    """
    :param env: environment
    :return: its ``belief_in_world`` or its task's; without one, a belief is itself
    """
    place: BeliefInWorld | None = belief_in_world_of(env)
    return place or (lambda mean, std: (np.asarray(mean), np.asarray(std)))


def belief_in_world_of(env: gym.Env) -> BeliefInWorld | None:
    """
    :param env: environment
    :return: ``belief_in_world`` of its task, of itself or of one of its wrappers; None if there is none
    """
    task = getattr(env.unwrapped, "task", None)
    if hasattr(task, "belief_in_world"):
        return task.belief_in_world  # type: ignore[no-any-return, union-attr]
    return env.get_wrapper_attr("belief_in_world") if env.has_wrapper_attr("belief_in_world") else None


def decision_period_of(env: gym.Env) -> float:
    """
    :param env: environment
    :return: s per decision; 20 ms, the paper's, if it does not say
    """
    return float(env.get_wrapper_attr("decision_period")) if env.has_wrapper_attr("decision_period") else PAPER_DECISION_PERIOD


def _new_clip(env: gym.Env, seed: int, truth: np.ndarray, policy: str) -> Clip:
    world: Any = env.unwrapped
    task = getattr(world, "task", world)
    space: Any = env.observation_space
    goal = None
    belief_in_world = belief_in_world_of(env)
    if belief_in_world is not None:
        goal = np.asarray(task.goal if hasattr(task, "goal") else belief_in_world(truth, np.zeros_like(truth))[0])
        if goal.shape[:1] < (2,):
            raise ValueError(f"belief_in_world must return two arrays of at least two numbers, x and y in m; got {goal}.")
    choices = env.get_wrapper_attr("discrete_privileged") if env.has_wrapper_attr("discrete_privileged") else {}
    bounds = np.stack([space[PRIVILEGED].low, space[PRIVILEGED].high])
    return Clip(
        seed, getattr(world, "scene", None), goal, truth.copy(), bounds, policy, hasattr(task, "goal"), dict(choices or {})
    )


def _pose(world: Any, info: dict[str, Any], before: Sequence[tuple[float, float, float]]) -> tuple[float, float, float]:
    if "position" not in info:
        raise ValueError('A film or replay needs info["position"], x and y in m, from reset and from every step.')
    x, y = map(float, info["position"][:2])
    if hasattr(world, "robot"):
        return x, y, world.robot.state.yaw
    # A point has no heading: it looks where it goes.
    if not before or (x, y) == before[-1][:2]:
        return x, y, before[-1][2] if before else 0.0
    return x, y, math.atan2(y - before[-1][1], x - before[-1][0])


def film(
    agents: Mapping[str, BaseAlgorithm],
    env: gym.Env,
    seeds: Sequence[int],
    out: Path,
    uncertainty: ChosenUncertainty | None = None,
    policy: str = "deployment",
) -> list[Clip]:
    """
    Film the policies of one or several agents, one above the other, on the same episodes.

    An episode of n decisions gives n + 1 frames; if one agent is done earlier its last frame stays until the others are.

    :param agents: models with a ``USPLPolicy``, by the name to show
    :param env: with ``belief_in_world`` a map is shown, made with ``render_mode="rgb_array"`` its picture as well
    :param seeds: of the episodes, shown one after the other
    :param out: ``.gif``, or ``.mp4`` (needs imageio-ffmpeg)
    :param uncertainty: shown to the policies in place of their encoders'
    :param policy: "deployment" or "privileged", see :func:`record_clip`
    :return: the episodes: for each seed those of all agents
    :raises ValueError: for another file type, a missing package, without an agent or seed, or if an agent has no belief
    """
    if out.suffix not in (".gif", ".mp4"):
        raise ValueError(f"{out}: a film is a .gif or a .mp4 file.")
    missing = [name for name in _MP4_PACKAGES if importlib.util.find_spec(name) is None]
    if out.suffix == ".mp4" and missing:
        raise ValueError(f'A .mp4 film needs {missing}, which the extra brings: pip install -e ".[zoo]". A .gif does without.')
    if not agents or not seeds:
        raise ValueError("A film needs at least one agent and one seed.")
    period = decision_period_of(env)
    frames: list[np.ndarray] = []
    times: list[float] = []
    recorded: list[Clip] = []
    for seed in seeds:
        clips = {name: record_clip(model, env, seed, uncertainty, policy) for name, model in agents.items()}
        episode = list(_draw(clips, period))
        frames += episode
        times += [FIRST_FRAME_TIME, *([1.0 / FRAMES_PER_SECOND] * (len(episode) - 2)), LAST_FRAME_TIME]
        recorded += clips.values()
    out.parent.mkdir(parents=True, exist_ok=True)
    (_write_gif if out.suffix == ".gif" else _write_mp4)(frames, times, out)
    return recorded


def _draw(clips: Mapping[str, Clip], period: float) -> Iterator[np.ndarray]:
    """Frames, uint8 ``(height, width, 3)``."""
    first = next(iter(clips.values()))
    ratio = first.pictures[0].shape[1] / first.pictures[0].shape[0] if first.pictures else 1.0
    figure = Figure(figsize=(_WIDTH, _ROW_HEIGHT[ratio > _WIDE] * len(clips)), dpi=_DPI, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    end = period * max(len(clip.poses) - 1 for clip in clips.values())
    levels = [value for clip in clips.values() for value in (*clip.sigmas, *clip.errors, *clip.chosen) if value is not None]
    highest = 1.15 * max(levels)
    rows = figure.subfigures(len(clips), 1, squeeze=False)[:, 0]
    stages = [
        _Stage(row, name, clip, period, (end, highest), ratio > _WIDE)
        for row, (name, clip) in zip(rows, clips.items(), strict=True)
    ]
    # Once, so that the panels stand still.
    figure.draw_without_rendering()
    figure.set_layout_engine("none")
    for frame in range(max(len(clip.poses) for clip in clips.values())):
        for stage in stages:
            stage.show(frame)
        canvas.draw()
        yield np.asarray(canvas.buffer_rgba())[..., :3].copy()


class _Stage:
    """
    The panels of one agent: picture, map, belief over time and belief as bars.

    :param row: where to draw
    :param name: of the agent
    :param clip: its episode
    :param period: s per decision
    :param limits: of the plot over time, s and m
    :param wide: whether picture and map lie one above the other
    """

    def __init__(self, row: SubFigure, name: str, clip: Clip, period: float, limits: tuple[float, float], wide: bool):
        self.row, self.name, self.clip, self.period = row, name, clip, period
        shown = [panel for panel, there in (("picture", clip.pictures), ("map", clip.goal is not None)) if there]
        layout, ratios = [[*shown, "time"], [*shown, "bars"]], [1.25, 1.0, 0.85][-len(shown) - 1 :]
        if wide and len(shown) == 2:
            layout, ratios = [[shown[0], "time"], [shown[1], "bars"]], [2.6, 1.0]
        axes = row.subplot_mosaic(layout, width_ratios=ratios)  # type: ignore[arg-type]
        self.title = row.suptitle(" ", fontweight="bold", fontsize="large")
        if clip.pictures:
            axes["picture"].set_axis_off()
            self.image = axes["picture"].imshow(clip.pictures[0])
        if clip.goal is not None:
            self._draw_map(axes["map"], clip.goal)
        if clip.views:
            inset = axes[shown[0] if shown else "bars"].inset_axes(_CAMERA_INSET, xticks=[], yticks=[])
            label = dict(boxstyle="square,pad=0.2", facecolor="white", edgecolor="none", alpha=0.8)
            inset.text(0.04, 0.94, "its camera", transform=inset.transAxes, va="top", fontsize="x-small", bbox=label)
            self.view = inset.imshow(clip.views[0], cmap="gray", vmin=0, vmax=255)
        self._draw_time(axes["time"], limits)
        self._draw_bars(axes["bars"])

    def _draw_map(self, axis: Axes, goal: np.ndarray) -> None:
        scene, unit = self.clip.scene, self._unit
        shapes = [shape for shape in scene.shapes if shape.top > _PARKED_HEIGHT] if scene is not None else []
        for shape in sorted(shapes, key=lambda shape: shape.top):
            axis.add_patch(_footprint(shape))
        if scene is not None and math.isfinite(scene.lower_ground):
            axis.set_facecolor(_GROUND)
        corners = np.array([_extent(shape) for shape in shapes]) if shapes else np.array([_OPEN_FIELD])
        (left, bottom), (right, top) = corners[:, 0].min(axis=0) - _MARGIN, corners[:, 1].max(axis=0) + _MARGIN
        if shapes and not self.clip.goal_is_place:
            (left, bottom), (right, top) = self._where_it_happens(goal)
        elif not shapes:
            low, high = self._where_it_happens(goal)
            (left, bottom), (right, top) = np.minimum((left, bottom), low), np.maximum((right, top), high)
        axis.set(xlim=(left, right), ylim=(bottom, top), aspect="equal", xlabel="x" + unit, ylabel="y" + unit)
        self.size = right - left
        self.belief = Ellipse((0.0, 0.0), 1.0, 1.0, facecolor=SIGMA_COLOUR, edgecolor=SIGMA_COLOUR, alpha=0.55, linewidth=2.0)
        axis.add_patch(self.belief)
        (self.path,) = axis.plot([], [], color=DEPLOYMENT_COLOUR, linewidth=1.8, zorder=4)
        self.robot = Polygon(np.zeros((3, 2)), facecolor=DEPLOYMENT_COLOUR, edgecolor="white", linewidth=1.0, zorder=6)
        axis.add_patch(self.robot)
        star = dict(marker="*", markersize=15, color="gold", markeredgecolor="black", linestyle="")
        axis.plot(*goal, zorder=5, **star)  # type: ignore[arg-type]
        hidden = "goal" if self.clip.goal_is_place else "truth"
        handles = [
            Line2D([], [], marker=">", color=DEPLOYMENT_COLOUR, markersize=8, label="robot and its path"),
            Line2D([], [], label=hidden + " (hidden)", **star),  # type: ignore[arg-type]
            Patch(color=SIGMA_COLOUR, alpha=0.55, label="belief, ±1 $\\sigma$"),
        ]
        axis.legend(
            handles=handles, ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1.0), fontsize="small", frameon=False,
            columnspacing=1.2, handletextpad=0.5,
        )  # fmt: skip

    def _where_it_happens(self, goal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Square around path and beliefs: without a goal to go to, a scene may be a hundred times as wide as what happens."""
        clip = self.clip
        centres, half_widths = np.stack(clip.centres), np.stack(clip.half_widths)
        points = np.concatenate([np.array(clip.poses)[:, :2], goal[None], centres - half_widths, centres + half_widths])
        low, high = points.min(axis=0), points.max(axis=0)
        half = 0.6 * float((high - low).max())
        return 0.5 * (low + high) - half, 0.5 * (low + high) + half

    def _draw_time(self, axis: Axes, limits: tuple[float, float]) -> None:
        (self.sigma,) = axis.plot([], [], color=SIGMA_COLOUR, linewidth=2.2, label=r"$\sigma$")
        (self.error,) = axis.plot([], [], "--", color=_ERROR_COLOUR, linewidth=1.6, label="|belief - truth|")
        self.chosen = None
        if any(level is not None for level in self.clip.chosen):
            (self.chosen,) = axis.plot([], [], color=_CHOSEN_COLOUR, drawstyle="steps-post", label=r"$\sigma$ shown")
        self.now = axis.axvline(0.0, color="0.6", linewidth=1.0)
        axis.set(
            xlim=(0.0, max(limits[0], self.period)), ylim=(0.0, limits[1]), xlabel="time (s)", ylabel="belief" + self._unit
        )
        axis.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), fontsize="small", frameon=False, ncols=3, columnspacing=0.8)
        axis.grid(alpha=0.25)

    @property
    def _unit(self) -> str:
        return " (m)" if self.clip.scene is not None and self.clip.goal is not None else ""

    def _draw_bars(self, axis: Axes) -> None:
        """The whole belief, dimension by dimension: what has no place on a map, too."""
        clip = self.clip
        places = np.arange(1, len(clip.truth) + 1)
        finite = clip.bounds[np.isfinite(clip.bounds)]
        reach = max(float(np.abs(part).max(initial=0.0)) for part in (clip.truth, np.array(clip.means), finite))
        widest = float((np.abs(clip.means) + clip.stds).max())
        limit = 1.1 * max(reach, _LEAST_BOUND, min(widest, _GREATEST_BOUND * max(reach, _LEAST_BOUND)))
        for dimension, values in clip.choices.items():
            axis.hlines(values, dimension + 1 - 0.5 * _BAR_WIDTH, dimension + 1 + 0.5 * _BAR_WIDTH, color="0.7", linestyle=":")
        self.spread = axis.bar(places, 0.0, _BAR_WIDTH, color=SIGMA_COLOUR, alpha=0.45, label="belief, ±1 $\\sigma$")
        (self.mean,) = axis.plot(places, places * 0.0, "_", color=SIGMA_COLOUR, markersize=16, markeredgewidth=2.5)
        axis.plot(places, clip.truth, "D", color="gold", markeredgecolor="black", markersize=6, label="truth (hidden)")
        axis.set(xlim=(0.3, len(places) + 0.7), ylim=(-limit, limit), xticks=places, ylabel="privileged units")
        axis.set_xlabel("dimension of the privileged observation", fontsize="small")
        axis.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), fontsize="small", frameon=False, ncols=3, columnspacing=0.8)
        axis.grid(axis="y", alpha=0.25)

    def show(self, frame: int) -> None:
        """
        Draw a moment of the episode.

        :param frame: decisions so far
        """
        clip, last = self.clip, len(self.clip.poses) - 1
        now = min(frame, last)
        if clip.pictures:
            self.image.set_data(clip.pictures[now])
        if clip.views:
            self.view.set_data(clip.views[now])
        if clip.goal is not None:
            self._show_on_map(now)
        time = self.period * np.arange(now + 1)
        self.sigma.set_data(time, clip.sigmas[: now + 1])
        self.error.set_data(time, clip.errors[: now + 1])
        if self.chosen is not None:
            self.chosen.set_data(time, [np.nan if level is None else level for level in clip.chosen[: now + 1]])
        self.now.set_xdata([time[-1], time[-1]])
        for bar, mean, std in zip(self.spread, clip.means[now], clip.stds[now], strict=True):
            bar.set(y=float(mean - std), height=float(2.0 * std))
        self.mean.set_ydata(clip.means[now])
        succeeded = "reached the goal" if clip.goal_is_place else "succeeded"
        outcome, colour = (succeeded, _REACHED) if clip.success else ("failed", _FAILED)
        text = f"{outcome} after" if now == last else "running,"
        self.title.set_text(f"{self.name}, {clip.policy} policy, seed {clip.seed}: {text} {time[-1]:.1f} s")
        self.title.set_color(colour if now == last else "black")

    def _show_on_map(self, now: int) -> None:
        clip = self.clip
        x, y, yaw = clip.poses[now]
        self.path.set_data(*np.array(clip.poses[: now + 1])[:, :2].T)
        length = _ROBOT_LENGTH * self.size
        corners = length * np.array([(0.6, 0.0), (-0.4, 0.4), (-0.4, -0.4)])
        turn = np.array([(math.cos(yaw), math.sin(yaw)), (-math.sin(yaw), math.cos(yaw))])
        self.robot.set_xy(corners @ turn + (x, y))
        self.belief.set_center(tuple(clip.centres[now]))
        thickness = _LEAST_THICKNESS * self.size
        self.belief.width, self.belief.height = (max(2.0 * float(half), thickness) for half in clip.half_widths[now])


def _footprint(shape: Shape) -> Patch:
    x, y, _ = shape.centre
    if not isinstance(shape, Box):
        return Circle((x, y), shape.radius, facecolor=shape.colour)
    a, b, _ = shape.half_extents
    return Rectangle(
        (x - a, y - b), 2 * a, 2 * b, angle=math.degrees(shape.yaw), rotation_point="center", facecolor=shape.colour
    )


def _extent(shape: Shape) -> tuple[tuple[float, float], tuple[float, float]]:
    """Lower left and upper right corner of what surely holds the shape if it is not turned."""
    a, b = shape.half_extents[:2] if isinstance(shape, Box) else (shape.radius, shape.radius)
    return (shape.centre[0] - a, shape.centre[1] - b), (shape.centre[0] + a, shape.centre[1] + b)


def _write_gif(frames: Sequence[np.ndarray], times: Sequence[float], out: Path) -> None:
    """One palette for all frames, without dithering: then frames differ only where something moves."""
    images = [Image.fromarray(frame) for frame in frames]
    samples = [images[0], images[len(images) // 2], images[-1]]
    montage = Image.new("RGB", (images[0].width, sum(image.height for image in samples)))
    for i, image in enumerate(samples):
        montage.paste(image, (0, i * images[0].height))
    palette = montage.quantize(GIF_COLOURS, method=Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)
    first, *others = (image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images)
    first.save(out, save_all=True, append_images=others, duration=[round(1000 * time) for time in times], loop=0)


def _write_mp4(frames: Sequence[np.ndarray], times: Sequence[float], out: Path) -> None:
    """Still frames are repeated; H.264 wants even sizes, so that odd ones have their last row or column twice."""
    import imageio.v2 as imageio

    with imageio.get_writer(out, fps=FRAMES_PER_SECOND, macro_block_size=2) as writer:
        for frame, time in zip(frames, times, strict=True):
            even = np.pad(frame, [(0, size % 2) for size in frame.shape[:2]] + [(0, 0)], mode="edge")
            for _ in range(round(time * FRAMES_PER_SECOND)):
                writer.append_data(even)  # type: ignore[attr-defined]
