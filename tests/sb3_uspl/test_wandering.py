"""Which components of the action wander: what is refused, and what a saved model remembers."""

import numpy as np
import pytest
from gymnasium import spaces

from sb3_uspl import USPLPPO
from tests.sb3_uspl.toy import make_model


@pytest.mark.parametrize("chosen", [{1: 0.0}, {-1: 0.0}, {0: 1.5}, {0: np.nan}, {}, [0]], ids=str)
def test_wander_actions_that_the_action_space_does_not_hold_are_refused(chosen):
    with pytest.raises(ValueError, match="wander_actions="):
        make_model(wander_share=0.5, wander_actions=chosen)


def test_wander_actions_survive_saving(tmp_path):
    model = make_model(wander_share=0.5, wander_actions={0: 0.5})
    model.save(tmp_path / "model")
    assert USPLPPO.load(tmp_path / "model", env=model.env).wander_actions == {0: 0.5}


def test_wander_actions_of_discrete_actions_are_refused():
    with pytest.raises(ValueError, match="flat Box action space"):
        make_model(wander_share=0.5, wander_actions={0: 0.0}, env_kwargs=dict(action_space=spaces.Discrete(3)))
