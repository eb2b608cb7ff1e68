"""A shipped agent, trained without legs, is trained on with them."""

import csv

import pytest
import yaml

from sb3_uspl import USPLPPO
from sb3_uspl._zoo import TRAINED_AGENTS
from tests.sb3_uspl.commands import run

ENV = "LateralChoice-v0"
SHIPPED = TRAINED_AGENTS / "uspl_ppo" / f"{ENV}_1" / f"{ENV}.zip"
SMALL = ("n_envs:8", "n_steps:8", "batch_size:32", "encoder_updates:1")


@pytest.mark.skipif(not SHIPPED.is_file(), reason="the agent is not shipped with this copy")
def test_a_shipped_agent_is_trained_on_in_full_physics(tmp_path):
    before = USPLPPO.load(SHIPPED, device="cpu")
    result = run(
        *("sb3_uspl.train", "--algo", "uspl_ppo", "--env", ENV, "-f", str(tmp_path), "-n", "128", "--seed", "1"),
        *("-i", str(SHIPPED), "--env-kwargs", "physics:'full'", "--eval-freq", "-1", "-params", *SMALL),
    )
    assert result.returncode == 0, result.stdout + result.stderr
    folder = tmp_path / "uspl_ppo" / f"{ENV}_1"
    config = dict(yaml.load((folder / ENV / "config.yml").read_text(), Loader=yaml.UnsafeLoader))  # the zoo's own file
    assert config["env_kwargs"] == {"physics": "full"}
    after = USPLPPO.load(folder / f"{ENV}.zip", device="cpu")
    assert after.num_timesteps >= before.num_timesteps + 128, "it goes on counting, so that no warm-up begins anew"
    changed = [not (old == new).all() for old, new in zip(before.policy.parameters(), after.policy.parameters(), strict=True)]
    assert any(changed)
    with open(folder / "progress.csv") as file:
        steps = [int(row["time/total_timesteps"]) for row in csv.DictReader(file) if row["time/total_timesteps"]]
    assert steps[0] > before.num_timesteps
