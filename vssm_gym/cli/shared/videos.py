"""Say once, before a run, that it will have no video."""

from vssm_gym.cli.shared.console import say


def can_write_videos(command: str) -> bool:
    """Return whether videos can be written here; where they cannot, say how to install what writes them."""
    from vssm_gym.errors import InputError
    from vssm_gym.eval.video.writer import check_writer

    try:
        check_writer(command)
    except InputError as error:
        say(f"no video of the run: {error}", error=True)
        return False
    return True
