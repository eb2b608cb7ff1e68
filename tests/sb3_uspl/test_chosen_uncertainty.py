"""A chosen uncertainty holds from its time on, reaches the policy and nothing else."""

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("matplotlib")

from sb3_uspl import USPLPPO
from sb3_uspl.chosen_uncertainty import ChosenUncertainty, read_uncertainty
from sb3_uspl.film import film, record_clip
from tests.sb3_uspl.toy import IMAGE, ToyEnv


def tiny(env):
    return USPLPPO("MlpPolicy", env, n_steps=64, batch_size=64, mismatch_fraction=0.0, seed=0, device="cpu")


def test_a_number_holds_for_ever():
    chosen = read_uncertainty("0.3")
    assert [chosen.at(decision, 0.2) for decision in (0, 1, 10_000)] == [0.3, 0.3, 0.3]


def test_rows_hold_from_their_time_to_the_next(tmp_path):
    (tmp_path / "a.csv").write_text("seconds,sigma\n0.2,0.3\n0.3,\n0.6,0.01\n")
    chosen = read_uncertainty(str(tmp_path / "a.csv"))
    assert [chosen.at(decision, 0.1) for decision in range(8)] == [None, None, 0.3, None, None, None, 0.01, 0.01]
    (tmp_path / "b.csv").write_text("sigma, decisions\n0.25, 0\n0, 2\n")
    chosen = read_uncertainty(str(tmp_path / "b.csv"))
    assert [chosen.at(decision, 0.1) for decision in range(4)] == [0.25, 0.25, 0.0, 0.0]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("decisions,std\n0,1\n", "has the columns"),
        ("seconds,decisions,sigma\n0,0,1\n", "has the columns"),
        ("seconds,sigma\n", "one of each or more"),
        ("seconds,sigma\n2,0.1\n1,0.2\n", "ascending"),
        ("seconds,sigma\n-1,0.1\n", "ascending"),
        ("seconds,sigma\n0,-0.1\n", "standard deviations"),
        ("seconds,sigma\n0,high\n", "could not convert"),
        ("seconds,sigma\n0\n1,0.2\n2,nan\n", "standard deviations"),
    ],
)
def test_a_file_that_makes_no_sense_is_refused(text, message, tmp_path):
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(ValueError, match=message):
        read_uncertainty(str(tmp_path / "a.csv"))


def test_what_is_neither_number_nor_file_is_refused(tmp_path):
    with pytest.raises(ValueError, match="expected a number"):
        read_uncertainty("much")
    with pytest.raises(ValueError, match="expected a number"):
        read_uncertainty("-0.1")
    with pytest.raises(ValueError, match="no such file"):
        read_uncertainty(str(tmp_path / "a.csv"))


def test_the_policy_sees_the_chosen_uncertainty_and_the_belief_stays_the_encoders(monkeypatch):
    env = ToyEnv(n_privileged=3)
    model = tiny(env)
    seen = []
    original = type(model.policy).get_distribution

    def spy(policy, obs):
        seen.append((obs["uncertainty"].numpy().copy(), obs["privileged"].numpy().copy()))
        return original(policy, obs)

    monkeypatch.setattr(type(model.policy), "get_distribution", spy)
    clip = record_clip(model, env, 0, ChosenUncertainty((2.0,), (0.07,)), "privileged")
    assert len(seen) == len(clip.stds) == 9
    for decision, (uncertainty, privileged) in enumerate(seen):
        expected = clip.stds[decision] if decision < 2 else np.full(3, 0.07)
        np.testing.assert_allclose(uncertainty[0], expected, rtol=1e-6)
        np.testing.assert_allclose(privileged[0], clip.truth)
    assert not np.allclose(clip.stds[4], 0.07), "or the test says nothing"
    assert clip.chosen[:2] == [None, None] and clip.chosen[2] == pytest.approx(0.07 * 3**0.5)


def test_an_environment_without_a_map_and_with_a_camera_is_filmed(tmp_path):
    env = ToyEnv(length=3, target=IMAGE, n_privileged=3)
    (clip,) = film({"USPL": tiny(env)}, env, [0], tmp_path / "sub" / "film.gif", ChosenUncertainty((0.0,), (0.2,)))
    assert clip.goal is None and len(clip.views) == len(clip.means) == 4
    assert [int(view[0, 0]) for view in clip.views] == [100, 101, 102, 103]
    assert (tmp_path / "sub" / "film.gif").stat().st_size > 5000


def test_an_unknown_policy_is_refused():
    env = gym.make("TargetReaching-v0")
    with pytest.raises(ValueError, match="choose 'deployment' or 'privileged'"):
        record_clip(tiny(env), env, 0, policy="best")
