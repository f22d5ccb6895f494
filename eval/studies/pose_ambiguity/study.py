"""Localise a robot in a known map without any prior, and show how many places it could be at (DVBF-LM, fig. 1).

    q(z_1) = uniform over the free space of the map and all headings
    q(z_t) ~ p(x_t | z_t, M) int p(z_t | z_t-1, u_t-1) q(z_t-1) dz_t-1        by particles (eq. I70)

The map is that of SLAM on another traversal of the maze. What the filter reads are scans and commands.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from vssm_gym.data.laser_logs import LaserLog
from vssm_gym.data.traversals import traverse
from vssm_gym.envs.tasks.mazes import load_maze
from vssm_gym.errors import InputError
from vssm_gym.eval.studies.page import Study, labelled
from vssm_gym.eval.studies.pose_ambiguity.modes import AT_HEADING, AT_POSE, LEAST_OF_MODE, MASS_HELD, Spread, spread
from vssm_gym.eval.studies.pose_ambiguity.picture import Moment, draw
from vssm_gym.geometry.planar_poses import relation
from vssm_gym.inference.particles import BootstrapFilter, ParticleBelief
from vssm_gym.maps.planar_map import PlanarMap
from vssm_gym.model.scan_emission import OccupancyScans, ScanLikelihood
from vssm_gym.model.scanner import Scanner
from vssm_gym.model.transition.manifold import PLANAR
from vssm_gym.model.transition.odometry import Odometry
from vssm_gym.progress import OnProgress
from vssm_gym.slam.planar_run import FLOOR_CELLS, FLOOR_TURN, SHARES, run_scans
from vssm_gym.viz.pictures import svg

MAPPING_STEPS = 3000  # commands of the traversal that the map is learned from
AMBIGUITY_CELL = 0.005  # m, of the map: at 0.01 walls that are one cell thick lose parts
AMBIGUITY_EVERY = 4  # beams of a scan: one of so many is weighed
# m: Laplace scale of a reading, and the share of the beams that count as independent. Particles are some centimetres
# apart at first; a sharper density would leave one of them, at a place drawn by chance. Chosen on pillars-v1.
AMBIGUITY_SCALE, AMBIGUITY_SHARE = 0.04, 0.0625
AMBIGUITY_SHOWN = (1, 5, 10, 20, 60)  # scans, beside the last
AMBIGUITY_DRAWN = 1200  # particles of a picture, by their weight
HEADER = ("scans", "places", "entropy, nats", "mass of the heaviest place", "mass at the true pose")


class Localised(NamedTuple):
    """Hold a localisation; everything after 0, 1, 2, ... scans."""

    spreads: list[Spread]
    moments: list[Moment]  # of the scans that are shown


def run(
    maze: str = "serpentine-v1",
    scans: int = 120,
    particles: int = 20_000,
    seed: int = 0,
    on_progress: OnProgress | None = None,
) -> Study:
    """Map the maze, localise another drive in it, and measure the belief after each scan.

    Args:
        maze: name of a maze.
        scans: of the drive.
        particles: of the filter.
        seed: of both drives and of the filter.
        on_progress: called with the stage, what is done and the total.

    Raises:
        InputError: an unknown maze, fewer than two scans, or fewer than ten particles.
    """
    if scans < 2:
        raise InputError("pose-ambiguity", "scans", f"at least 2, not {scans}")
    if particles < 10:
        raise InputError("pose-ambiguity", "particles", f"at least 10, not {particles}")
    world = load_maze(maze)
    mapping, drive = traverse(world, MAPPING_STEPS, 2 * seed), traverse(world, scans - 1, 2 * seed + 1)
    m = run_scans(mapping, AMBIGUITY_CELL, on_progress=labelled(on_progress, "mapping")).m
    assert mapping.poses is not None and drive.poses is not None
    true = relation(mapping.poses[:1], drive.poses)  # seen from where the map begins
    found = localise(m, drive, true, particles, seed, labelled(on_progress, "localising"))
    figure = draw(m, mapping.poses[0], found.moments, found.spreads, particles)
    return Study(
        name="pose-ambiguity",
        question=f"Where is the robot? {maze}",
        answer=_answer(found.spreads),
        header=HEADER,
        lines=[_line(moment.scans, found.spreads[moment.scans]) for moment in found.moments],
        picture=svg(figure),
        setting={
            "maze": maze, "scans": scans, "particles": particles, "seed": seed, "mapping_steps": MAPPING_STEPS,
            "cell_size": AMBIGUITY_CELL, "every": AMBIGUITY_EVERY, "scale": AMBIGUITY_SCALE, "share": AMBIGUITY_SHARE,
        },
        figures={"by_scans": [one._asdict() for one in found.spreads]},
        notes=(
            "The map is learned from the scans and commands of another traversal. The particles begin uniformly over "
            "the free space that it has seen, at any heading; each is moved by the commands, with the errors that the "
            "odometry is believed to have, and weighed by the scan. The true pose is drawn, and measures the last "
            "column; the filter does not know it.",
            f"Places: connected parts of the bins of 5 cm and 22.5 degrees that hold {MASS_HELD:.0%} of the mass, with "
            f"{LEAST_OF_MODE:.0%} or more each. At the true pose: within {AT_POSE:g} m and "
            f"{np.degrees(AT_HEADING):g} degrees of it.",
        ),
    )  # fmt: skip


def localise(
    m: PlanarMap,
    drive: LaserLog,
    true: Float[np.ndarray, "scans 3"],
    particles: int,
    seed: int,
    on_progress: OnProgress | None = None,
) -> Localised:
    """Filter a drive by particles from the uniform prior.

    Args:
        m: the known map.
        drive: scans and commands.
        true: pose at each scan in the map's frame, for the measures.
        particles: their number.
        seed: of the filter.
        on_progress: called after each scan.
    """
    angles, ranges = (
        jnp.asarray(drive.angles[::AMBIGUITY_EVERY], jnp.float32),
        jnp.asarray(drive.ranges[:, ::AMBIGUITY_EVERY]),
    )
    scanner = Scanner(angles, jnp.asarray(drive.mount, jnp.float32), jnp.float32(drive.max_range))
    model = OccupancyScans(m, scanner, AMBIGUITY_SCALE, AMBIGUITY_SHARE)
    floor = FLOOR_CELLS * float(m.cell_size)
    transition = Odometry((floor, floor, FLOOR_TURN), SHARES)
    key = jax.random.key(seed)
    belief = uniform(jax.random.fold_in(key, 0), m, particles)
    shown = {*(at for at in AMBIGUITY_SHOWN if at < len(drive)), len(drive)}
    spreads, moments = [], []
    for t in range(len(drive) + 1):
        if t == 1:
            belief = _first(belief, ranges[0], model, transition)
        elif t > 1:
            motion = jnp.asarray(drive.motions[t - 2], jnp.float32)
            belief = _next(jax.random.fold_in(key, t), belief, motion, ranges[t - 1], model, transition)
        at = true[max(t - 1, 0)]
        spreads.append(spread(np.asarray(belief.states), np.asarray(belief.weight), at))
        if t in shown:
            moments.append(Moment(t, np.asarray(belief.sample(key, AMBIGUITY_DRAWN)), at))
        if on_progress:
            on_progress("localising", t, len(drive))
    return Localised(spreads, moments)


def uniform(key: PRNGKeyArray, m: PlanarMap, particles: int) -> ParticleBelief:
    """Return poses drawn uniformly over what the map has seen to be free, and over all headings."""
    of_cell, in_cell, of_heading = jax.random.split(key, 3)
    free = np.argwhere(m.observed & (np.asarray(m.occupancy) < 0.0))
    cells = jnp.asarray(free)[jax.random.randint(of_cell, (particles,), 0, len(free))]
    xy = m.origin + m.cell_size * (cells + jax.random.uniform(in_cell, (particles, 2), minval=-0.5, maxval=0.5))
    heading = jax.random.uniform(of_heading, (particles, 1), minval=-jnp.pi, maxval=jnp.pi)
    return ParticleBelief.of(jnp.concatenate([xy, heading], axis=1), PLANAR)


@jax.jit
def _first(belief: ParticleBelief, ranges: Array, model: OccupancyScans, transition: Odometry) -> ParticleBelief:
    return BootstrapFilter(transition).observe(belief, ScanLikelihood(ranges, model)).belief


@jax.jit
def _next(
    key: PRNGKeyArray, belief: ParticleBelief, motion: Array, ranges: Array, model: OccupancyScans, transition: Odometry
) -> ParticleBelief:
    return BootstrapFilter(transition).step(key, belief, motion, ScanLikelihood(ranges, model), 0.0).belief


def _line(scans: int, found: Spread) -> list[str]:
    return [str(scans), str(found.modes), f"{found.entropy:.2f}", f"{found.largest:.1%}", f"{found.at_truth:.1%}"]


def _answer(spreads: Sequence[Spread]) -> str:
    """Say how many places there were at most, from when on there is one, and whether it is the true one."""
    end = len(spreads) - 1
    most = max(range(1, end + 1), key=lambda t: spreads[t].modes)
    one = 1 + max((t for t in range(end + 1) if spreads[t].modes != 1), default=0)
    until = f"from scan {one} on it is one" if one <= end else f"after {end} scans in {spreads[-1].modes}"
    return (
        f"The robot could be in {spreads[most].modes} places after {most} scans; {until}. At the true pose lies "
        f"{spreads[-1].at_truth:.1%} of the mass in the end; the entropy falls from {spreads[0].entropy:.1f} to "
        f"{spreads[-1].entropy:.1f} nats."
    )
