"""Hold what the evidence lower bound is maximised over, positive numbers by their logarithms (VSSM-LM, section 4)."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from vssm_gym.inference.smoothing.colour_network import ColourNetwork
from vssm_gym.inference.smoothing.elbo import VariationalPosterior
from vssm_gym.inference.smoothing.families import TrajectoryBelief
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model.emission_density import EmissionScales
from vssm_gym.model.spatial_model import SpatialModel


class LogScales(eqx.Module):
    """Hold the logarithms of the emission's scales; shares of outliers and misses are not among them."""

    depth: Float[Array, ""]  # of m
    growth: Float[Array, ""]  # of 1/m
    rgb: Float[Array, ""]
    textured_rgb: Float[Array, ""]


class Intrinsics(eqx.Module):
    """Hold the camera's intrinsics, pixels."""

    fx: Float[Array, ""]
    fy: Float[Array, ""]
    cx: Float[Array, ""]
    cy: Float[Array, ""]


class Parameters(eqx.Module):
    """Hold the parameters of ``q(z_1:T)``, of ``q(M)`` and of the emission.

    Attributes:
        states: the trajectory's family.
        occupancy: means of the cells, m.
        log_occupancy_std: of the cells.
        colour: means of the cells.
        log_colour_std: of the cells, one number for three channels.
        log_scales: of the emission.
        intrinsics: of the camera.
        network: of colours, where the posterior has one.
    """

    states: TrajectoryBelief
    occupancy: Float[Array, "rows cells"]
    log_occupancy_std: Float[Array, "rows cells"]
    colour: Float[Array, "rows 3 cells"]
    log_colour_std: Float[Array, "rows cells"]
    log_scales: LogScales
    intrinsics: Intrinsics
    network: ColourNetwork | None = None

    @classmethod
    def of(cls, q: VariationalPosterior, model: SpatialModel) -> "Parameters":
        """Return the parameters of a posterior and of a model's emission.

        Args:
            q: the approximate posterior.
            model: its scales and intrinsics are read.
        """
        scales, camera = model.scales, model.camera
        logs = (jnp.log(x) for x in (scales.depth, scales.growth, scales.rgb, scales.textured_rgb))
        parameters = cls(
            states=q.states,
            occupancy=q.m.occupancy,
            log_occupancy_std=-0.5 * jnp.log(q.m.occupancy_precision),
            colour=q.m.colour,
            log_colour_std=-0.5 * jnp.log(q.m.colour_precision),
            log_scales=LogScales(*logs),
            intrinsics=Intrinsics(*(jnp.asarray(x) for x in (camera.fx, camera.fy, camera.cx, camera.cy))),
            network=q.network,
        )
        # None of weak type, which the first gradient step would change: all would compile twice
        return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), parameters)

    def posterior(self, grid: VoxelMap) -> VariationalPosterior:
        """Return ``q(z_1:T, M)``.

        Args:
            grid: says where the cells lie; its means and precisions are not read. The index of empty space stays as it
                is, so that a map to be searched is made by :meth:`VoxelMap.with_occupancy`.
        """
        belief = lambda m: (m.occupancy, m.occupancy_precision, m.colour, m.colour_precision)
        precisions = jnp.exp(-2.0 * self.log_occupancy_std), jnp.exp(-2.0 * self.log_colour_std)
        cells = (self.occupancy, precisions[0], self.colour, precisions[1])
        return VariationalPosterior(self.states, eqx.tree_at(belief, grid, cells), self.network)

    def model(self, model: SpatialModel) -> SpatialModel:
        """Return the model with these scales and intrinsics."""
        s, K = self.log_scales, self.intrinsics
        emission = lambda scales: (scales.depth, scales.growth, scales.rgb, scales.textured_rgb)
        scales: EmissionScales = eqx.tree_at(
            emission, model.scales, (jnp.exp(s.depth), jnp.exp(s.growth), jnp.exp(s.rgb), jnp.exp(s.textured_rgb))
        )
        camera = eqx.tree_at(lambda c: (c.fx, c.fy, c.cx, c.cy), model.camera, (K.fx, K.fy, K.cx, K.cy))
        return eqx.tree_at(lambda m: (m.scales, m.camera), model, (scales, camera))
