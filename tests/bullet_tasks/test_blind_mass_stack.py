"""Laws of Blind-Mass Stack: what can be told by weighing and what cannot, what pays, and that all physics agree."""

import math

import gymnasium
import numpy as np
import pytest
from scripted_policies import run_episode
from scripted_stacking import (
    CLOSE,
    HIGH,
    LOW,
    MIDDLE,
    OPEN,
    Guess,
    Oracle,
    Weigh,
    WeighWithoutGreen,
    pick_and_stack,
    reading,
)
from stable_baselines3.common.vec_env import DummyVecEnv

import bullet_tasks  # noqa: F401
from bullet_tasks.robots.panda_arm import CARRY_HEIGHT, DECISION_PERIOD, EDGE, HEIGHTS, NOTHING, ArmCommand
from bullet_tasks.robots.panda_full import SUBSTEP
from bullet_tasks.tasks.blind_mass_stack import BlindMassStack, BlindMassStackConfig, make_env
from bullet_tasks.vec_env import BulletVecEnv

N_EPISODES = 500
IK_TOLERANCE = 2e-4  # m


@pytest.fixture
def env():
    env = gymnasium.make("BlindMassStack-v0", physics="compiled")
    yield env
    env.close()


@pytest.fixture(scope="module")
def full():
    env = gymnasium.make("BlindMassStack-v0", physics="full")
    yield env
    env.close()


def start(env, seed=0):
    """Reset; indices of the red, the green and the blue cube."""
    env.reset(seed=seed)
    task = env.unwrapped.task
    return task.red, task.green, task.blue


def act(env, *actions):
    """Carry out some actions; what the last one returned."""
    for action in actions:
        result = env.step(np.array(action))
    return result


# -- what weighing is worth ---------------------------------------------------------------------------------------------------


def successes(env, make_policy):
    episodes = [run_episode(env, make_policy(), seed) for seed in range(N_EPISODES)]
    return np.mean([episode.success for episode in episodes]), episodes


def test_who_knows_red_always_succeeds_with_two_decisions(env):
    rate, episodes = successes(env, Oracle)
    assert rate == 1.0
    assert {episode.decisions for episode in episodes} == {2}


def test_weighing_green_and_another_tells_red(env):
    rate, episodes = successes(env, Weigh)
    assert rate >= 0.99
    assert max(episode.decisions for episode in episodes) <= 8
    assert np.mean([episode.decisions for episode in episodes]) == pytest.approx(7.0, abs=0.15)


def test_a_guess_is_right_in_half_of_the_episodes_and_a_wrong_one_ends_them(env):
    rng = np.random.default_rng(0)
    rate, episodes = successes(env, lambda: Guess(rng))
    assert rate == pytest.approx(0.5, abs=0.067)  # 3 standard errors
    assert all(episode.terminated and episode.decisions == 2 for episode in episodes)


def test_weighing_without_green_is_little_better_than_guessing(env):
    rng = np.random.default_rng(0)
    rate, _ = successes(env, lambda: WeighWithoutGreen(rng))
    # Expected: 1/2 + 1/2 * E|log(ratio)| / log(4) = 0.58.
    assert 0.5 < rate < 0.65


def test_no_threshold_on_one_raw_reading_tells_red_from_blue(env):
    readings = {"red": [], "blue": []}
    for seed in range(N_EPISODES):
        red, _, blue = start(env, seed)
        for name, cube in (("red", red), ("blue", blue)):
            observation, *_ = act(env, (cube, LOW, CLOSE), (cube, HIGH, CLOSE))
            readings[name].append(reading(observation))
            act(env, (cube, LOW, OPEN))
    red_readings, blue_readings = np.sort(readings["red"]), np.sort(readings["blue"])
    assert red_readings.std() > 0.2, "the bias must spread them"
    thresholds = np.linspace(0.2, 2.2, 200)
    shares = [np.searchsorted(values, thresholds) / N_EPISODES for values in (red_readings, blue_readings)]
    assert np.abs(shares[0] - shares[1]).max() < 0.2, "the best threshold is right in less than 60 %"


