"""Run ``vssm-gym study NAME``: beliefs of a pose that is lost, or has several modes."""

from pathlib import Path

from vssm_gym.cli.shared.console import say
from vssm_gym.cli.shared.interruption import interruptible
from vssm_gym.cli.shared.lists import aligned, names_in


@interruptible()
def relocalisation(
    out: Path,
    scenes: str = "fern,ivy,moss,reed",
    sensor_noise: str = "none,kinect",
    poses: int = 100,
    maps: Path | None = None,
    seed: int = 0,
) -> None:
    """Look for a robot at random poses of several scenes, in their learned maps, without any prior.

    OUT gets relocalisation.json, relocalisation.svg and relocalisation.html: shares of the images that are found,
    ambiguous, or accepted at a wrong place, with errors and times; and the maps, which are kept and used again.

    Args:
        out: folder for the results.
        scenes: built-in names or paths, separated by commas.
        sensor_noise: noises of the camera: none, kinect or stereo, separated by commas.
        poses: images of each scene with each noise.
        maps: folder of the learned maps, such as a sweep's; OUT by default.
        seed: of poses, noise and the drives that the maps are learned from.
    """
    from vssm_gym.cli.shared.progress import progress_bars
    from vssm_gym.eval.studies import relocalisation as study_relocalisation
    from vssm_gym.eval.studies.page import study_folder, write_study
    from vssm_gym.files.output_folders import check_at_least, check_folder

    check_at_least("study", "poses", poses, 1)
    check_folder(out)
    with study_folder("relocalisation", out):
        with progress_bars() as progress:
            study = study_relocalisation.run(
                names_in(scenes),
                maps or out,
                sensors=names_in(sensor_noise),
                poses=poses,
                seed=seed,
                on_progress=progress,
            )
        say(study.answer)
        say(write_study(study, out))


@interruptible()
def pose_flow(out: Path, seed: int = 0) -> None:
    """Fit Gaussians and a normalising flow to the pose of a camera that sees a ball and cannot tell from which side.

    OUT gets pose-flow.json, pose-flow.svg and pose-flow.html: the evidence lower bound of each family, and how much of
    the sphere of poses it covers.

    Args:
        out: folder for the results.
        seed: of the image's noise and of the fits.
    """
    from vssm_gym.cli.shared.progress import progress_bars
    from vssm_gym.eval.studies.page import study_folder, write_study
    from vssm_gym.eval.studies.pose_flow import study as study_pose_flow
    from vssm_gym.files.output_folders import check_at_least, check_folder

    check_at_least("study", "seed", seed, 0)
    check_folder(out)
    with study_folder("pose-flow", out):
        with progress_bars() as progress:
            study = study_pose_flow.run(seed, on_progress=progress)
        for line in aligned([study.header, *study.lines]):
            say(line)
        say(study.answer)
        say(write_study(study, out))


@interruptible()
def pose_ambiguity(
    out: Path, maze: str = "serpentine-v1", scans: int = 120, particles: int = 20_000, seed: int = 0
) -> None:
    """Localise a robot in a known maze from nowhere, and count the places where it could be after each scan.

    OUT gets pose-ambiguity.json, pose-ambiguity.svg and pose-ambiguity.html: the particles in the map at several times,
    number of places, entropy, and mass at the true pose (DVBF-LM, fig. 1).

    Args:
        out: folder for the results.
        maze: name of a maze.
        scans: of the drive.
        particles: of the filter.
        seed: of the drives and of the filter.
    """
    from vssm_gym.cli.shared.progress import progress_bars
    from vssm_gym.eval.studies.page import study_folder, write_study
    from vssm_gym.eval.studies.pose_ambiguity import study as study_pose_ambiguity
    from vssm_gym.files.output_folders import check_at_least, check_folder

    check_at_least("study", "seed", seed, 0)
    check_at_least("study", "scans", scans, 2)
    check_at_least("study", "particles", particles, 10)
    check_folder(out)
    with study_folder("pose-ambiguity", out):
        with progress_bars() as progress:
            study = study_pose_ambiguity.run(maze, scans, particles, seed, on_progress=progress)
        for line in aligned([study.header, *study.lines]):
            say(line)
        say(study.answer)
        say(write_study(study, out))
