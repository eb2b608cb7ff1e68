"""An episode as one page that anyone can open: 3-D scene, timeline, belief. Needs plotly (extra ``replay``)."""

import base64
import importlib.resources
import json
import math
import string
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import gymnasium as gym
import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm

from bullet_tasks.scene import SceneSpec
from bullet_tasks.shapes import Box, Shape
from sb3_uspl.film import Clip, belief_in_world_of, decision_period_of, record_clip
from sb3_uspl.pictures import DEPLOYMENT_COLOUR, SIGMA_COLOUR

_CORNERS = 32
"""Of a circle."""
_PARKED_HEIGHT = -50.0  # m; shapes below are out of use in this episode
_OPEN_FIELD = 2.0  # size of the map of an environment without a scene, in its own unit
_ROBOT_LENGTH, _LEAST_HALF_WIDTH, _LIFT = 0.05, 0.015, 0.004  # share of the map's size
_CAMERA_WIDTH = 240  # pixels; small sensors are magnified by whole numbers
_GROUND, _ERROR_COLOUR = "rgb(54,64,79)", "#333333"

Mesh = tuple[np.ndarray, np.ndarray]
"""Points ``(n, 3)`` in m, and the three points of each triangle, ``(m, 3)``."""


def write_replay(model: BaseAlgorithm, env: gym.Env, seed: int, out: Path, title: str = "") -> Clip:
    """
    Run one episode of the deployment policy and write the page.

    :param model: with a ``USPLPolicy``
    :param env: with ``belief_in_world``, itself or its task
    :param seed: of the episode
    :param out: ``.html`` file
    :param title: of the page
    :return: the episode
    :raises ValueError: for another file type, a model or an environment without a belief to show, or if plotly is missing
    """
    if out.suffix != ".html":
        raise ValueError(f"{out}: a replay is a .html file.")
    try:
        from plotly.offline import get_plotlyjs
    except ImportError as error:
        raise ValueError('A replay needs plotly, which the extra brings: pip install -e ".[replay]".') from error
    world: Any = env.unwrapped
    if belief_in_world_of(env) is None:
        raise ValueError(
            f"{world} has no belief_in_world(mean, std), which says where on its map a belief lies, so there is none to show."
        )
    noted = _Heights(env)
    clip = record_clip(model, noted, seed)
    title = title or f"{type(model).__name__}, seed {seed}"
    data = page_data(clip, noted.heights, decision_period_of(env))
    template = string.Template(importlib.resources.files("sb3_uspl").joinpath("replay_page.html").read_text("utf-8"))
    # "</script>" in a text would end the script.
    text = json.dumps(data).replace("<", "\\u003c")
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(template.substitute(title=_escaped(title), plotly=get_plotlyjs(), data=text), "utf-8")
    return clip


class _Heights(gym.Wrapper):
    """What a clip does not hold: the robot's height."""

    def __init__(self, env: gym.Env):
        super().__init__(env)
        self.heights: list[float] = []

    def reset(self, **kwargs: Any) -> Any:
        result = self.env.reset(**kwargs)
        self._note()
        return result

    def step(self, action: Any) -> Any:
        result = self.env.step(action)
        self._note()
        return result

    def _note(self) -> None:
        world: Any = self.env.unwrapped
        self.heights.append(float(world.robot.state.z) if hasattr(world, "robot") else 0.0)


