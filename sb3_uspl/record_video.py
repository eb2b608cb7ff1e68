"""``python -m sb3_uspl.record_video``: the zoo's recorder with our algorithms, environments and shipped agents."""

import runpy

from sb3_uspl._zoo import check_command_line, register, use_default_folder

if __name__ == "__main__":
    register()
    check_command_line()
    use_default_folder()
    # The zoo's recorder is a script without a function to call.
    runpy.run_module("rl_zoo3.record_video", run_name="__main__", alter_sys=True)
