"""``python -m sb3_uspl.enjoy``: the zoo's viewer with our algorithms; ``--film`` and ``--replay`` write what it would show."""

from gymnasium.error import DependencyNotInstalled

from sb3_uspl import _episode
from sb3_uspl._agents import check_agent
from sb3_uspl._zoo import check_command_line, register, use_default_folder


def watch() -> None:
    """Open the zoo's viewer, and end with a message where it cannot be opened."""
    from rl_zoo3.enjoy import enjoy

    try:
        enjoy()
    except (DependencyNotInstalled, RuntimeError, ValueError) as error:
        # pygame, which Gymnasium takes for environments without a window of their own, speaks of its "video device".
        if not isinstance(error, DependencyNotInstalled) and not any(word in str(error) for word in ("render_mode", "video")):
            raise
        raise SystemExit(
            f"{error}\nWithout a window: --no-render counts successes; --film FILE.mp4 and --replay FILE.html show episodes."
        ) from error


if __name__ == "__main__":
    register()
    check_command_line()
    if not _episode.run("enjoy"):
        use_default_folder()
        check_agent()
        watch()