def page_data(clip: Clip, heights: Sequence[float], period: float) -> dict[str, Any]:
    """
    Everything that the page draws.

    :param clip: the episode
    :param heights: of the robot at every decision and once after the last one, m
    :param period: s per decision
    :return: what the page's script reads, ready for JSON
    """
    assert clip.goal is not None, "write_replay refuses an environment without a map"
    points, triangles, colours = scene_mesh(clip.scene)
    path = np.array([(x, y, z, yaw) for (x, y, yaw), z in zip(clip.poses, heights, strict=True)])
    around = np.concatenate([points, path[:, :3]]) if len(points) else path[:, :3]
    size = float(max(np.ptp(around[:, 0]), np.ptp(around[:, 1]), 0.0 if len(points) else _OPEN_FIELD))
    least, lift = _LEAST_HALF_WIDTH * size, _LIFT * size
    robot, robot_triangles = _arrow(_ROBOT_LENGTH * size)
    circle = np.concatenate([np.zeros((1, 2)), _circle()])
    # At the height of the ground: a flying robot's belief is about a place below it as well.
    floor = clip.scene.ground_height(*clip.poses[0][:2]) if clip.scene is not None else 0.0
    floor = (floor if math.isfinite(floor) else 0.0) + lift
    belief = _mesh_trace(
        np.column_stack([circle, np.full(len(circle), floor)]),
        _fan(_CORNERS),
        SIGMA_COLOUR,
        "belief, ±1 \N{GREEK SMALL LETTER SIGMA}",
    )
    traces = [
        _mesh_trace(points, triangles, None, "scene", facecolor=colours, showlegend=False, flatshading=True),
        {"type": "scatter3d", "mode": "lines", "line": {"color": DEPLOYMENT_COLOUR, "width": 5}, "name": "path"},
        belief | {"opacity": 0.6},
        _mesh_trace(robot, robot_triangles, DEPLOYMENT_COLOUR, "robot", flatshading=True),
        _goal(clip.goal, floor + lift),
    ]
    return {
        "period": period,
        "poses": path.tolist(),
        "centres": np.array(clip.centres, dtype=float).tolist(),
        "half_widths": np.maximum(np.array(clip.half_widths, dtype=float), least).tolist(),
        "sigmas": list(map(float, clip.sigmas)),
        "errors": list(map(float, clip.errors)),
        "outcome": f"{'reached the goal' if clip.success else 'failed'} after {period * (len(path) - 1):.1f} s",
        "camera": [_as_png(view) for view in clip.views],
        "robot": robot.tolist(),
        "circle": circle.tolist(),
        "traces": {"path": 1, "belief": 2, "robot": 3},
        "scene": {"data": traces, "layout": _scene_layout()},
        "curves": _curves(clip, period),
    }


def scene_mesh(scene: SceneSpec | None) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """
    All boxes and cylinders that the episode uses, as one mesh.

    :param scene: of the episode, or none
    :return: points ``(n, 3)`` in m, the three points of each triangle ``(m, 3)`` and the colour of each triangle
    """
    shapes = [shape for shape in scene.shapes if shape.top > _PARKED_HEIGHT] if scene is not None else []
    meshes = [
        (_shape_mesh(shape), "rgb({:.0f},{:.0f},{:.0f})".format(*(255 * c for c in shape.colour[:3]))) for shape in shapes
    ]
    if scene is not None and shapes and math.isfinite(scene.lower_ground):
        meshes.append((_ground([mesh[0] for mesh, _ in meshes], scene.lower_ground), _GROUND))
    if not meshes:
        return np.zeros((0, 3)), np.zeros((0, 3), dtype=int), []
    points, triangles, colours, n_points = [], [], [], 0
    for (corners, faces), colour in meshes:
        points.append(corners)
        triangles.append(faces + n_points)
        colours += [colour] * len(faces)
        n_points += len(corners)
    return np.concatenate(points), np.concatenate(triangles), colours


def _shape_mesh(shape: Shape) -> Mesh:
    if isinstance(shape, Box):
        half_x, half_y, half_height = shape.half_extents
        outline = np.array([(half_x, half_y), (-half_x, half_y), (-half_x, -half_y), (half_x, -half_y)])
    else:
        outline, half_height = shape.radius * _circle(), shape.half_height
    cos, sin = math.cos(shape.yaw), math.sin(shape.yaw)
    corners, faces = _prism(outline @ np.array([(cos, sin), (-sin, cos)]), half_height)
    return corners + np.array(shape.centre), faces


def _prism(outline: np.ndarray, half_height: float) -> Mesh:
    """An upright body over a convex outline, ``(n, 2)``."""
    n = len(outline)
    corners = np.concatenate([np.column_stack([outline, np.full(n, z)]) for z in (-half_height, half_height)])
    here, there = np.arange(n), (np.arange(n) + 1) % n
    sides = np.concatenate([np.column_stack([here, there, here + n]), np.column_stack([there, there + n, here + n])])
    lid = np.array([(0, i, i + 1) for i in range(1, n - 1)])
    return corners, np.concatenate([sides, lid[:, ::-1], lid + n])


