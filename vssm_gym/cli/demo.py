"""Run ``vssm-gym demo``: map an apartment, run five agents in it, write the report."""

from pathlib import Path


def demo(out: Path = Path("out/demo"), resume: bool = False, workers: int = 2, seed: int = 0) -> None:
    """Record a drive through `oak`, learn its map, run five agents on 10 tasks, and write a report.

    It takes a few minutes on two cores. The last line printed is the path of the report.

    Args:
        out: folder of the demo; an earlier demo there is replaced.
        resume: continue an interrupted demo instead.
        workers: number of processes that run episodes.
        seed: seed of the recorded drive from which the map is learned.
    """
    from vssm_gym import eval as evaluation
    from vssm_gym.cli.shared.console import print_results, progress_bars
    from vssm_gym.eval.report.page import write_report
    from vssm_gym.eval.sweep.config import load_config
    from vssm_gym.eval.sweep.runner import check_arguments, run_sweep

    config = load_config(Path(evaluation.__file__).parent / "configs" / "demo.yaml")
    if not resume:
        check_arguments(out, workers, seed)
        _clear(out)
    with progress_bars() as progress:
        log = run_sweep(config, out, resume=resume, workers=workers, seed=seed, on_progress=progress)
    print_results(log)
    print(write_report(out))


def _clear(out: Path) -> None:
    """Remove the files of an earlier demo and nothing else; refuse a folder with other content.

    ``sweep.json`` stays until the sweep replaces it: it marks the folder as a sweep's.
    """
    import shutil

    from vssm_gym.errors import InputError

    if not out.exists():
        return
    ours = {"episodes.jsonl", "report.html", "tasks", "recordings", "maps"}
    if not out.is_dir() or (any(out.iterdir()) and not (out / "sweep.json").is_file()):
        raise InputError(out, "folder", "a new or empty folder, or that of an earlier demo")
    for path in out.iterdir():
        if path.name in ours:
            shutil.rmtree(path) if path.is_dir() else path.unlink()
