"""``python -m sb3_uspl.enjoy``: the zoo's viewer with our algorithms and environments."""

from sb3_uspl._zoo import register

if __name__ == "__main__":
    register()
    from rl_zoo3.enjoy import enjoy

    enjoy()
