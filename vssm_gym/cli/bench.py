"""Run ``vssm-gym bench``: measure speed and tracking accuracy on this machine."""

from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from vssm_gym.cli.shared.console import literal_console, say
from vssm_gym.cli.shared.interruption import interruptible
from vssm_gym.cli.shared.predictions import check_log, show_prediction

Suite = Literal[
    "speed", "envs", "rl", "soak", "car", "information", "prediction", "beliefs", "tracker", "drift", "slam"
]
DEFAULT_TRIALS = {"tracker": 300, "drift": 4, "slam": 1, "car": 300, "information": 40, "prediction": 8, "beliefs": 240}
DEFAULT_TRIALS |= {"soak": 100_000, "rl": 1_000_000}  # steps
FEWEST_CANDIDATES = 5  # of which a rank correlation means something
DEFAULT_SCENE = {"car": "arena"}  # the others: oak


@interruptible("maps/*.npz")
def bench(
    suite: Annotated[Suite, tyro.conf.Positional] = "speed",
    sequence: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="LOG")] = None,
    scene: str | None = None,
    out: Path = Path("out/bench"),
    trials: Annotated[int | None, tyro.conf.arg(aliases=("--runs",))] = None,
    split: Literal["train", "test"] = "train",
    workers: int = 2,
    seed: int = 0,
    transition: Path | None = None,
    map: Path | None = None,
    fit: tuple[Path, ...] = (),
) -> None:
    """Measure speed and accuracy on this machine, one suite at a time.

    `speed` measures the median time of each stage: image, tracker, map update, environment, planner, control loop.
    `envs` measures steps per second of the environments, one and many at once, and of MiniWorld where it is installed.
    `rl` measures robot steps per second in a learned map and in the simulator, memory over a million steps, and the
    distance between imagined and simulated robots under the same commands. `soak` drives at random through every
    environment and ten procedural apartments and checks every step: no NaN, no body inside a wall, constant memory.
    `car` measures value iteration, each controller in closed loop, hybrid A* and both simulators of the robot car.
    `information` measures an explorer's imagined step and its ranking of candidates against all pixels and against the
    true images. `prediction` scores images and poses 1 s and 3 s ahead, of the world model and of baselines, in learned
    maps of a split's apartments; `prediction LOG --transition FILE.npz` predicts a recorded motion 10, 30 and 100 steps
    ahead by a learned transition and by plain integration, and with `--map` its images too. `beliefs` judges three
    Gaussians of a pose by the true one, on single images in the map of `oak` that comes with the package: Laplace's,
    the variational one and the filter's. `tracker` drives 100 steps at a time along the true pose and prints the
    tracker's location RMSE. `drift` chains goals over 100 m and compares the map tracker, frame-to-frame alignment and
    dead reckoning on the same images. `slam` runs LOG at 160x120 and 320x240 and compares time and error with Open3D's
    dense SLAM, where it is installed.

    Args:
        suite: the suite to run.
        sequence: TUM folder, for `slam`; for `prediction`, a log that `train-dynamics` reads.
        scene: built-in name or path of a scene file; by default `oak`, for `car` `arena`.
        out: folder for the learned map, which is kept, and for the results as JSON; it may hold other suites' results.
        trials: number of drives (`tracker` 300, `prediction` 8, `drift` 4), runs (`slam` 1), steps (`soak` 100000, `rl`
            1000000), steps of each controller (`car` 300), candidates (`information` 40) or images (`beliefs` 240).
        split: scenes and seeds of `prediction`: to tune on (train) or to judge on (test).
        workers: number of processes of `tracker` and `drift`.
        seed: seed of the drives.
        transition: learned transition (.npz) of `train-dynamics`, for `prediction LOG`.
        map: map (.npz) of `map build` in the world frame of LOG, for `prediction LOG`.
        fit: logs that the noise of plain integration is fitted to, for `prediction LOG`: those that the transition was
            learned from. Without them it is fitted to the first third of LOG, and the rest is judged.
    """
    import json

    from vssm_gym.cli.shared.progress import progress_bars
    from vssm_gym.data.sequences import load_sequence
    from vssm_gym.errors import InputError
    from vssm_gym.eval.sweep.config import DEFAULT_VOXEL
    from vssm_gym.files.atomic import atomic_write
    from vssm_gym.files.output_folders import Owner, check_at_least, check_folder, check_new_file, owned_folder
    from vssm_gym.maps.map_file import map_hash
    from vssm_gym.slam.map_building import ensure_map
    from vssm_gym.version import package_version

    count = DEFAULT_TRIALS.get(suite, 1) if trials is None else trials
    scene = DEFAULT_SCENE.get(suite, "oak") if scene is None else scene
    for field, value, least in (("trials", count, 1), ("workers", workers, 1), ("seed", seed, 0)):
        check_at_least("bench", field, value, least)
    check_folder(out)
    ahead = suite == "prediction" and sequence is not None
    check_log(suite, sequence, {"transition": transition, "map": map, "fit": fit or None})
    recording = load_sequence(sequence) if sequence is not None and suite == "slam" else None
    if suite == "beliefs" and scene != "oak":
        raise InputError("bench", "scene", f"oak, whose map comes with the package, for this suite; found {scene!r}")
    measured = "all" if suite == "soak" else Path(scene if sequence is None else sequence.resolve()).stem
    measured = split if suite == "prediction" and not ahead else measured
    path = out / f"{suite}-{measured}.json"
    owner = Owner("bench", "bench.json", {"version": package_version()}, identity=())
    with owned_folder(out, owner):
        for suffix in (".json", ".svg", ".html") if suite == "prediction" else (".json",):
            check_new_file(path.with_suffix(suffix))
        with progress_bars() as progress:
            if recording is not None:
                from vssm_gym.eval.bench.slam import compare

                result = compare(recording, trials=count, on_progress=progress)
            elif suite == "envs":
                from vssm_gym.eval.bench.envs import measure

                result = measure(scene=scene, seed=seed, on_progress=progress)
            elif suite == "soak":
                from vssm_gym.eval.bench.soak import soak

                result = soak(steps=count, seed=seed, on_progress=progress)
            elif suite == "car":
                from vssm_gym.eval.bench.car import measure as measure_car

                result = measure_car(scene=scene, steps=count, seed=seed, on_progress=progress)
            elif suite == "information":
                from vssm_gym.eval.bench.information import measure as measure_information

                check_at_least("bench", "trials", count, FEWEST_CANDIDATES)
                result = measure_information(scene=scene, candidates=count, seed=seed, on_progress=progress)
            elif ahead:
                from vssm_gym.eval.bench.prediction.ahead.measure import measure_ahead

                assert sequence is not None
                assert transition is not None
                predicted = measure_ahead(sequence, transition, map_file=map, fit=fit, seed=seed, on_progress=progress)
                result = predicted.result
            elif suite == "prediction":
                from vssm_gym.eval.bench.prediction.measure import measure as measure_prediction

                result = measure_prediction(split=split, runs=count, seed=seed, folder=out, on_progress=progress)
            elif suite == "beliefs":
                from vssm_gym.eval.bench.pose_beliefs import compare as compare_beliefs

                result = compare_beliefs(count, seed, on_progress=progress)
            else:
                map_file = ensure_map(scene, out, voxel=DEFAULT_VOXEL, seed=seed, on_progress=progress)
                result = _on_a_map(suite, scene, map_file, count, workers, seed, progress)
                result["map_hash"] = map_hash(map_file)
        _show(suite, result, literal_console())  # before it is written: a full disk costs the file alone
        with atomic_write(path) as temporary:
            temporary.write_text(json.dumps(result | {"version": package_version(), "seed": seed}, indent=1) + "\n")
        if ahead:
            from vssm_gym.eval.bench.prediction.ahead.page import write_ahead

            say(write_ahead(predicted, path, package_version()))
        elif suite == "prediction":
            from vssm_gym.eval.bench.prediction.page import write_page

            say(write_page(result, path, package_version()))
    say(path)


