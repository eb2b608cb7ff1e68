"""Pictures and films are written, and show each episode from its first decision to its end."""

import base64
import contextlib

import cv2
import gymnasium as gym
import numpy as np
import pytest
from PIL import Image
from stable_baselines3 import PPO

pytest.importorskip("matplotlib")

import bullet_tasks  # noqa: F401
from sb3_uspl import USPLPPO
from sb3_uspl.envs import TargetReachingEnv
from sb3_uspl.evaluation import EpisodeRecord
from sb3_uspl.film import FIRST_FRAME_TIME, FRAMES_PER_SECOND, LAST_FRAME_TIME, _as_grey, _write_mp4, film, record_clip
from sb3_uspl.pictures import _quantile_over_time, _read_progress, learning_curve, on_map, sigma_over_time
from sb3_uspl.replay import page_data

pytestmark = pytest.mark.filterwarnings("error")


def write_progress(path, shift=0):
    """Like SB3's: each row holds some metrics only, and the first rows know nothing of later columns."""
    rows = ["time/total_timesteps,rollout/success_rate,uspl/uncertainty,uspl/progress,eval/success_rate"]
    for i in range(1, 11):
        steps = 8192 * i + shift
        rows.append(f"{steps},{0.1 * i},{0.5 / i},{min(1.0, max(0.0, (i - 3) / 4))},")
        if i % 3 == 0:
            rows.append(f"{steps + 50},,,,{0.08 * i}")
    path.write_text("\n".join(rows) + "\n")
    return path


def tiny(env):
    return USPLPPO("MlpPolicy", env, n_steps=64, batch_size=64, mismatch_fraction=0.0, seed=0, device="cpu")


@pytest.fixture(scope="module")
def corridor():
    env = gym.make("LateralChoice-v0", render_mode="rgb_array")
    yield env
    env.close()


def picture_size(path):
    with Image.open(path) as image:
        assert len(image.getcolors(image.width * image.height)) > 10, "not empty"
        return image.size


def gif_frames(path):
    with Image.open(path) as image:
        durations = []
        for i in range(image.n_frames):
            image.seek(i)
            durations.append(image.info["duration"] / 1000.0)
        return durations, image.size


def test_learning_curve_of_one_run_of_seeds_and_of_algorithms(tmp_path):
    runs = [write_progress(tmp_path / f"{i}.csv", 100 * i) for i in range(3)]
    for i, progress in enumerate((runs[0], runs, {"USPL": runs, "RMA": runs[0]})):
        learning_curve(progress, tmp_path / f"{i}.png")
    one, seeds, algorithms = (picture_size(tmp_path / f"{i}.png") for i in range(3))
    assert one == seeds and algorithms[0] > 1.4 * one[0] and algorithms[1] == one[1]


def test_learning_curve_of_a_training_that_has_just_begun(tmp_path):
    (tmp_path / "progress.csv").write_text("time/total_timesteps,rollout/success_rate\n64,0.5\n")
    learning_curve(tmp_path / "progress.csv", tmp_path / "a.png")
    assert (tmp_path / "a.png").stat().st_size > 1000


def test_a_file_that_is_no_training_is_refused(tmp_path):
    (tmp_path / "a.csv").write_text("x,y\n1,2\n")
    with pytest.raises(ValueError, match="total_timesteps"):
        _read_progress(tmp_path / "a.csv")
    with pytest.raises(ValueError, match=r"No progress\.csv"):
        learning_curve([], tmp_path / "a.png")


def test_quantiles_are_over_the_episodes_that_still_run():
    np.testing.assert_allclose(_quantile_over_time([np.array([0.0, 5.0]), np.array([4.0])], 0.25), [1.0, 5.0])


@pytest.mark.parametrize("world", [None, TargetReachingEnv().belief_in_world])
def test_sigma_over_time(tmp_path, world):
    rng = np.random.default_rng(0)
    records = {}
    for name in ("USPL", "RMA"):
        records[name] = [EpisodeRecord(seed) for seed in range(5)]
        for i, record in enumerate(records[name]):
            for values in (record.truth, record.belief_mean, record.belief_std):
                values += list(rng.random((4 + i, 1)))
    sigma_over_time(records, 0.25, tmp_path / "sigma.png", world)
    assert min(picture_size(tmp_path / "sigma.png")) > 400


def test_belief_on_the_map_is_in_the_maps_unit(corridor):
    task = corridor.unwrapped.task
    centre, half_widths, sigma, error = on_map(task.belief_in_world, np.array([0.0]), np.array([0.25]), np.array([-0.25]))
    np.testing.assert_allclose([*centre, *half_widths, sigma, error], [0, 0, 4, 0, 4, 4])


def test_film_has_a_frame_per_decision_and_one_for_the_end(tmp_path, corridor):
    model = tiny(corridor)
    (clip,) = film({"USPL": model}, corridor, [3], tmp_path / "film.gif")
    durations, size = gif_frames(tmp_path / "film.gif")
    n_decisions = len(clip.poses) - 1
    assert len(durations) == n_decisions + 1 == len(clip.pictures) == len(clip.sigmas)
    assert (durations[0], durations[-1]) == (FIRST_FRAME_TIME, LAST_FRAME_TIME)
    assert sum(durations[1:-1]) == pytest.approx((n_decisions - 1) / FRAMES_PER_SECOND, rel=0.05)
    assert size[0] == 900 and (tmp_path / "film.gif").stat().st_size < 3e6
    assert clip.seed == 3 and clip.scene["goal"].centre[0] == pytest.approx(clip.goal[0])


