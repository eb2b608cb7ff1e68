"""Laws of the Active T-Maze."""

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_uspl.envs import ActiveTMazeEnv

RIGHT, UP, LEFT, DOWN = range(4)


def run(env, actions, seed=0):
    """The first observation and everything that the actions bring; stops at the end of the episode."""
    obs, info = env.reset(seed=seed)
    steps = [(obs, 0.0, False, False, info)]
    for action in actions:
        steps.append(env.step(action))
        if steps[-1][2] or steps[-1][3]:
            break
    return steps


def run_optimally(env, seed):
    """Whether the best policy, which knows no more than it has seen, succeeds; and its return."""
    obs, _ = env.reset(seed=seed)
    hint, total, over, action = 0.0, 0.0, False, LEFT
    while not over:
        obs, reward, over, _, info = env.step(action)
        total += reward
        at_junction, second = obs["common"]
        if not at_junction and second:
            hint = second
        action = (UP if hint > 0 else DOWN) if at_junction else RIGHT
    return info["is_success"], total


def straight_on(corridor_length, turn):
    return [RIGHT] * corridor_length + [turn] * 3


@pytest.mark.parametrize("corridor_length", [1, 2, 20, 500])
def test_the_optimal_policy_always_succeeds_with_return_one(corridor_length):
    env = gym.make("ActiveTMaze-v0", corridor_length=corridor_length)
    for seed in range(20):
        assert run_optimally(env, seed) == (True, 1.0)


@pytest.mark.parametrize("turn", [UP, DOWN])
def test_without_the_oracle_half_of_the_episodes_fail(turn):
    env = ActiveTMazeEnv(corridor_length=5)
    ends = [run(env, straight_on(5, turn), seed)[-1] for seed in range(600)]
    successes = [info["is_success"] for *_, info in ends]
    assert 0.44 < np.mean(successes) < 0.56  # 3 standard errors
    assert [reward for _, reward, *_ in ends] == [float(success) for success in successes]


def test_both_sides_are_equally_likely_and_the_privileged_observation_names_them():
    env = ActiveTMazeEnv(corridor_length=3)
    env.reset(seed=0)
    sides = np.array([float(env.reset()[0]["privileged"][0]) for _ in range(4000)])
    assert set(sides) == {-0.25, 0.25}
    assert abs(np.mean(sides > 0) - 0.5) < 0.024  # 3 standard errors
    for seed in range(10):
        steps = run(env, straight_on(3, UP), seed)
        assert all(step[0]["privileged"] == steps[0][0]["privileged"] for step in steps)
        assert steps[-1][4]["is_success"] == (steps[0][0]["privileged"][0] > 0)


def test_the_hint_is_seen_at_the_first_visit_to_the_oracle_only():
    env = ActiveTMazeEnv(corridor_length=6)
    hints = set()
    for seed in range(10):
        steps = run(env, [RIGHT, LEFT, LEFT, LEFT, RIGHT, LEFT, RIGHT, RIGHT], seed)
        common = np.array([step[0]["common"] for step in steps])
        side = np.sign(steps[0][0]["privileged"][0])
        # Positions 1 2 1 0 0 1 0 1 2: the oracle is reached at the third step and again later.
        assert [step[4]["position"][0] for step in steps] == [1, 2, 1, 0, 0, 1, 0, 1, 2]
        np.testing.assert_array_equal(common, [(0, side if t == 3 else 0) for t in range(9)])
        hints.add(side)
    assert hints == {-1.0, 1.0}


def test_cells_before_the_junction_look_alike_and_beyond_it_y_is_seen():
    steps = run(ActiveTMazeEnv(corridor_length=4), [RIGHT, UP, RIGHT, RIGHT, RIGHT, UP, DOWN], seed=1)
    assert [step[4]["position"] for step in steps] == [(1, 0), (2, 0), (2, 0), (3, 0), (4, 0), (5, 0), (5, 1), (5, 0)]
    np.testing.assert_array_equal(
        [step[0]["common"] for step in steps], [(0, 0), (0, 0), (0, 0), (0, 0), (0, 0), (1, 0), (1, 1), (1, 0)]
    )