def _on_a_map(
    suite: str, scene: str, map_file: Path, trials: int, workers: int, seed: int, progress: Any
) -> dict[str, Any]:
    if suite == "speed":
        from vssm_gym.eval.bench.speed import speed

        return speed(scene, map_file, seed=seed, on_progress=progress)
    if suite == "rl":
        from vssm_gym.eval.bench.rl import measure

        return measure(scene, map_file, steps=trials, seed=seed, on_progress=progress)
    from vssm_gym.eval.bench import tracking as bench_tracking

    run = bench_tracking.tracker_trials if suite == "tracker" else bench_tracking.drift_trials
    return run(scene, map_file, trials=trials, workers=workers, seed=seed, on_progress=progress)


def _show(suite: str, result: dict[str, Any], console: Any) -> None:
    from rich.table import Table

    if suite == "prediction":
        show_prediction(
            Table(title=f"bench prediction: {result.get('log') or result['setting']['split']}"), result, console
        )
        return
    table = Table(title=f"bench {suite}: {result['scene']}")
    if suite == "speed":
        for name in ("stage", "median", "unit", "target"):
            table.add_column(name, justify="left" if name in ("stage", "unit") else "right")
        for stage, value, unit, aim in result["rows"]:
            table.add_row(stage, f"{value:.1f}", unit, "" if aim is None else f"{aim:.0f}")
        console.print(table)
        console.print(f"pixels where search and march differ: {result['pixels_where_search_and_march_differ']:.2e}")
        console.print(f"recompilations after the first step: {result['recompilations_after_the_first_step']}")
        console.print(f"machine: {result['machine']}")
        return
    if suite == "slam":
        _show_slam(table, result, console)
        return
    if suite == "envs":
        _show_envs(table, result, console)
        return
    if suite == "rl":
        _show_rl(table, result, console)
        return
    if suite == "car":
        _show_car(table, result, console)
        return
    if suite == "information":
        _show_information(table, result, console)
        return
    if suite == "beliefs":
        _show_beliefs(table, result, console)
        return
    if suite == "soak":
        for name in ("environment", "scene", "steps", "episodes", "collisions", "deepest, mm"):
            table.add_column(name, justify="left" if name in ("environment", "scene") else "right", no_wrap=True)
        for row in result["rows"]:
            table.add_row(*(f"{v:.2f}" if isinstance(v, float) else str(v) for v in row))
        console.print(table)
        early, late = result["memory_mb"]
        console.print(f"memory: {early:.0f} MB after the first tenth, {late:.0f} at the end")
        return
    if suite == "tracker":
        table.add_column("location RMSE over 100 steps")
        table.add_column("value", justify="right")
        table.add_row(f"below 0.1 m, of {result['trials']}", f"{100 * result['share_below_0.1m']:.1f} %")
        for q, value in result["rmse_m"].items():
            table.add_row(f"{100 * float(q):.0f} % of trials are below", f"{100 * value:.2f} cm")
        table.add_row("steps reported lost", f"{100 * result['lost_steps']:.2f} %")
        for name, method in result["methods"].items():
            value = f"{100 * method['rmse_m_median']:.2f} cm, {method['ms_a_step']:.1f} ms"
            table.add_row(f"{name}: RMSE median of {method['drives']} drives", value)
    else:
        methods = result["methods"]
        table.add_column("mean location error, m")
        for name in methods:
            table.add_column(name, justify="right")
        for i in range(10):
            values = (f"{method['mean_error_by_tenth_m'][i]:.3f}" for method in methods.values())
            table.add_row(f"{10 * i} to {10 * (i + 1)} m of path", *values)
        table.add_row("RMSE of the drive", *(f"{method['rmse_m']:.3f}" for method in methods.values()))
        table.caption = f"astar / no_map, each drive: {result['astar_over_no_map']}"
    console.print(table)


