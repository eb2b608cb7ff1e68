"""``python -m sb3_uspl.train``: the zoo's trainer with our algorithms, environments and ``zoo_configs/``."""

from sb3_uspl._zoo import check_command_line, register, rl_zoo3, use_default_config

if __name__ == "__main__":
    register()
    check_command_line()
    use_default_config()
    rl_zoo3.train.train()
