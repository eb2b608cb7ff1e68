"""
How fast does a memory learn what a blind robot could know? The encoder alone, on scripted walks in Lateral Choice.

A third of the episodes walk to one end and, if nothing happens, to the other; a third walk to the goal; a third to the wrong
end. Whoever has been at an end without the episode ending knows the goal; nobody else does. Reported every 100 updates: the
mean standard deviation on held-out walks before and after that moment (before: 0.25 is right), and the seconds so far.

Run: ``OMP_NUM_THREADS=1 python benchmarks/encoder_learning.py [--width 64] [--updates 600]``
"""

import argparse
import math
import time

import gymnasium as gym
import numpy as np
import torch as th

import bullet_tasks  # noqa: F401 (registers the environment)
from bullet_tasks.tasks.navigation import MAX_TURN, POSITION_SCALE
from sb3_uspl.buffers import Episode, EpisodeReplayBuffer
from sb3_uspl.encoder import MEMORIES, ObservationEncoder, gaussian_nll

END = 3.6
"""m; past the rim of any goal circle."""
N_TRAIN, N_TEST, ACTION_NOISE, LEARNING_RATE, BATCH = 800, 100, 0.3, 1e-3, 4096


def walk(env: gym.Env, seed: int, rng: np.random.Generator) -> Episode:
    """One scripted episode."""
    obs, _ = env.reset(seed=seed)
    goal = math.copysign(1.0, float(obs["privileged"][0]))
    behaviour, first, visited = rng.choice(["blind", "informed", "misled"]), rng.choice([-1.0, 1.0]), False
    rows: dict[str, list[np.ndarray]] = {"common": [], "previous_action": [], "truth": []}
    action, over = np.zeros(1, np.float32), False
    while not over:
        for key, value in (("common", obs["common"]), ("previous_action", action), ("truth", obs["privileged"])):
            rows[key].append(value)
        x, y, cos_yaw, sin_yaw = (float(value) for value in obs["common"])
        visited = visited or x * POSITION_SCALE * first > END
        direction = {"blind": -first if visited else first, "informed": goal, "misled": -goal}[behaviour]
        heading = math.atan2(-y * POSITION_SCALE, direction)
        turn = math.remainder(heading - math.atan2(sin_yaw, cos_yaw), math.tau) / MAX_TURN
        action = np.clip([turn + rng.normal(0.0, ACTION_NOISE)], -1.0, 1.0).astype(np.float32)
        obs, _, terminated, truncated, _ = env.step(action)
        over = terminated or truncated
    return Episode({key: np.stack(value) for key, value in rows.items()}, mismatched=False)


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--width", type=int, default=64)
    parser.add_argument("--updates", type=int, default=600)
    arguments = parser.parse_args()
    env, rng = gym.make("LateralChoice-v0"), np.random.default_rng(0)
    space = env.observation_space
    assert isinstance(space, gym.spaces.Dict)
    episodes = [walk(env, seed, rng) for seed in range(N_TRAIN + N_TEST)]
    sizes = dict(hidden=(arguments.width,), trunk=(arguments.width,), embedding=(arguments.width,))
    print(f"{'memory':12}{'updates':>8}{'seconds':>9}{'NLL':>8}{'std before':>12}{'std after':>11}")
    for name in MEMORIES:
        th.manual_seed(0)
        buffer = EpisodeReplayBuffer(space, 1, 1, 0, 1024, 10**9, "all", seed=0)
        buffer.replay.extend(episodes[:N_TRAIN])
        test = buffer.collate(episodes[N_TRAIN:])
        at_end = (test.tokens["common"][:, 0].abs() * POSITION_SCALE > END).split(test.lengths.tolist())
        seen = th.cat([episode.cummax(dim=0).values for episode in at_end])
        encoder = ObservationEncoder(space, 1, memory=name, overrides=sizes)
        optimizer = th.optim.AdamW(encoder.parameters(), LEARNING_RATE, weight_decay=0.0)
        seconds = 0.0
        for update in range(arguments.updates + 1):
            if update % 100 == 0:
                with th.no_grad():
                    belief, _ = encoder(test.tokens, test.lengths)
                nll = gaussian_nll(belief, test.truth).item()
                before, after = belief.std[~seen].mean().item(), belief.std[seen].mean().item()
                print(f"{name:12}{update:>8}{seconds:>9.1f}{nll:>8.2f}{before:>12.3f}{after:>11.3f}", flush=True)
            begin = time.perf_counter()
            (batch,) = buffer.batches(1, BATCH)
            if update == 0:
                encoder.features.update_normalizers(batch.tokens)
            loss = gaussian_nll(encoder(batch.tokens, batch.lengths)[0], batch.truth)
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            th.nn.utils.clip_grad_norm_(encoder.parameters(), 1.0)
            optimizer.step()
            seconds += time.perf_counter() - begin


if __name__ == "__main__":
    main()
