"""``python -m sb3_uspl.record_video``: the zoo's recorder; with ``--film`` a film of what the robot does and believes."""

import runpy
import warnings

from sb3_uspl import _episode
from sb3_uspl._agents import check_agent
from sb3_uspl._zoo import check_command_line, drop_packages, register, use_default_folder

if __name__ == "__main__":
    register()
    check_command_line()
    if not _episode.run("record_video"):
        use_default_folder()
        # The zoo loads the model with its one environment, as if to train it.
        warnings.filterwarnings("ignore", message=".*too few to give some a mismatched privileged observation")
        check_agent()
        drop_packages()
        # The zoo's recorder is a script without a function to call.
        runpy.run_module("rl_zoo3.record_video", run_name="__main__", alter_sys=True)