def test_the_walls_hold():
    walk = [LEFT, LEFT, DOWN, UP, RIGHT, RIGHT, RIGHT, RIGHT, DOWN, DOWN, LEFT, RIGHT]
    env = ActiveTMazeEnv(corridor_length=2)
    env.reset(seed=0)
    places = [env.step(action)[4]["position"] for action in walk]
    assert places == [(0, 0)] * 4 + [(1, 0), (2, 0), (3, 0), (3, 0), (3, -1), (3, -1), (3, -1), (3, -1)]


def test_penalties_computed_by_hand():
    env = ActiveTMazeEnv(corridor_length=4)  # 7 decisions, the table demands x >= t - 1
    late = -1 / 4

    def rewards(actions):
        return [step[1] for step in run(env, actions)[1:]]

    # x = 0 1 1 2 3 4 4 at t = 1 ... 7: behind the table from t = 3 on; the last decision has no penalty.
    assert rewards([LEFT, RIGHT, UP, RIGHT, RIGHT, RIGHT, UP]) == [0, 0, late, late, late, late, 0]
    # Two decisions to spare without the detour, not three: x = 1 1 1 2 3 4 5.
    assert rewards([UP, UP, UP, RIGHT, RIGHT, RIGHT, RIGHT]) == [0, 0, late, late, late, late, 0]
    # x = 1 1 2 3 4 5 5.
    assert rewards([UP, UP, RIGHT, RIGHT, RIGHT, RIGHT, RIGHT]) == [0] * 7
    assert sum(rewards([LEFT] * 7)) == pytest.approx(-5 / 4)


def test_one_step_too_many_after_the_detour_costs_the_goal():
    for seed in range(10):
        env = ActiveTMazeEnv(corridor_length=4)
        for turn in (UP, DOWN):
            assert not run(env, [LEFT, LEFT, RIGHT, RIGHT, RIGHT, RIGHT, RIGHT, turn], seed)[-1][4]["is_success"]


def test_the_bonus_is_for_being_at_the_goal_at_the_end():
    env = ActiveTMazeEnv(corridor_length=3)  # 6 decisions; the goal can be reached with the fourth
    goal_turn = UP if env.reset(seed=3)[0]["privileged"][0] > 0 else DOWN
    back = DOWN if goal_turn == UP else UP
    stayed, left = (run(env, [*[RIGHT] * 3, goal_turn, RIGHT, last], seed=3) for last in (RIGHT, back))
    assert [step[1] for step in stayed[1:]] == [0, 0, 0, 0, 0, 1] and stayed[-1][4]["is_success"] is True
    assert [step[1] for step in left[1:]] == [0] * 6 and left[-1][4]["is_success"] is False
    assert not any(step[4]["is_success"] for step in stayed[:-1])


@pytest.mark.parametrize("corridor_length", [1, 20, 500])
def test_an_episode_ends_by_itself_after_its_horizon(corridor_length):
    env = gym.make("ActiveTMaze-v0", corridor_length=corridor_length)
    steps = run(env, [UP] * 2000)
    assert len(steps) - 1 == corridor_length + 3 == env.unwrapped.episode_length
    assert steps[-1][2] and not any(step[3] for step in steps)


def test_vector_envs_take_the_horizon_for_an_end_not_for_an_interruption():
    venv = DummyVecEnv([lambda: gym.make("ActiveTMaze-v0", corridor_length=2)] * 2)
    venv.seed(0)
    venv.reset()
    for _ in range(5):
        obs, _, dones, infos = venv.step(np.full(2, RIGHT))
    assert dones.all() and not any(info["TimeLimit.truncated"] for info in infos)
    np.testing.assert_array_equal([info["terminal_observation"]["common"] for info in infos], [[1, 0]] * 2)
    np.testing.assert_array_equal(obs["common"], np.zeros((2, 2)))