def test_privileged_values_are_on_the_scale_of_the_paper(env):
    task = env.unwrapped.task
    values, greens = [], []
    for seed in range(1000):
        values.append(env.reset(seed=seed)[0]["privileged"])
        greens.append(task.green)
    values, greens = np.array(values), np.array(greens)
    assert set(values[:, 0]) == {np.float32(v) for v in env.unwrapped.discrete_privileged[0]}
    within = [values[greens == green, 0].var() for green in range(3)]
    assert 0.2 < math.sqrt(np.mean(within)) < 0.25, "to a robot that knows which cube is green"
    assert 0.2 < values[:, 0].std() < 0.25 and 0.2 < values[:, 1].std() < 0.25
    assert (np.abs(values) <= env.observation_space["privileged"].high).all()


def test_colours_and_masses_are_drawn_alike(env):
    task, orders, ratios, biases = env.unwrapped.task, [], [], []
    for seed in range(1000):
        red, green, blue = start(env, seed)
        orders.append((red, green, blue))
        assert task.masses[red] == 0.75 and task.masses[green] == 1.0
        ratios.append(task.masses[blue] / 0.75)
        biases.append(task.bias)
    counts = [orders.count(order) for order in set(orders)]
    assert len(counts) == 6 and min(counts) > 130
    distances = np.abs(np.log(ratios))
    assert math.log(1.15) - 1e-9 <= distances.min() and distances.max() <= math.log(1.35) + 1e-9
    assert np.mean(np.array(ratios) > 1.0) == pytest.approx(0.5, abs=0.05)
    assert 0.5 <= min(biases) < 0.53 and 1.9 < max(biases) <= 2.0


# -- what a decision does -----------------------------------------------------------------------------------------------------


def test_the_scale_shows_the_biased_mass_of_what_hangs_free(env):
    for seed in range(20):
        red, green, blue = start(env, seed)
        task = env.unwrapped.task
        place = 1 if red < blue else 2
        standing, *_ = act(env, (red, LOW, CLOSE))
        lifted, *_ = act(env, (red, MIDDLE, CLOSE))
        carried, *_ = act(env, (green, HIGH, CLOSE))
        on_green, *_ = act(env, (green, LOW, CLOSE))
        for observation, expected in ((standing, 0.0), (lifted, 0.75), (carried, 0.75), (on_green, 0.0)):
            assert reading(observation) == pytest.approx(task.bias * expected, abs=1e-6)
            assert observation["common"][15:19].tolist() == [1.0, *(float(i == red) for i in range(3))]
            assert (observation["common"][19:] > 0.0).tolist() == [i == place and expected > 0.0 for i in range(3)]
        on_red, *_ = act(env, (red, LOW, OPEN), (green, LOW, CLOSE), (red, HIGH, CLOSE))
        assert reading(on_red) == pytest.approx(task.bias, abs=1e-6) and on_red["common"][19] > 0.0


def test_observed_positions_are_the_cubes_and_the_hands(env):
    red, green, _ = start(env)
    scene = env.unwrapped.scene
    observation, *_ = act(env, (red, LOW, CLOSE), (green, HIGH, CLOSE))
    positions = observation["common"][:12].reshape(4, 3) * 0.3 + np.array([0.5, 0.0, 0.0])
    above_green = (*scene["green"].centre[:2], CARRY_HEIGHT)
    assert positions[red] == pytest.approx(above_green, abs=1e-6)
    assert positions[green] == pytest.approx(scene["green"].centre, abs=1e-6)
    assert positions[3] == pytest.approx(above_green, abs=1e-6)
    assert np.argmax(observation["common"][12:15]) == green
    assert (np.diff([shape.centre[1] for shape in map(scene.__getitem__, env.unwrapped.robot.names)]) > 0.1).all()


def test_the_hand_does_not_drop_what_it_holds(env):
    red, green, _ = start(env)
    observation, *_ = act(env, (red, LOW, CLOSE), (red, HIGH, OPEN), (green, HIGH, OPEN))
    assert observation["common"][15] == 1.0 and reading(observation) > 0.0


def test_the_gripper_closes_only_around_a_cube(env):
    red, *_ = start(env)
    for height in (MIDDLE, HIGH):
        observation, *_ = act(env, (red, height, CLOSE))
        assert observation["common"][15] == 0.0
    assert act(env, (red, LOW, CLOSE))[0]["common"][15] == 1.0