def _show_envs(table: Any, result: dict[str, Any], console: Any) -> None:
    """Fill the table with one row for each environment: steps per second, cores, target."""
    table.title += f", {result['shapes']} shapes"
    for name in ("environment", "steps/s", "cores", "target"):
        table.add_column(name, justify="left" if name == "environment" else "right", no_wrap=True)
    for what, rate, cores, aim in result["rows"]:
        table.add_row(what, f"{rate:,.0f}", str(cores), "" if aim is None else f"{aim:,.0f}")
    console.print(table)
    if result["peer"]:
        console.print(f"not compared: {result['peer']}", soft_wrap=True)


def _show_rl(table: Any, result: dict[str, Any], console: Any) -> None:
    """Fill the table with one row for each number of robots; print memory, compilations and the replay below."""
    for name in ("robots", "at once", "steps/s", "target"):
        table.add_column(name, justify="left" if name == "robots" else "right", no_wrap=True)
    for what, robots, rate, aim in result["rows"]:
        table.add_row(what, str(robots), f"{rate:,.0f}", "" if aim is None else f"{aim:,.0f}")
    console.print(table)
    for what, ratio, aim in result["ratios"]:
        console.print(f"{what}: {ratio:,.1f}" + ("" if aim is None else f" (target {aim:g})"))
    early, late = result["memory_mb"]
    console.print(f"memory over {result['steps']:,} steps: {early:.0f} MB after the first tenth, {late:.0f} at the end")
    console.print(f"recompilations: {result['recompilations']}")
    replayed = result["replay"]
    console.print(
        f"{replayed['rollouts']} rollouts of {replayed['seconds']:g} s, {replayed['collisions']} with a collision:"
    )
    for name in ("all", "free", "collided"):
        if name in replayed:
            position, scan = (replayed[name][key] for key in ("position_m", "scan_m"))
            off = ", ".join(f"{100 * e['p50']:.1f} cm ({100 * e['p90']:.1f})" for e in (position, scan))
            rewards = replayed[name]["return"]
            more = f"return by {rewards['p50']:.2f} ({rewards['p90']:.2f})"
            console.print(f"  {name}: position, scans off by {off}, {more}: median (90 %)")
    console.print(f"machine: {result['machine']}")


