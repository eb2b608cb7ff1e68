"""What ``benchmarks.gathering`` says that robots have gathered is what scripted ones did gather."""

import numpy as np
import pytest
from scripted_policies import SignReader, towards
from scripted_stacking import Guess, Oracle, Weigh, WeighWithoutGreen
from stable_baselines3.common.env_util import make_vec_env

from benchmarks.gathering import TASKS, Watch, table
from sb3_uspl.evaluation import EpisodeRecord, run_episodes

N = 12


class Scripted:
    """A script for each environment in the place of a trained model."""

    def __init__(self, make):
        self.scripts = [make() for _ in range(N)]

    policy = None  # no USPLPolicy: only `predict` is used

    def predict(self, obs, state, starts, deterministic):
        rows = [{key: value[i] for key, value in obs.items()} for i in range(N)]
        return np.stack([script(row) for script, row in zip(self.scripts, rows, strict=True)]), state


def gathered(env_id, make):
    shows, name = TASKS[env_id]
    venv = make_vec_env(env_id, N, env_kwargs={"physics": "compiled"})
    points = venv.envs[0].unwrapped.sensors[0].points if venv.envs[0].unwrapped.sensors else None
    watched = Watch(venv, shows)
    records = run_episodes(Scripted(lambda: make(points)), watched, N)
    watched.close()
    return [name(row) for row in watched.ever], np.array([record.success for record in records])


def test_who_reads_the_signpost_has_seen_it():
    names, success = gathered("SignpostNav-v0", SignReader)
    assert names.count("signpost seen") >= N - 2, "a goal may be found on the way there"
    assert success.mean() > 0.9
    names, _ = gathered("SignpostNav-v0", lambda points: lambda obs: towards(obs, (-2.0, 0.0)))
    assert names == ["signpost never seen"] * N


@pytest.mark.parametrize("turns", [1, 2, 3])
def test_corners_are_those_that_were_walked_to(turns):
    class Round:
        """Walk to some corners, one after the other, along the edge, and on to the last one's platform."""

        def __init__(self):
            self.way = [(1.1, 1.1), (-1.1, 1.1), (-1.1, -1.1)][:turns]
            self.way.append(tuple(np.sign(self.way[-1]) * 2.0))

        def __call__(self, obs):
            x, y = 8.0 * obs["common"][:2]
            if len(self.way) > 1 and np.hypot(x - self.way[0][0], y - self.way[0][1]) < 0.45:
                self.way.pop(0)
            return towards(obs, self.way[0])

    names, _ = gathered("MidpointChoice-v0", lambda points: Round())
    counts = [int(name[0]) for name in names]
    assert min(counts) == turns and max(counts) <= turns + 1, "a start may be near another corner"


@pytest.mark.parametrize(
    ("make", "names"),
    [
        (Oracle, {"green not weighed, 0 of the other two"}),
        (Weigh, {"green weighed, 1 of the other two", "green weighed, 2 of the other two"}),
        (lambda: WeighWithoutGreen(np.random.default_rng(0)), {"green not weighed, 2 of the other two"}),
        (lambda: Guess(np.random.default_rng(0)), {"green not weighed, 0 of the other two"}),
    ],
)
def test_cubes_are_those_that_were_weighed(make, names):
    seen, _ = gathered("BlindMassStack-v0", lambda points: make())
    assert set(seen) <= names


def test_success_by_what_was_gathered():
    episodes = [(True, 4), (False, 9), (False, 1), (True, 1)]
    records = [EpisodeRecord(0, success, positions=[np.zeros(2)] * length) for success, length in episodes]
    rows = table(["seen", "not seen", "seen", "seen"], records)
    assert rows == [
        {"gathered": "not seen", "episodes": 1, "success": 0.0, "decisions": 9.0},
        {"gathered": "seen", "episodes": 3, "success": 2 / 3, "decisions": 2.0},
        {"gathered": "all", "episodes": 4, "success": 0.5, "decisions": 3.75},
    ]
