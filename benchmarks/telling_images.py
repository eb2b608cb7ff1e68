"""
How many images of Stairway Search tell where the stairs are? Counted for the mismatched robots at the beginning of a training.

The zoo's entry is trained for a while without updates. For every decision that its replay has stored, the scene is measured
from the same pose with the stairs at each of the four corners; a corner is ruled out if at least ``PIXELS`` pixels differ by
``DIFFERENCE`` or more. Printed is the share of images that rule out none, one, two and all three of the wrong corners; who
rules out three has the stairs before the eyes.

Run: ``OMP_NUM_THREADS=1 python -m benchmarks.telling_images [--decisions 100000] [--wander-actions "{1: 0.8}"]``
"""

import argparse
import ast

import gymnasium as gym
import numpy as np

from benchmarks.contenders import make_venv, zoo_entry, zoo_settings
from bullet_tasks.sensors.camera import CameraPose
from bullet_tasks.sensors.depth_camera import DepthCamera
from bullet_tasks.tasks.navigation import POSITION_SCALE
from sb3_uspl import USPLPPO

ENV_ID = "StairwaySearchDepth-v0"
PIXELS, DIFFERENCE = 20, 0.05


def cameras() -> tuple[dict[tuple[float, ...], DepthCamera], float]:
    """A camera in a world for each corner of the stairs, by the privileged observation; the height of the base, m."""
    found: dict[tuple[float, ...], DepthCamera] = {}
    seed = 0
    while len(found) < 4:
        env = gym.make(ENV_ID, physics="compiled")
        obs, _ = env.reset(seed=seed)
        (camera,) = env.get_wrapper_attr("sensors")
        found.setdefault(tuple(obs["privileged"].tolist()), camera)
        seed += 1
    return found, env.get_wrapper_attr("robot").state.z


def ruled_out(common: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """
    Number of wrong corners that each image rules out.

    :param common: poses of the robots, ``(n, 5)``
    :param truth: privileged observations, ``(n, 2)``
    :return: ``(n,)``
    """
    by_corner, height = cameras()
    counts = np.zeros(len(common), dtype=int)
    x, y = (common[:, :2] * POSITION_SCALE).T
    yaw, pitch = np.arctan2(common[:, 3], common[:, 2]), common[:, 4] * np.pi
    for i, corner in enumerate(map(tuple, truth.tolist())):
        pose = CameraPose(x[i], y[i], height, yaw[i], pitch[i])
        depths = {key: camera.depth(pose) for key, camera in by_corner.items()}
        differences = [np.abs(depth - depths[corner]) >= DIFFERENCE for key, depth in depths.items() if key != corner]
        counts[i] = sum(different.sum() >= PIXELS for different in differences)
    return counts


def main() -> None:
    """Print the shares."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--decisions", type=int, default=100_000, help="of all environments")
    parser.add_argument("--wander-actions", type=ast.literal_eval, help="instead of the entry's")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    entry, settings = zoo_entry("uspl_ppo", ENV_ID), zoo_settings("uspl_ppo", ENV_ID)
    if given.wander_actions is not None:
        settings["wander_actions"] = given.wander_actions
    settings |= dict(encoder_updates=0, warmup_timesteps=2 * given.decisions, seed=given.seed)
    venv = make_venv(ENV_ID, entry["n_envs"], seed=given.seed, **entry["env_kwargs"])
    model = USPLPPO(entry["policy"], venv, **settings).learn(given.decisions)
    episodes = model.rollout_buffer.episodes
    assert episodes is not None
    stored = episodes.collate(list(episodes.replay))
    counts = ruled_out(stored.tokens["common"].numpy(), stored.truth.numpy())
    shares = np.bincount(counts, minlength=4) / len(counts)
    print(f"{len(counts):,} decisions; wrong corners ruled out: " + ", ".join(f"{k}: {s:.1%}" for k, s in enumerate(shares)))
    venv.close()


if __name__ == "__main__":
    main()