def test_several_agents_are_stacked_and_episodes_follow_each_other(tmp_path, corridor):
    env = gym.wrappers.TimeLimit(corridor, 6)
    model = tiny(env)
    clips = film({"USPL": model, "RMA": model}, env, [3, 4], tmp_path / "film.gif")
    assert [clip.seed for clip in clips] == [3, 3, 4, 4]
    assert clips[0].poses == clips[1].poses, "the same episode for both"
    assert len(gif_frames(tmp_path / "film.gif")[0]) == sum(len(clip.poses) for clip in clips[::2])


def test_film_of_an_environment_without_scene_or_picture(tmp_path):
    env = gym.wrappers.TimeLimit(TargetReachingEnv(), 5)
    clips = film({"USPL": tiny(env)}, env, [0], tmp_path / "film.gif")
    assert clips[0].pictures == [] and len(gif_frames(tmp_path / "film.gif")[0]) == len(clips[0].poses) == 6
    np.testing.assert_allclose(clips[0].goal, env.unwrapped.target, atol=1e-6)


class Seen(gym.ObservationWrapper):
    """Notes the images that the robot gets."""

    def __init__(self, env):
        super().__init__(env)
        self.images = []

    def observation(self, obs):
        self.images.append(obs["target"][0].copy())
        return obs


@pytest.mark.parametrize("env_id", ["SignpostNavDepth-v0", "MidpointChoiceDepth-v0", "StairwaySearchDepth-v0"])
def test_a_depth_camera_is_seen_in_the_film_and_in_the_replay(env_id, tmp_path):
    with contextlib.closing(Seen(gym.wrappers.TimeLimit(gym.make(env_id, render_mode="rgb_array"), 3))) as env:
        (clip,) = film({"USPL": tiny(env)}, env, [0], tmp_path / "film.gif")
    assert len(clip.views) == len(clip.pictures) == len(clip.poses) == 4
    np.testing.assert_array_equal(clip.views, env.images)
    assert clip.views[0].min() < clip.views[0].max(), "or there is nothing to see"
    assert len(gif_frames(tmp_path / "film.gif")[0]) == 4
    pictures = page_data(clip, [0.3] * 4, 0.25)["camera"]
    shown = cv2.imdecode(np.frombuffer(base64.b64decode(pictures[-1].split(",")[1]), np.uint8), cv2.IMREAD_UNCHANGED)
    scale = shown.shape[0] // clip.views[-1].shape[0]
    assert scale > 1
    np.testing.assert_array_equal(shown[::scale, ::scale], clip.views[-1])


def test_a_view_in_half_precision_is_black_to_white_between_its_bounds():
    space = gym.spaces.Box(-1.0, 3.0, (1, 2, 2), np.float16)
    image = np.array([[[-1.0, 1.0], [2.0, 3.0]]], np.float16)
    np.testing.assert_array_equal(_as_grey(image, space), [[0, 128], [191, 255]])


def test_mp4_repeats_still_frames(tmp_path):
    imageio = pytest.importorskip("imageio.v2")
    pytest.importorskip("imageio_ffmpeg")
    env = gym.wrappers.TimeLimit(TargetReachingEnv(), 3)
    film({"USPL": tiny(env)}, env, [0], tmp_path / "film.mp4")
    with imageio.get_reader(tmp_path / "film.mp4") as reader:
        assert reader.count_frames() == round((FIRST_FRAME_TIME + LAST_FRAME_TIME) * FRAMES_PER_SECOND) + 2


def test_mp4_of_an_odd_size_is_a_pixel_larger_and_not_resized(tmp_path, caplog):
    imageio = pytest.importorskip("imageio.v2")
    pytest.importorskip("imageio_ffmpeg")
    stripes = np.zeros((351, 33, 3), np.uint8)
    stripes[100:120] = 255
    _write_mp4([stripes], [1.0], tmp_path / "film.mp4")
    with imageio.get_reader(tmp_path / "film.mp4") as reader:
        shown = reader.get_data(0)
    assert shown.shape == (352, 34, 3) and not caplog.records
    bright = np.flatnonzero(shown[:, 10, 0] > 128)
    assert (bright[0], bright[-1]) == (100, 119)


def test_what_cannot_be_filmed_is_refused(tmp_path, corridor):
    with pytest.raises(ValueError, match="a film is a"):
        film({"USPL": tiny(corridor)}, corridor, [0], tmp_path / "film.png")
    with pytest.raises(ValueError, match="at least one"):
        film({}, corridor, [0], tmp_path / "film.gif")
    with pytest.raises(ValueError, match="no observation encoder"):
        record_clip(PPO("MultiInputPolicy", corridor, device="cpu"), corridor, 0)