def test_stacks_grow_and_are_taken_apart_from_the_top(env):
    red, green, blue = start(env)
    robot = env.unwrapped.robot
    # Neither of these is red on green or blue on green.
    *_, terminated, _, _ = act(env, (green, LOW, CLOSE), (blue, LOW, OPEN))
    assert not terminated and robot.state.cubes[green][2] == 1.5 * EDGE
    act(env, (red, LOW, CLOSE), (red, HIGH, CLOSE), (red, LOW, OPEN))
    act(env, (blue, LOW, CLOSE))
    assert robot.state.held == green, "the hand stops at the top of the stack"
    act(env, (green, LOW, OPEN))
    assert robot.state.cubes[green][2] == 0.5 * EDGE and robot.state.held == NOTHING
    *_, terminated, _, info = act(env, *pick_and_stack(red, green))
    assert terminated and info["is_success"]


def test_red_on_green_counts_wherever_green_stands_and_only_released(env):
    red, green, blue = start(env)
    *_, terminated, _, info = act(env, (green, LOW, CLOSE), (blue, LOW, OPEN), (red, LOW, CLOSE), (blue, LOW, CLOSE))
    assert not terminated and env.unwrapped.robot.state.cubes[red][2] == 2.5 * EDGE
    *_, terminated, _, info = act(env, (blue, LOW, OPEN))
    assert terminated and info["is_success"]


def test_blue_on_green_is_a_failure(env):
    _, green, blue = start(env)
    *_, terminated, truncated, info = act(env, *pick_and_stack(blue, green))
    assert terminated and not truncated and not info["is_success"]
    assert info["reward_terms"]["success_bonus"] == 0.0


def test_an_episode_of_idling_is_truncated(env):
    start(env)
    results = [act(env, (0, HIGH, OPEN)) for _ in range(24)]
    assert [truncated for *_, truncated, _ in results] == [False] * 23 + [True]


# -- rewards ------------------------------------------------------------------------------------------------------------------


def terms(env, *actions):
    return [act(env, action)[4]["reward_terms"] for action in actions]


def test_rewards_computed_by_hand(env):
    red, green, _ = start(env, seed=1)
    scene, state = env.unwrapped.scene, env.unwrapped.robot.state
    length = 2 * (0.2 + 0.03)
    to_red = math.dist((state.x, state.y), scene["red"].centre[:2]) / length
    to_green = math.dist(scene["red"].centre[:2], scene["green"].centre[:2]) / length
    grasp, lift, carry, put = terms(env, (red, LOW, CLOSE), (red, HIGH, CLOSE), (green, MIDDLE, CLOSE), (green, MIDDLE, OPEN))
    assert grasp == pytest.approx({"approach": to_red, "lift": 0.0, "carry": 0.0, "success_bonus": 0.0})
    assert lift == pytest.approx({"approach": 0.0, "lift": 1.0, "carry": max(0.0, 1.0 - to_green), "success_bonus": 0.0})
    assert carry == pytest.approx({"approach": 0.0, "lift": 0.0, "carry": min(1.0, to_green), "success_bonus": 0.0})
    assert put == pytest.approx({"approach": 0.0, "lift": 0.0, "carry": 0.0, "success_bonus": 4.0 + 2.0 * 20 / 24})


def test_what_is_undone_is_paid_back(env):
    for seed in range(10):
        red, green, blue = start(env, seed)
        act(env, (red, HIGH, OPEN))
        rewards = []
        for cube in (green, blue, red):
            for action in ((cube, LOW, CLOSE), (cube, MIDDLE, CLOSE), (green, HIGH, CLOSE), (cube, LOW, OPEN)):
                rewards.append(act(env, action)[1])
        act(env, (red, HIGH, OPEN))
        assert sum(rewards) == pytest.approx(0.0, abs=1e-9)
        assert max(rewards) > 0.5, "it did pay for a while"


# -- physics ------------------------------------------------------------------------------------------------------------------


