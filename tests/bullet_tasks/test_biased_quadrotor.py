"""Laws of Biased Quadrotor: nothing in flight tells the biases, landing does, and what that is worth."""

import gymnasium
import numpy as np
import pytest
from scripted_flights import BIAS_BOUNDS, CONFIG, Lander, fly_to, knowing, readings, trusting
from scripted_policies import run_episode

import bullet_tasks  # noqa: F401
from bullet_tasks.robots.quadrotor_ends import HoverLimits
from bullet_tasks.tasks.base import Outcome
from bullet_tasks.tasks.biased_quadrotor import BiasedQuadrotorConfig

PHYSICS = ("compiled", "kinematic", "full")
N_EPISODES = {"compiled": 200, "kinematic": 25, "full": 25}
N_FLIGHTS = 600
DECISIONS_IN_FLIGHT = 12
LANDED = 7  # index in `common`
DOWN = np.array((0.0, 0.0, -1.0), np.float32)


def make(physics="compiled", **config):
    return gymnasium.make("BiasedQuadrotor-v0", physics=physics, config=BiasedQuadrotorConfig(**config))


@pytest.fixture(params=PHYSICS)
def env(request):
    env = make(request.param)
    yield env
    env.close()


@pytest.fixture
def compiled():
    env = make()
    yield env
    env.close()


def episodes(env, make_pilot):
    n = N_EPISODES[env.unwrapped.spec.kwargs["physics"]]
    return [run_episode(env, make_pilot(), seed) for seed in range(n)]


def test_who_knows_the_biases_hovers_at_once(env):
    results = episodes(env, lambda: knowing)
    assert np.mean([e.success for e in results]) >= 0.99
    assert np.mean([e.decisions for e in results]) < 15


def test_who_lands_first_hovers_in_time(env):
    results = episodes(env, Lander)
    assert np.mean([e.success for e in results]) >= 0.97
    assert 15 < np.mean([e.decisions for e in results]) < 40, "landing takes time, but less than there is"


def test_who_trusts_the_sensors_fails(env):
    results = episodes(env, lambda: trusting)
    assert np.mean([e.success for e in results]) < 0.1
    assert not any(e.terminated and not e.success for e in results), "a hover in the wrong place is no crash"


def test_landing_costs_an_informed_pilot_and_pays_for_an_uninformed_one(compiled):
    returns = [
        np.mean([sum(e.rewards) for e in episodes(compiled, pilot)]) for pilot in (lambda: knowing, Lander, lambda: trusting)
    ]
    assert returns[0] > returns[1] + 1.0 and returns[1] > returns[2] + 5.0


def wander(env, seed):
    """What is observed in a flight by random commands that stays off the ground, ``(n, 8)``, and the biases."""
    rng = np.random.default_rng(10_000 + seed)
    observation, _ = env.reset(seed=seed)
    history = [observation["common"]]
    for _ in range(DECISIONS_IN_FLIGHT):
        observation, _, terminated, *_ = env.step(fly_to(rng.uniform(1.2, 2.2), *rng.uniform(-0.15, 0.15, 2)))
        assert not terminated and observation["common"][LANDED] == 0.0
        history.append(observation["common"])
    return np.array(history), observation["privileged"]


def restless(**config):
    """An environment in which no flight ends by a success, however it is flown."""
    return make(hover=HoverLimits(hold_time=100.0), **config)


def explained(features, values):
    """Share of the variance of each value that a ridge regression explains on flights it was not fitted to."""
    features = (features - features.mean(axis=0)) / (features.std(axis=0) + 1e-6)
    n = len(features) * 3 // 4
    mean = values[:n].mean(axis=0)
    fitted, unseen = features[:n], features[n:]
    weights = np.linalg.solve(fitted.T @ fitted + 0.1 * np.eye(features.shape[1]), fitted.T @ (values[:n] - mean))
    error = values[n:] - mean - unseen @ weights
    return 1.0 - error.var(axis=0) / values[n:].var(axis=0)


def test_nothing_in_a_flight_tells_the_biases_and_landing_tells_all():
    env = restless()
    histories, biases = zip(*(wander(env, seed) for seed in range(N_FLIGHTS)), strict=True)
    histories, biases = np.array(histories), np.array(biases)
    latest = histories[:, -1, :7]
    products = np.einsum("ni,nj->nij", latest, latest).reshape(N_FLIGHTS, -1)
    for features in (histories.reshape(N_FLIGHTS, -1), np.hstack((latest, products))):
        assert np.all(explained(features, biases) < 0.05)
        assert np.all(explained(features, biases**2) < 0.05), "not even their size"

    pilot_readings, truths = [], []
    for seed in range(100):
        observation, _ = env.reset(seed=seed)
        pilot = Lander()
        while observation["common"][LANDED] == 0.0:
            observation, _, terminated, *_ = env.step(pilot(observation))
            assert not terminated
        pilot_readings.append(observation["common"][:3])
        truths.append(observation["privileged"])
    env.close()
    assert np.all(explained(np.array(pilot_readings), np.array(truths)) > 0.99)


