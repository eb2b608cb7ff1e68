"""The methods that USPL is compared with, as thin variations of the same parts."""

from sb3_uspl.baselines.privrecons import PrivRecons
from sb3_uspl.baselines.resel_policy import RESeLPolicy
from sb3_uspl.baselines.resel_ppo import RESeLPPO
from sb3_uspl.baselines.rewreg import RewReg
from sb3_uspl.baselines.rma import RMA

__all__ = ["RMA", "PrivRecons", "RESeLPPO", "RESeLPolicy", "RewReg"]
