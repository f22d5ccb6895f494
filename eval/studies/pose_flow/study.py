"""Fit a Gaussian and a flow to the pose of a camera that sees a ball, and measure what they cover (VSSM-LM, fig. 5.4).

``p(z | x)`` is the same on all sides of the ball and at all rolls about the line of sight: SO(3) around a point.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from vssm_gym.eval.studies.page import Study
from vssm_gym.eval.studies.pose_flow.ball import DISTANCE, ball_in_camera, true_pose, view
from vssm_gym.eval.studies.pose_flow.picture import draw
from vssm_gym.inference.smoothing.families import Chain, MeanField
from vssm_gym.inference.smoothing.pose_flow import PoseFlow
from vssm_gym.inference.smoothing.pose_posterior import FitConfig, bound, climb, effective_share, fit, weigh
from vssm_gym.inference.smoothing.start_beliefs import start_beliefs
from vssm_gym.model.transition.manifold import POSES
from vssm_gym.progress import OnProgress

POSITION_STD = 1.5  # m, of each coordinate of the position about the ball; any rotation
POSTERIOR_DRAWS = 2048  # draws of each posterior
PATCHES = 100  # of equal area on the sphere of directions
CENTRED = np.radians(2.0)  # the line of sight passes the ball's centre within this angle, and ...
DISTANT = 0.05  # m: ... the distance is right within this
# Standard deviations (m, rad) that the Gaussians start with, at the true pose
SMALL, WIDE = jnp.array([0.005] * 3 + [0.05] * 3), jnp.array([0.003] * 3 + [0.8] * 3)
GAUSSIAN = FitConfig(steps=600, rate=0.01, heat=3.0)  # of their climb
CORRELATED = FitConfig(steps=400, rate=0.002, heat=1.0)  # of one that starts near its optimum
FLOW = FitConfig()
NAMES = ("mean field", "Gaussian", "flow")
HEADER = ("family", "ELBO, nats", "sphere covered", "distance error, mm", "ball in the centre")


def run(seed: int = 0, on_progress: OnProgress | None = None) -> Study:
    """Fit each family to one image, and measure it.

    Args:
        seed: of the image's noise and of the fits.
        on_progress: called with (family, families done, families).
    """
    given = view(seed)
    keys = jax.random.split(jax.random.key(seed), 6)
    prior = PoseFlow.around(keys[0], jnp.eye(4), POSITION_STD)
    fits = {
        "mean field": lambda: climb(keys[1], _mean_field(), prior, given, GAUSSIAN),
        "Gaussian": lambda: climb(keys[2], _around_the_ball(), prior, given, CORRELATED),
        "flow": lambda: fit(keys[3], prior, prior, given, FLOW),
    }
    found: dict[str, Any] = {}
    for done, (name, fitted) in enumerate(fits.items()):
        found[name] = fitted()
        if on_progress:
            on_progress(name, done + 1, len(fits))
    weighed = weigh(keys[4], found["flow"], prior, given, POSTERIOR_DRAWS)
    evidence = float(jax.scipy.special.logsumexp(weighed.log_weight)) - float(np.log(POSTERIOR_DRAWS))
    poses = {name: np.asarray(q.draw(keys[5], POSTERIOR_DRAWS).states[:, 0]) for name, q in found.items()}
    elbos = {name: float(bound(keys[5], q, prior, given, POSTERIOR_DRAWS)) for name, q in found.items()}
    figures: dict[str, dict[str, Any]] = {name: {"elbo": elbos[name], **_measured(poses[name])} for name in NAMES}
    starts = start_beliefs(keys[4], found["flow"], prior, given, (0.1, 0.1))
    figures["flow"]["effective"] = float(effective_share(weighed.log_weight))
    figures["flow"]["shares"] = [start.share for start in starts]
    return Study(
        name="pose-flow",
        question="Which family holds a pose that an image leaves open?",
        answer=_answer(figures, evidence),
        header=HEADER,
        lines=[_line(name, figures[name]) for name in NAMES],
        picture=draw(given.image, poses),
        setting={"seed": seed, "prior_std": POSITION_STD, "distance": DISTANCE},
        figures={"log_evidence": evidence, "by_family": figures},
        notes=(
            "One ball of one colour in free space, known, and one noisy image of it. The prior has the camera about "
            f"the ball, with {POSITION_STD:g} m in each coordinate, and any rotation. Covered: the exponential of the "
            f"entropy of the sides of {POSTERIOR_DRAWS:,} draws over {PATCHES} equal patches of the sphere, divided by "
            "their number. In the centre: the line of sight passes the centre of the ball within "
            f"{np.degrees(CENTRED):.0f} degrees, at the right distance within {100 * DISTANT:.0f} cm.",
            "The Gaussians start at the true pose: the mean field narrow, the one with correlations wide along the "
            "rotations about the ball, which are straight lines in the tangent of SE(3). Its bound counts a rotation "
            "by more than half a turn as another pose, and is a little too high. The flow starts at the prior.",
            "The evidence is estimated by importance: draws of the flow, weighted by the posterior.",
        ),
    )


def _mean_field() -> MeanField:
    return MeanField.around(jnp.asarray(true_pose()[None], jnp.float32), SMALL[None], POSES)


def _around_the_ball() -> Chain:
    """Return a Gaussian at the true pose whose rotations turn the camera about the ball: ``dt = b x dr`` (eq. I55)."""
    start = Chain.around(jnp.asarray(true_pose()[None], jnp.float32), WIDE[None], POSES)
    b = jnp.array([0.0, 0.0, DISTANCE])
    turned = jnp.cross(b, jnp.eye(3)).T  # columns: dt of each dr
    within = jnp.zeros((1, 6, 6)).at[0, 3:, :3].set(-(turned * WIDE[3:]).T / WIDE[:3])
    return eqx.tree_at(lambda q: q.within, start, within)


def _measured(T_world_cam: Float[np.ndarray, "n 4 4"]) -> dict[str, float]:
    """Return the coverage of the sphere, and how the draws see the ball."""
    b = ball_in_camera(T_world_cam)
    distance = np.linalg.norm(b, axis=1)
    off = np.arccos(np.clip(b[:, 2] / distance, -1.0, 1.0))
    return {
        "covered": covered(T_world_cam[:, :3, 3]),
        "distance_rmse": float(np.sqrt(np.mean((distance - DISTANCE) ** 2))),
        "centred": float(np.mean((off < CENTRED) & (np.abs(distance - DISTANCE) < DISTANT))),
    }


def covered(positions: Float[np.ndarray, "n 3"]) -> float:
    """``exp(H) / PATCHES``, ``H`` the entropy of the patches that positions about the origin lie over; 1: uniform."""
    k = np.arange(PATCHES)
    z, azimuth = 1.0 - (2.0 * k + 1.0) / PATCHES, np.pi * (1.0 + np.sqrt(5.0)) * k  # Fibonacci's sphere
    r = np.sqrt(1.0 - z**2)
    patches = np.stack([r * np.cos(azimuth), r * np.sin(azimuth), z], axis=1)
    share = np.bincount(np.argmax(positions @ patches.T, axis=1), minlength=PATCHES) / len(positions)
    share = share[share > 0.0]
    return float(np.exp(-np.sum(share * np.log(share))) / PATCHES)


def _line(name: str, of: dict[str, Any]) -> list[str]:
    return [
        name,
        f"{of['elbo']:.1f}",
        f"{of['covered']:.0%}",
        f"{1e3 * of['distance_rmse']:.1f}",
        f"{of['centred']:.1%}",
    ]


def _answer(figures: dict[str, dict[str, Any]], evidence: float) -> str:
    gaps = ", ".join(f"{name} {evidence - figures[name]['elbo']:.1f}" for name in NAMES)
    return (
        f"The log evidence is {evidence:.1f} nats; the bounds lie below it by, in nats: {gaps}. The flow covers "
        f"{figures['flow']['covered']:.0%} of the sphere, the mean field {figures['mean field']['covered']:.0%}, the "
        f"Gaussian with correlations {figures['Gaussian']['covered']:.0%}. The largest part of the flow's posterior "
        f"that one filter could start from has {max(figures['flow']['shares'], default=0.0):.1%} of it, by weights of "
        f"which {figures['flow']['effective']:.1%} count."
    )
