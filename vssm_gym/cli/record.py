"""``vssm-gym record --scene S --out DIR``: drive through a scene and record a TUM folder (DESIGN)."""

from pathlib import Path


def record(scene: str, out: Path, noise: str = "low", seed: int = 0) -> None:
    """Drive a survey of a scene and record colour, depth, commands and true poses as a TUM folder.

    Args:
        scene: built-in name (oak) or path of a scene file.
        out: new or empty folder; it appears when the recording is complete.
        noise: execution noise of the drive: none, low, mid or high; the recorded poses are the true ones.
        seed: of the route and of the noise.
    """
    from vssm_gym.cli.console import print_notices, progress_bars
    from vssm_gym.data import recording
    from vssm_gym.eval.destinations import check_at_least, check_folder

    check_at_least("record", "seed", seed, 0)
    check_folder(out)
    print_notices([scene])
    with progress_bars() as progress:
        frames = recording.record(scene, out, noise=noise, seed=seed, progress=progress)
    print(f"{frames} frames: {out}\nnext: vssm-gym map build {out} --out map.npz")
