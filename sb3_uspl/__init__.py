"""Uncertainty-Sensitive Privileged Learning for Stable-Baselines3: robots that gather information before they act."""

from sb3_uspl import envs as envs  # registers the environments
from sb3_uspl.baselines import RMA, PrivRecons, RESeLPolicy, RESeLPPO, RewReg
from sb3_uspl.hidden import HiddenParameters
from sb3_uspl.observations import HidePrivileged, PrivilegedObservation
from sb3_uspl.policies import CnnPolicy, DeploymentState, MlpPolicy, MultiInputPolicy, USPLPolicy
from sb3_uspl.uspl_ppo import USPLPPO

__version__ = "0.1.0"

__all__ = [
    "RMA",
    "USPLPPO",
    "CnnPolicy",
    "DeploymentState",
    "HiddenParameters",
    "HidePrivileged",
    "MlpPolicy",
    "MultiInputPolicy",
    "PrivRecons",
    "PrivilegedObservation",
    "RESeLPPO",
    "RESeLPolicy",
    "RewReg",
    "USPLPolicy",
]