def _arrow(length: float) -> Mesh:
    return _prism(length * np.array([(0.6, 0.0), (-0.4, 0.4), (-0.4, -0.4)]), 0.2 * length)


def _ground(parts: Sequence[np.ndarray], height: float) -> Mesh:
    x, y, _ = np.concatenate(parts).T
    left, right, near, far = x.min() - 1.0, x.max() + 1.0, y.min() - 1.0, y.max() + 1.0
    corners = np.array([(left, near, height), (right, near, height), (right, far, height), (left, far, height)])
    return corners, np.array([(0, 1, 2), (0, 2, 3)])


def _circle() -> np.ndarray:
    angles = 2.0 * math.pi * np.arange(_CORNERS) / _CORNERS
    return np.column_stack([np.cos(angles), np.sin(angles)])


def _fan(n: int) -> np.ndarray:
    """Triangles between a middle, point 0, and the n points around it."""
    here = np.arange(n)
    return np.column_stack([np.zeros(n, dtype=int), 1 + here, 1 + (here + 1) % n])


def _mesh_trace(points: np.ndarray, triangles: np.ndarray, colour: str | None, name: str, **kwargs: Any) -> dict[str, Any]:
    x, y, z = points.round(4).T.tolist()
    i, j, k = triangles.T.tolist()
    trace = {"type": "mesh3d", "x": x, "y": y, "z": z, "i": i, "j": j, "k": k, "name": name, "hoverinfo": "name"}
    return {"showlegend": True, **trace, **({} if colour is None else {"color": colour}), **kwargs}


def _goal(goal: np.ndarray, height: float) -> dict[str, Any]:
    marker = {"symbol": "diamond", "size": 7, "color": "gold", "line": {"color": "black", "width": 1}}
    place = {"x": [float(goal[0])], "y": [float(goal[1])], "z": [height]}
    return {"type": "scatter3d", "mode": "markers", "marker": marker, "name": "goal (hidden from the robot)", **place}


def _scene_layout() -> dict[str, Any]:
    axis = {"showbackground": False, "showgrid": False, "zeroline": False}
    return {
        "margin": {"l": 0, "r": 0, "t": 0, "b": 0},
        "legend": {"x": 0, "y": 1},
        "uirevision": "stays",  # the reader's view does not jump back while the episode plays
        "scene": {
            "aspectmode": "data",
            "xaxis": axis | {"title": {"text": "x"}},
            "yaxis": axis | {"title": {"text": "y"}},
            "zaxis": axis | {"title": {"text": ""}, "showticklabels": False},
            "camera": {"eye": {"x": 0.0, "y": -1.4, "z": 1.5}},
        },
    }


def _curves(clip: Clip, period: float) -> dict[str, Any]:
    unit = "" if clip.scene is None else " (m)"
    time = [period * i for i in range(len(clip.sigmas))]
    lines = (
        ("uncertainty \N{GREEK SMALL LETTER SIGMA}", clip.sigmas, SIGMA_COLOUR, "solid"),
        ("|belief - truth|", clip.errors, _ERROR_COLOUR, "dash"),
    )
    data = [
        {"type": "scatter", "x": time, "y": list(map(float, values)), "name": name, "line": {"color": colour, "dash": dash}}
        for name, values, colour, dash in lines
    ]
    now = {"type": "line", "xref": "x", "yref": "paper", "x0": 0, "x1": 0, "y0": 0, "y1": 1, "line": {"color": "#999"}}
    layout = {
        "margin": {"l": 55, "r": 15, "t": 10, "b": 45},
        "xaxis": {"title": {"text": "time (s)"}, "range": [0.0, max(time[-1], period)]},
        "yaxis": {"title": {"text": "belief" + unit}, "rangemode": "tozero"},
        "legend": {"orientation": "h", "y": 1.02, "yanchor": "bottom"},
        "shapes": [now],
    }
    return {"data": data, "layout": layout}


def _as_png(view: np.ndarray) -> str:
    magnified = np.kron(view, np.ones((max(1, _CAMERA_WIDTH // view.shape[1]),) * 2, dtype=np.uint8))
    _, data = cv2.imencode(".png", magnified)
    return "data:image/png;base64," + base64.b64encode(data.tobytes()).decode()


def _escaped(text: str) -> str:
    return text.replace("&", "&amp;").replace("<", "&lt;")