def test_compiled_is_kinematic_exactly():
    pair = [gymnasium.make("BlindMassStack-v0", physics=physics) for physics in ("kinematic", "compiled")]
    ends = set()
    for seed in range(15):
        rng = np.random.default_rng(seed)
        resets = [env.reset(seed=seed) for env in pair]
        for key in ("common", "privileged"):
            assert resets[0][0][key].tobytes() == resets[1][0][key].tobytes()
        over = False
        while not over:
            action = rng.integers((3, 3, 2))
            ours, theirs = (env.step(action) for env in pair)
            for key in ("common", "privileged"):
                assert ours[0][key].tobytes() == theirs[0][key].tobytes()
            assert ours[1:4] == theirs[1:4] and ours[4]["reward_terms"] == theirs[4]["reward_terms"]
            over = ours[2] or ours[3]
        ends.add((ours[2], ours[4]["is_success"]))
    for env in pair:
        env.close()
    assert len(ends) == 3, "success, failure and truncation"


def test_the_kinematic_body_is_where_its_state_says():
    env = gymnasium.make("BlindMassStack-v0", physics="kinematic")
    robot = env.unwrapped.robot
    heights = set()
    for seed in range(3):
        env.reset(seed=seed)
        for action in np.random.default_rng(seed).integers((3, 3, 2), size=(15, 3)):
            *_, terminated, _, _ = env.step(action)
            state, simulation = robot.state, env.unwrapped.world.simulation
            assert robot._body.hand() == pytest.approx(state[:3], abs=IK_TOLERANCE)
            for name, centre in zip(robot.names, state.cubes, strict=True):
                position, _ = simulation.client.getBasePositionAndOrientation(simulation.body_id(name))
                assert position == pytest.approx(centre)
            heights.add(round(state.z, 3))
            if terminated:
                break
    env.close()
    assert heights >= {round(height, 3) for height in HEIGHTS}


def test_no_pybullet_client_for_the_compiled_arm(env):
    start(env)
    act(env, (0, LOW, CLOSE))
    assert not env.unwrapped.world.simulated


def test_full_physics_weighs_and_stacks_as_the_others(env, full):
    for seed in range(6):
        for make_policy in (Oracle, Weigh):
            easy, hard = run_episode(env, make_policy(), seed), run_episode(full, make_policy(), seed)
            assert hard.success and hard.decisions == easy.decisions
            assert hard.rewards == pytest.approx(easy.rewards, abs=0.01)


def test_full_physics_feels_masses_through_the_constraint(full):
    for seed in range(3):
        start(full, seed)
        task, robot = full.unwrapped.task, full.unwrapped.robot
        for cube in range(3):
            act(full, (cube, LOW, CLOSE))
            assert robot.state.load == 0.0
            act(full, (cube, MIDDLE, CLOSE))
            assert robot.state.load == pytest.approx(task.masses[cube], rel=2e-3)
            act(full, ((cube + 1) % 3, HIGH, CLOSE))
            assert robot.state.load == pytest.approx(task.masses[cube], rel=2e-3)
            act(full, (cube, LOW, OPEN))
            for name, centre in zip(robot.names, robot.state.cubes, strict=True):
                assert centre == pytest.approx(full.unwrapped.scene[name].centre, abs=0.003)


def test_full_physics_repeats_bit_for_bit_whatever_happened_before(full):
    actions = [(0, LOW, CLOSE), (1, HIGH, CLOSE), (1, LOW, OPEN), (2, LOW, CLOSE), (0, LOW, OPEN), (1, HIGH, OPEN)]

    def record(env):
        env.reset(seed=5)
        return [env.step(np.array(action))[0]["common"].tobytes() for action in actions]

    first = record(full)
    assert record(full) == first
    start(full, 8)
    act(full, (2, LOW, CLOSE), (1, HIGH, CLOSE))
    assert record(full) == first
    other = gymnasium.make("BlindMassStack-v0", physics="full")
    assert record(other) == first
    other.close()