@pytest.mark.parametrize(("physics", "tolerance"), [("compiled", 1e-6), ("kinematic", 1e-6), ("full", 2e-3)])
def test_flights_with_other_biases_read_the_same(physics, tolerance):
    # The same draws give the same readings at the start, and biases in proportion to their bounds.
    config = {"hover": HoverLimits(hold_time=100.0)}
    pair = [make(physics, **config), make(physics, altitude_bias=0.1, angle_bias=0.02, **config)]
    for seed in range(10):
        (one, _), (other, _) = (wander(env, seed) for env in pair)
        assert pair[0].unwrapped.task.biases != pair[1].unwrapped.task.biases
        assert np.ptp(one[:, :3], axis=0).min() > 0.02, "they do fly about"
        assert np.allclose(one, other, rtol=0.0, atol=tolerance)
    for env in pair:
        env.close()


def test_on_the_ground_the_readings_are_the_biases(env):
    for seed in range(5):
        observation, _ = env.reset(seed=seed)
        pilot = Lander()
        while pilot.biases is None:
            assert observation["common"][LANDED] == 0.0
            assert np.abs(readings(observation) - env.unwrapped.task.biases).max() > 0.01
            observation, *_ = env.step(pilot(observation))
            pilot(observation)
        for _ in range(3):
            observation, *_, terminated, _, _ = env.step(DOWN)
        assert not terminated and observation["common"][LANDED] == 1.0
        assert readings(observation) == pytest.approx(env.unwrapped.task.biases, abs=0.005)
        assert observation["common"][3:7] == pytest.approx(0.0, abs=0.01)


def test_the_position_is_where_it_is_and_not_what_is_read(env):
    for seed in range(5):
        observation, info = env.reset(seed=seed)
        for _ in range(DECISIONS_IN_FLIGHT):
            altitude = 4.0 * observation["common"][0] - 1.5 * observation["privileged"][0]
            assert info["position"][2] == pytest.approx(altitude, abs=1e-5)
            observation, _, _, _, info = env.step(DOWN)


def test_a_fast_touchdown_is_a_crash_and_a_slow_one_is_not(env):
    task, robot = env.unwrapped.task, env.unwrapped.robot
    crashes = {True: 0, False: 0}
    for seed in range(25):
        env.reset(seed=seed)
        impact, terminated = 0.0, False
        while not (terminated or robot.state.landed):
            # The lower the target, the faster the touchdown; how low it is depends on the bias.
            _, _, terminated, truncated, info = env.step(fly_to(-0.75))
            impact = max(impact, robot.state.impact)
            assert not truncated and not info["is_success"]
        crashes[terminated] += 1
        assert info["reward_terms"]["crash"] == (CONFIG.reward.crash if terminated else 0.0)
        assert terminated == (impact > CONFIG.hover.crash_speed)
        assert terminated or task.biases[0] < 0.0, "the target is lower, the greater the bias"
    assert min(crashes.values()) > 2


@pytest.mark.parametrize("tilt", [0.2, 0.3])
def test_a_tilted_touchdown_is_a_crash(env, tilt):
    env.reset(seed=0)
    env.unwrapped.task.biases = (0.0, 0.0, 0.0)
    for _ in range(59):
        altitude = env.unwrapped.robot.state.altitude
        _, _, terminated, _, _ = env.step(fly_to(altitude - 0.4, tilt, tilt))
        if terminated or env.unwrapped.robot.state.landed:
            break
    assert terminated == (tilt == 0.3), "sqrt(2) times as much counts"


def test_a_hover_counts_when_it_has_been_held(compiled):
    compiled.reset(seed=0)
    task, robot = compiled.unwrapped.task, compiled.unwrapped.robot
    right = fly_to(1.5 + task.biases[0], task.biases[1], task.biases[2])
    wrong = fly_to(3.0 + task.biases[0], task.biases[1], task.biases[2])
    for _ in range(3):
        while abs(robot.state.altitude - 1.5) > 0.149:
            compiled.step(right)
        for _ in range(2):
            _, _, terminated, _, _ = compiled.step(right)
            assert not terminated
        while abs(robot.state.altitude - 1.5) < 0.151:
            _, _, terminated, _, _ = compiled.step(wrong)
            assert not terminated, "an interrupted hover begins anew"
    info = {"is_success": False}
    while not info["is_success"]:
        _, _, terminated, truncated, info = compiled.step(right)
        assert not truncated
    assert terminated
    time_left = 1.0 - robot.state.time / CONFIG.time_limit
    assert info["reward_terms"]["success"] == pytest.approx(8.0 + 12.0 * time_left)


