"""``python -m sb3_uspl.enjoy``: the zoo's viewer with our algorithms; ``--film`` and ``--replay`` write what it would show."""

from sb3_uspl import _episode
from sb3_uspl._zoo import check_command_line, register, use_default_folder


def watch() -> None:
    """Open the zoo's viewer, and end with a message where it cannot be opened."""
    from rl_zoo3.enjoy import enjoy

    try:
        enjoy()
    except (RuntimeError, ValueError) as error:
        if "render_mode" not in str(error):
            raise
        raise SystemExit(
            f"{error}\nWithout a window: --no-render counts successes; --film FILE.mp4 and --replay FILE.html show episodes."
        ) from error


if __name__ == "__main__":
    register()
    check_command_line()
    if not _episode.run("enjoy"):
        use_default_folder()
        watch()
