"""The observation contract: which part of an observation may be used when.

=============== =============================== ==========================================
key             space                           seen by
=============== =============================== ==========================================
``common``      ``Box (n_common,)``             actor, critic, encoder; also at deployment
``target``      ``Box (n_target,)`` or image    encoder only; also at deployment (optional key)
``privileged``  ``Box (n_privileged,)``         blurred by the actor, exactly by the critic; training only
=============== =============================== ==========================================

While a rollout is collected, :class:`~sb3_uspl.wrappers.UncertaintyVecWrapper` adds the keys ``truth``, ``uncertainty`` and
``belief`` (the encoder's mean); ``privileged`` then is the blurred observation.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.vec_env import VecEnv, VecFrameStack, is_vecenv_wrapped, unwrap_vec_normalize

COMMON, TARGET, PRIVILEGED = "common", "target", "privileged"
TRUTH, UNCERTAINTY, BELIEF = "truth", "uncertainty", "belief"
PREVIOUS_ACTION, EPISODE_STEP = "previous_action", "episode_step"

POLICY_KEYS = (COMMON, PRIVILEGED, TRUTH, UNCERTAINTY, BELIEF)
"""What PPO's networks and rollout buffer hold; the encoder's inputs (``target``, previous actions) never reach them."""


def is_image(space: spaces.Space) -> bool:
    """
    Whether the encoder takes a space for images: uint8 from 0 to 255, or float16 with finite bounds.

    :param space: of the key ``target``
    """
    if not isinstance(space, spaces.Box) or len(space.shape) != 3:
        return False
    return is_image_space(space) or (space.dtype == np.float16 and space.is_bounded() and bool((space.low < space.high).all()))


def stored_space(space: spaces.Space) -> spaces.Box:
    """
    How observations are kept in buffers: images as they are, numbers as float32, also whole ones, of which ``VecNormalize``
    makes fractions without a change of their space.

    :param space: of one key of the contract
    """
    assert isinstance(space, spaces.Box)
    return space if is_image(space) else spaces.Box(-np.inf, np.inf, space.shape, np.float32)


def check_observation_space(space: spaces.Space) -> spaces.Dict:
    """
    Check that a space follows the observation contract.

    :param space: the environment's observation space
    :return: the same space
    :raises ValueError: naming what was given, what is expected and what to do
    """
    advice = (
        "USPL needs a gymnasium.spaces.Dict with the keys 'common' and 'privileged' (and 'target', optional). "
        "Wrap your environment in sb3_uspl.PrivilegedObservation to name which part of its observation is privileged."
    )
    if not isinstance(space, spaces.Dict):
        raise ValueError(f"The observation space is {space}. {advice}")
    keys = set(space.spaces)
    if not {COMMON, PRIVILEGED} <= keys or not keys <= {COMMON, PRIVILEGED, TARGET}:
        raise ValueError(f"The observation space has the keys {sorted(keys)}. {advice}")
    for key, part in space.spaces.items():
        if not isinstance(part, spaces.Box):
            raise ValueError(f"The space of '{key}' is {part}; it must be a Box (nested Dicts: flatten them first).")
        if len(part.shape) != 1 and not (key == TARGET and is_image(part)):
            allowed = "one-dimensional"
            if key == TARGET:
                allowed += (
                    ", or a uint8 image (or a float16 one with finite bounds) of shape (channels, height, width). If "
                    "VecNormalize has made it so, leave the images to the encoder: VecNormalize(..., norm_obs_keys=['common'])"
                )
            raise ValueError(f"The space of '{key}' has the shape {part.shape} and dtype {part.dtype}; it must be {allowed}.")
        if part.shape[0] == 0:
            raise ValueError(f"The space of '{key}' is empty; it must have at least one dimension.")
    return space


def check_vec_wrappers(venv: VecEnv) -> None:
    """
    Refuse ``VecFrameStack``, which would stack the privileged observation, too, and what ``VecNormalize`` must leave as it is:
    the privileged observation, in whose units and bounds blurring, reward transformation and the encoder's uncertainty are,
    and images, which would arrive on another scale than the encoder assumes.

    The space of uint8 images changes when they are normalised, that of float16 images and of ``privileged`` does not.

    :param venv: environments under the observation contract
    :raises ValueError: naming the remedy
    """
    if is_vecenv_wrapped(venv, VecFrameStack):
        raise ValueError(
            "VecFrameStack stacks the privileged observation, too. Leave it out (in a zoo file: frame_stack); the encoder "
            "remembers all observations of the episode."
        )
    normalize = unwrap_vec_normalize(venv)
    space = venv.observation_space
    if normalize is None or not normalize.norm_obs or not isinstance(space, spaces.Dict):
        return
    refused = {PRIVILEGED: "the privileged observation, in whose units and bounds the uncertainty is"}
    if TARGET in space.spaces and is_image(space[TARGET]):
        refused[TARGET] = "images, which the encoder normalises itself"
    for key, reason in refused.items():
        if key in (normalize.norm_obs_keys or ()):
            raise ValueError(
                f"VecNormalize normalises '{key}' (norm_obs_keys={normalize.norm_obs_keys}), {reason}: "
                "use VecNormalize(..., norm_obs_keys=['common'])."
            )


def check_finite(observation: Mapping[str, np.ndarray]) -> None:
    """
    Refuse NaN and infinite observations, which would silently poison the encoder's running statistics.

    :param observation: arrays by key
    :raises ValueError: naming the key and the first bad index
    """
    for key, value in observation.items():
        if value.dtype.kind == "f" and not np.isfinite(value).all():
            index = tuple(int(i) for i in np.argwhere(~np.isfinite(value))[0])
            raise ValueError(
                f"Observation '{key}' holds {value[index]} at index {index}. Every observation must be finite: "
                "check the environment (gymnasium.wrappers or stable_baselines3's VecCheckNan help to find the step)."
            )


def policy_observation_space(space: spaces.Dict) -> spaces.Dict:
    """
    What the actor and the critic see during a rollout.

    :param space: the environment's observation space (the contract)
    :return: space with the keys ``POLICY_KEYS``
    """
    unbounded = stored_space(space[PRIVILEGED])
    return spaces.Dict(
        {
            COMMON: stored_space(space[COMMON]),
            PRIVILEGED: unbounded,
            TRUTH: unbounded,
            UNCERTAINTY: spaces.Box(0.0, 1.0, unbounded.shape, np.float32),
            BELIEF: unbounded,
        }
    )


class PrivilegedObservation(gym.ObservationWrapper):
    """
    Turn an environment of your own into one that follows the observation contract.

    With a flat ``Box`` observation, name the *indices* that are privileged (and those only the encoder may see); the rest is
    common. With a flat ``Dict`` of one-dimensional boxes, name the *keys*; several keys are concatenated in the order given.

    USPL's constants assume that a guess without any information about the privileged values has a standard deviation of
    about 0.2-0.25 (paper, Eq. 2 with ``C_min = log 0.2``): ``scale`` and ``offset`` bring them there,
    ``privileged = (raw - offset) * scale``.

    :param env: environment with a flat ``Box`` or ``Dict`` observation space
    :param privileged: indices or keys of the privileged part
    :param target: indices or keys that only the encoder sees (optional); one key may be an image
    :param scale: factor on the privileged part, a number or one per dimension
    :param offset: subtracted from the privileged part before scaling
    :raises ValueError: if an index or key does not exist, is named twice or nothing is left as common observation, or if there
        are not as many scales or offsets as privileged values
    """

    def __init__(
        self,
        env: gym.Env,
        privileged: Sequence[int] | Sequence[str],
        target: Sequence[int] | Sequence[str] = (),
        scale: float | Sequence[float] = 1.0,
        offset: float | Sequence[float] = 0.0,
    ):
        super().__init__(env)
        for name, names in (("privileged", privileged), ("target", target)):
            if isinstance(names, str) or not np.iterable(names):
                raise ValueError(f"{name}={names!r}: give a list of indices or keys, e.g. [{names!r}].")
        hidden, only_encoder = list[Any](privileged), list[Any](target)
        space = env.observation_space
        if isinstance(space, spaces.Box) and len(space.shape) == 1:
            available: list[Any] = list(range(space.shape[0]))
        elif isinstance(space, spaces.Dict) and all(isinstance(part, spaces.Box) for part in space.values()):
            available = list(space.spaces)
        else:
            raise ValueError(f"PrivilegedObservation takes a one-dimensional Box or a flat Dict of boxes, not {space}.")
        named = [*hidden, *only_encoder]
        unknown = [name for name in named if name not in available]
        if unknown or len(set(named)) != len(named) or not hidden:
            raise ValueError(
                f"privileged={hidden}, target={only_encoder}: name at least one privileged part, and each "
                f"part once, out of {available}."
            )
        common = [name for name in available if name not in named]
        for part in (common, hidden, only_encoder):
            wide = [name for name in part if isinstance(space, spaces.Dict) and len(space[name].shape or ()) != 1]
            if wide and (len(part) > 1 or part is not only_encoder):
                raise ValueError(
                    f"{wide} have another number of axes than one: only an image can be, and only as the one part that the "
                    f"encoder alone sees, target=[{wide[0]!r}]."
                )
        if not common:
            raise ValueError("Every part of the observation is privileged or target; at least one must stay common.")
        self._parts: dict[str, list[Any]] = {COMMON: common, PRIVILEGED: hidden}
        if only_encoder:
            self._parts[TARGET] = only_encoder
        self._scale = np.asarray(scale, dtype=np.float32)
        self._offset = np.asarray(offset, dtype=np.float32)
        n_privileged = len(self._ends(PRIVILEGED)[0])
        for name, values in (("scale", self._scale), ("offset", self._offset)):
            if values.shape not in ((), (n_privileged,)):
                raise ValueError(
                    f"{name}={values.tolist()}: give one number, or one for each of the {n_privileged} privileged ones."
                )
        self.observation_space = spaces.Dict({key: self._part_space(key) for key in self._parts})
        check_observation_space(self.observation_space)

    def observation(self, observation: Any) -> dict[str, np.ndarray]:
        """
        :param observation: the wrapped environment's observation
        :return: observation under the contract
        """
        out = {key: self._select(observation, names) for key, names in self._parts.items()}
        out[PRIVILEGED] = ((out[PRIVILEGED] - self._offset) * self._scale).astype(np.float32)
        return out

    @staticmethod
    def _select(observation: Any, names: list[Any]) -> np.ndarray:
        if isinstance(observation, dict):
            parts = [observation[name] for name in names]
            if len(parts) == 1:
                return np.asarray(parts[0])
            return np.concatenate([np.asarray(part, dtype=np.float32) for part in parts])
        return np.asarray(observation, dtype=np.float32)[names]

    def _ends(self, key: str) -> tuple[np.ndarray, np.ndarray]:
        """Least and greatest values of a part, as they are in the wrapped environment."""
        names, space = self._parts[key], self.env.observation_space
        if isinstance(space, spaces.Dict):
            boxes = [space[name] for name in names]
            low, high = ([getattr(box, end) for box in boxes] for end in ("low", "high"))
            return np.concatenate(low), np.concatenate(high)
        assert isinstance(space, spaces.Box)
        return space.low[names], space.high[names]

    def _part_space(self, key: str) -> spaces.Box:
        names, space = self._parts[key], self.env.observation_space
        if isinstance(space, spaces.Dict) and len(names) == 1 and key != PRIVILEGED:
            box = space[names[0]]
            assert isinstance(box, spaces.Box)
            return box
        low, high = self._ends(key)
        if key == PRIVILEGED:
            ends = np.stack([(low - self._offset) * self._scale, (high - self._offset) * self._scale])
            low, high = ends.min(axis=0), ends.max(axis=0)
        return spaces.Box(low.astype(np.float32), high.astype(np.float32), dtype=np.float32)


class HidePrivileged(gym.ObservationWrapper):
    """
    Leaves out the privileged observation, so that SB3's and sb3-contrib's own algorithms see what is there at deployment.

    :param env: environment under the observation contract
    :raises ValueError: for a space outside the contract
    """

    def __init__(self, env: gym.Env):
        super().__init__(env)
        space = check_observation_space(env.observation_space)
        self.observation_space = spaces.Dict({key: part for key, part in space.spaces.items() if key != PRIVILEGED})

    def observation(self, observation: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """
        :param observation: under the contract
        :return: the same without ``privileged``
        """
        return {key: part for key, part in observation.items() if key != PRIVILEGED}