def test_rewards_are_of_the_truth_by_the_second(compiled):
    compiled.reset(seed=1)
    task, robot = compiled.unwrapped.task, compiled.unwrapped.robot
    *_, info = compiled.step(fly_to(2.0))
    state, terms = robot.state, info["reward_terms"]
    assert terms["altitude"] == pytest.approx(0.5 * 0.2 * np.exp(-abs(state.altitude - 1.5) / 0.5))
    assert terms["level"] == pytest.approx(0.5 * 0.2 * np.exp(-np.hypot(state.roll, state.pitch) / 0.15))
    assert terms["low"] == terms["crash"] == terms["success"] == 0.0
    pilot, observation = Lander(), compiled.reset(seed=1)[0]
    while pilot.biases is None:
        observation, _, _, _, info = compiled.step(pilot(observation))
        assert (info["reward_terms"]["low"] == pytest.approx(-0.3)) == (robot.state.altitude < 0.3)
        pilot(observation)
    assert info["reward_terms"]["low"] == pytest.approx(-0.3)
    assert task.judge(robot.state) is task.judge(robot.state) is Outcome.RUNNING


def test_the_prior_is_on_the_scale_of_the_paper_and_apart_from_the_readings(compiled):
    starts = [compiled.reset(seed=seed)[0] for seed in range(1000)]
    privileged, common = (np.array([start[key] for start in starts]) for key in ("privileged", "common"))
    assert np.all((privileged.std(axis=0) > 0.2) & (privileged.std(axis=0) < 0.25))
    assert np.all(np.abs(privileged) <= 0.4) and np.abs(privileged.mean(axis=0)).max() < 0.03
    correlations = np.corrcoef(np.hstack((privileged, common[:, :3])).T) - np.eye(6)
    assert np.abs(correlations).max() < 0.1
    compiled.reset(seed=3)
    task = compiled.unwrapped.task
    assert task.privileged() / 0.4 * BIAS_BOUNDS == pytest.approx(task.biases, abs=1e-6)


def test_an_episode_in_full_physics_is_its_seed_and_actions_bit_for_bit():
    env, other = make("full"), make("full")
    for seed in (0, 1, 0):
        for physics_env in (env, other) if seed == 0 else (env,):
            observation, _ = physics_env.reset(seed=seed)
            pilot, trace = Lander(), []
            for _ in range(25):
                observation, reward, *_ = physics_env.step(pilot(observation))
                trace.append((observation["common"].tobytes(), reward))
            if seed == 0:
                first = locals().get("first", trace)
                assert trace == first and any(entry[0] != trace[0][0] for entry in trace)
    env.close()
    other.close()


def test_pictures_follow_the_drift(env):
    picture_env = gymnasium.make("BiasedQuadrotor-v0", physics=env.unwrapped.spec.kwargs["physics"], render_mode="rgb_array")
    picture_env.reset(seed=0)
    task, robot = picture_env.unwrapped.task, picture_env.unwrapped.robot
    for _ in range(15):
        picture_env.step(fly_to(1.5 + task.biases[0], 0.15, 0.15))
    assert abs(robot.state.x) > 0.5
    with_robot = picture_env.render()
    assert task.camera.target[:2] == (robot.state.x, robot.state.y)
    name, client = robot.name, picture_env.unwrapped.world.simulation
    client.client.resetBasePositionAndOrientation(client.body_id(name), (0.0, 0.0, -50.0), (0.0, 0.0, 0.0, 1.0))
    without = client.picture(task.camera, *task.picture_size)
    rows, columns = np.nonzero(np.any(with_robot != without, axis=2))
    picture_env.close()
    height, width = with_robot.shape[:2]
    assert len(rows) > 300
    assert abs(columns.mean() - width / 2) < 0.1 * width and abs(rows.mean() - height / 2) < 0.2 * height


def test_a_belief_over_the_angles_is_a_drift_on_the_map(compiled):
    task = compiled.unwrapped.task
    centre, half_widths = task.belief_in_world(np.array((0.3, 0.0, -0.4)), np.array((0.1, 0.2, 0.0)))
    assert centre == pytest.approx((0.2 * 9.81, 0.0)) and half_widths == pytest.approx((0.0, 0.1 * 9.81))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"altitude_bias": 0.0}, "altitude_bias"),
        ({"angle_bias": float("nan")}, "angle_bias"),
        ({"start_altitude": (0.5, 2.0)}, "above the ground"),
        ({"start_altitude": (2.0, 1.5)}, "start_altitude"),
        ({"start_altitude": (1.0, 9.0)}, "can be observed"),
        ({"start_tilt": -0.1}, "start_tilt"),
        ({"start_tilt": 2.0}, "start_tilt"),
        ({"altitude_range": 0.5}, "raise `altitude_range`"),
        ({"angle_range": 0.1}, "could not be levelled"),
        ({"decision_period": -0.2}, "decision_period"),
        ({"time_limit": 0.1}, "must not exceed"),
    ],
)
def test_impossible_worlds_are_refused(arguments, words):
    with pytest.raises(ValueError, match=words):
        BiasedQuadrotorConfig(**arguments)


def test_impossible_hovers_and_periods_are_refused():
    with pytest.raises(ValueError, match="hold_time"):
        HoverLimits(hold_time=0.0)
    with pytest.raises(ValueError, match="whole number"):
        make(decision_period=0.21, time_limit=12.6)