def test_corridors_are_drawn_between_the_shortest_and_the_longest():
    env = ActiveTMazeEnv(corridor_length=500, shortest_corridor=2)
    env.reset(seed=0)
    lengths = np.array([(env.reset(), env.corridor_length)[1] for _ in range(20_000)])
    assert lengths.min() == 2 and 400 < lengths.max() <= 500
    # P(2) = (1/2 - 1/3) / (1/2 - 1/501); a half-open octave from a gets 1 / (2 a) / (1/2 - 1/501).
    np.testing.assert_allclose((lengths == 2).mean(), 0.1667 / 0.4980, atol=0.011)  # 3 standard errors
    for start in (2, 4, 8, 16):
        share = ((lengths >= start) & (lengths < 2 * start)).mean()
        assert share == pytest.approx(0.5 / start / 0.4980, abs=0.011)


def test_each_drawn_corridor_is_a_whole_task_and_a_seed_fixes_it():
    env = gym.make("ActiveTMaze-v0", corridor_length=30, shortest_corridor=1)
    drawn = set()
    for seed in range(60):
        assert run_optimally(env, seed) == (True, 1.0)
        length = env.unwrapped.corridor_length
        drawn.add(length)
        steps = run(env, [UP] * 100, seed)
        assert env.unwrapped.corridor_length == length and len(steps) - 1 == length + 3
        # x = 1 all the time: behind the table from t = 3 on, up to the last decision but one.
        assert sum(step[1] for step in steps) == pytest.approx(-1.0)
    assert len(drawn) > 5


def test_equal_bounds_draw_nothing():
    fixed, drawn = ActiveTMazeEnv(corridor_length=7), ActiveTMazeEnv(corridor_length=7, shortest_corridor=7)
    for seed in range(10):
        assert fixed.reset(seed=seed)[0]["privileged"] == drawn.reset(seed=seed)[0]["privileged"]
        assert drawn.corridor_length == 7


def test_changing_an_observation_changes_nothing_in_the_maze():
    env, twin = ActiveTMazeEnv(corridor_length=2), ActiveTMazeEnv(corridor_length=2)
    walk = [LEFT, RIGHT, RIGHT, RIGHT, UP]
    for seed in range(4):
        for obs, *_ in run(env, walk, seed):
            for value in obs.values():
                value += 1.0
    for seed in range(4):
        for (obs, *_), (clean, *_) in zip(run(env, walk, seed), run(twin, walk, seed), strict=True):
            for key, value in clean.items():
                np.testing.assert_array_equal(obs[key], value)


def test_the_picture_shows_where_things_are():
    env = ActiveTMazeEnv(corridor_length=4, render_mode="rgb_array")
    steps = run(env, [LEFT, RIGHT, RIGHT], seed=0)
    picture, cell = env.render(), ActiveTMazeEnv.PICTURE_WIDTH // 6
    assert picture.shape == (3 * cell, 6 * cell, 3) and picture.dtype == np.uint8
    colours = picture[cell // 2 :: cell, cell // 2 :: cell]
    green, orange = (colours == (51, 184, 97)).all(-1), (colours == (214, 94, 0)).all(-1)
    goal_row = 0 if steps[0][0]["privileged"][0] > 0 else 2
    assert np.argwhere(green).tolist() == [[goal_row, 5]] and np.argwhere(orange).tolist() == [[1, 2]]
    assert ActiveTMazeEnv().render() is None


def test_a_belief_lies_on_the_map():
    centre, half_widths = ActiveTMazeEnv(corridor_length=4).belief_in_world(np.array([-0.25]), np.array([0.125]))
    assert centre.tolist() == [5, -1] and half_widths.tolist() == [0, 0.5]


@pytest.mark.parametrize("corridor_length", [0, -3, 2.5, "20"])
def test_an_impossible_corridor_is_refused(corridor_length):
    with pytest.raises(ValueError, match="integer >= 1"):
        ActiveTMazeEnv(corridor_length=corridor_length)


@pytest.mark.parametrize("shortest_corridor", [0, 21, 2.5])
def test_an_impossible_shortest_corridor_is_refused(shortest_corridor):
    with pytest.raises(ValueError, match="from 1 to 20"):
        ActiveTMazeEnv(corridor_length=20, shortest_corridor=shortest_corridor)


def test_unknown_render_mode_is_refused():
    with pytest.raises(ValueError, match="rgb_array"):
        ActiveTMazeEnv(render_mode="human")
