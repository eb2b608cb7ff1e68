"""Small environments in plain numpy, to try the method in a minute without a simulator."""

import gymnasium as gym

from sb3_uspl.envs.active_t_maze import ActiveTMazeEnv
from sb3_uspl.envs.target_reaching import TargetReachingEnv

gym.register("TargetReaching-v0", entry_point="sb3_uspl.envs:TargetReachingEnv", max_episode_steps=TargetReachingEnv.MAX_STEPS)
# No max_episode_steps: its episodes end by themselves, after a time that depends on corridor_length.
gym.register("ActiveTMaze-v0", entry_point="sb3_uspl.envs:ActiveTMazeEnv")

__all__ = ["ActiveTMazeEnv", "TargetReachingEnv"]