def test_every_motion_ends_within_the_decision_period(full):
    start(full)
    robot, judge = full.unwrapped.robot, full.unwrapped.task.judge
    limit = round(DECISION_PERIOD / SUBSTEP)
    step, steps, longest = robot._step, [], 0
    robot._step = lambda: steps.append(step())
    # From one end of the row to the other, down to the table, where the gripper acts, and back with the cube.
    for command in (
        ArmCommand(0, LOW, False),
        ArmCommand(2, LOW, True),
        ArmCommand(2, HIGH, True),
        ArmCommand(0, MIDDLE, False),
        ArmCommand(2, LOW, False),
        ArmCommand(0, LOW, True),
        ArmCommand(2, HIGH, True),
        ArmCommand(2, LOW, False),
    ):
        robot.command(command)
        steps.clear()
        robot.advance(10 * limit, judge)
        longest = max(longest, len(steps))
    assert 0.5 * limit < longest < 0.95 * limit


@pytest.mark.parametrize("physics", ["kinematic", "compiled", "full"])
def test_pictures_show_the_cubes_where_they_are(physics):
    env = make_env(physics=physics, render_mode="rgb_array")
    red, green, _ = start(env)
    assert env.render().shape == (480, 640, 3)
    act(env, (red, LOW, CLOSE), (green, HIGH, CLOSE))
    env.render()
    simulation = env.world.simulation
    shown = {"full": ("red_body", "red")}.get(physics, ("red",))
    positions = [simulation.client.getBasePositionAndOrientation(simulation.body_id(name))[0] for name in shown]
    assert positions[0] == pytest.approx((*env.scene["green"].centre[:2], CARRY_HEIGHT), abs=0.002)
    assert all(position[2] < -50.0 for position in positions[1:]), "each cube is seen once"
    env.close()


# -- the rest -----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("venv_class", [DummyVecEnv, BulletVecEnv])
def test_the_environment_names_its_discrete_privileged_dimensions(venv_class):
    venv = venv_class([lambda: gymnasium.make("BlindMassStack-v0", physics="compiled")] * 2)
    assert venv.get_attr("discrete_privileged") == [{0: (-0.3, 0.0, 0.3)}] * 2
    venv.close()


@pytest.mark.parametrize("action", [(3, 0, 0), (0, 3, 0), (0, 0, 2), (-1, 0, 0), (0.5, 0, 0)])
def test_choices_that_there_are_not_are_refused(env, action):
    start(env)
    with pytest.raises(ValueError, match="whole numbers"):
        env.unwrapped.step(np.array(action))


def test_a_belief_is_drawn_at_the_red_cubes_place(env):
    for seed in range(6):
        observation, _ = env.reset(seed=seed)
        centre, half_widths = env.unwrapped.task.belief_in_world(observation["privileged"], np.array([0.15, 0.2]))
        assert centre == pytest.approx(env.unwrapped.scene["red"].centre[:2], abs=0.031)
        assert half_widths == pytest.approx((0.0, 0.1))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"green_mass": 0.0}, "green_mass"),
        ({"red_mass": float("nan")}, "red_mass"),
        ({"blue_ratio": (1.0, 1.3)}, "cannot be told"),
        ({"blue_ratio": (1.4, 1.3)}, "blue_ratio"),
        ({"greatest_bias": 1.0}, "greatest_bias"),
        ({"greatest_bias": 3.0}, "beyond the 2.5 kg"),
        ({"red_mass": 0.6}, "above the 0.25 kg"),
        ({"jitter": 0.05}, "needs 0.13 m"),
        ({"jitter": -0.01}, "jitter"),
        ({"spacing": 0.29}, "reach"),
        ({"place_x": 0.8}, "reach"),
        ({"n_decisions": 0}, "n_decisions"),
    ],
)
def test_impossible_worlds_are_refused(arguments, words):
    with pytest.raises(ValueError, match=words):
        BlindMassStack(BlindMassStackConfig(**arguments))


def test_every_corner_of_every_possible_world_is_within_reach():
    for place_x in (0.4, 0.6):
        env = make_env("kinematic", config=BlindMassStackConfig(place_x=place_x, spacing=0.265, jitter=0.03))
        for seed in range(3):
            env.reset(seed=seed)
            for action in [(0, LOW, CLOSE), (2, HIGH, CLOSE), (2, LOW, OPEN), (1, LOW, OPEN), (1, HIGH, OPEN)]:
                env.step(np.array(action))
                assert env.robot._body.hand() == pytest.approx(env.robot.state[:3], abs=IK_TOLERANCE)
        env.close()