def _show_car(table: Any, result: dict[str, Any], console: Any) -> None:
    """Fill the table with one row for each part: median, 95th percentile, target, other counts."""
    for name in ("part", "median", "95 %", "unit", "target", "other counts"):
        table.add_column(name, justify="left" if name in ("part", "unit", "other counts") else "right")
    for row in result["rows"]:
        values = ("" if v is None else _written(v) for v in (row["p50"], row["p95"]))
        beside = ", ".join(f"{name} {_written(v)}" for name, v in row["facts"].items())
        table.add_row(row["what"], *values, row["unit"], "" if row["aim"] is None else f"{row['aim']:g}", beside)
    console.print(table)
    console.print(f"machine: {result['machine']}")
    if result["missing"]:
        console.print(f"not measured: {result['missing']}", soft_wrap=True)


def _show_information(table: Any, result: dict[str, Any], console: Any) -> None:
    """Fill the table with one row for each map and estimate: ms per step, Spearman's rank correlations, ratio."""
    names = ("map", "estimate", "ms", "rank, all", "rank, true", "ratio")
    for name in names:
        table.add_column(name, justify="left" if name == "estimate" else "right")
    for row in result["rows"]:
        figures = (
            f"{row[name]:.{digits}f}" for name, digits in (("ms", 2), ("rank", 3), ("rank_true", 3), ("ratio", 2))
        )
        table.add_row(str(row["map"]), row["what"], *figures)
    ms, rank = result["aims"]
    table.caption = (
        f"default: at most {ms:g} ms and at least {rank:g} with all pixels; {result['candidates']} candidates"
    )
    console.print(table)
    console.print(
        "map: images in it. rank: against all pixels and cells, and against the true images. ratio: to the latter"
    )
    console.print(f"recompilations for other candidates: {result['recompilations']}")
    console.print(f"machine: {result['machine']}")


def _show_beliefs(table: Any, result: dict[str, Any], console: Any) -> None:
    """Fill the table with one row for each Gaussian: means with standard errors, median, share."""
    for name in ("Gaussian", "NEES / dim", "median", "inside 95 %", "-log q(true pose), nats"):
        table.add_column(name, justify="left" if name == "Gaussian" else "right")
    for name, of in result["beliefs"].items():
        nees, surprise = (f"{of[key]:.2f} +- {of[f'{key}_error']:.2f}" for key in ("nees", "surprise"))
        table.add_row(name, nees, f"{of['median_nees']:.2f}", f"{of['inside']:.0%}", surprise)
    table.caption = f"{result['frames']} images"
    console.print(table)


def _written(value: float | int | str) -> str:
    """Return integers and words unchanged, and other numbers with three digits."""
    if not isinstance(value, float):
        return str(value)
    return f"{value:,.0f}" if value >= 100.0 else f"{value:.3g}"


def _show_slam(table: Any, result: dict[str, Any], console: Any) -> None:
    """Fill the table with one row for each stage: median, 95th percentile; the run's error stands at its step."""
    for name in ("method, image, voxel", "stage", "ms", "95 %", "ATE cm", "max cm", "> 5 cm"):
        table.add_column(name, justify="left" if name in ("method, image, voxel", "stage") else "right", no_wrap=True)
    for row in result["rows"]:
        what = f"{row['method']} {'x'.join(map(str, row['size']))} {100 * row['voxel']:g} cm"
        off = ["-"] * 3
        if row["ate_m"] is not None:
            off = [f"{100 * row['ate_m']:.2f}", f"{100 * row['ate_max_m']:.1f}", str(row["astray"])]
        for stage, times in row["stages_ms"].items():
            first = stage == "step"
            ms = [f"{times['p50']:.1f}", f"{times['p95']:.1f}"]
            table.add_row(what if first else "", stage, *ms, *(off if first else [""] * 3))
    table.caption = (
        "median and 95th percentile over the frames in which a stage ran; ATE, largest error, frames beyond 5 cm "
        "after SE(3) alignment"
    )
    console.print(table)
    for notice in result["notices"]:
        say(f"warning: {notice}", error=True)
    if result["missing"]:
        console.print(f"not compared: {result['missing']}", soft_wrap=True)
