"""``u(p) = sum_k w_k(p) (v_k + omega_k x p)``: the displacement of a map by the errors of the poses it was made at.

All that an image wrote into the map carries the error ``xi_k = (v_k, omega_k)`` of its pose, in the tangent of the
world: the true pose is ``exp(xi_k)`` times the estimated one. Errors along a trajectory are a random walk, ``xi_k =
sum_{j <= k} delta_j`` with independent ``delta_j ~ N(0, D_j)``, so that poses near each other in time err alike and
walls move as a whole. The displacement of a point is the mean over the keyframes that saw it. A keyframe sees what
lies in its field of view up to its range, with weights that fall smoothly to 0 at its border; that something stands in
between is neglected.
"""

from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from vssm_gym.errors import InputError
from vssm_gym.files.numbers import whole
from vssm_gym.geometry.camera import MAX_DEPTH, Camera
from vssm_gym.geometry.transforms import inverse

FADING = 0.15  # of half an image, and of the range, over which a weight falls to 0
NEAREST = 1e-4  # weight at the camera of a keyframe for what no keyframe saw: those nearby decide
MOST_KEYFRAMES = 256  # of a file


class PoseErrors(eqx.Module):
    """Hold the distribution of the errors of a trajectory's poses."""

    T_world_cam: Float[Array, "keyframes 4 4"]
    root: Float[Array, "keyframes 6 6"]  # D_j = root root^T, (translation, rotation) in the world's tangent
    used: Float[Array, "keyframes"]  # 1; 0 for rows without a keyframe
    camera: Camera
    reach: Float[Array, ""] | float = MAX_DEPTH  # m, range of the readings

    @classmethod
    def of(
        cls,
        T_world_cam: Float[np.ndarray, "keyframes 4 4"],
        covariance: Float[np.ndarray, "keyframes 6 6"],
        camera: Camera,
        reach: float = MAX_DEPTH,
    ) -> "PoseErrors":
        """Return the random walk whose covariance at keyframe k is ``covariance[k]``, as far as one can have it.

        A random walk's covariance grows; where the given one shrinks along a direction, it stays as it was.

        Args:
            T_world_cam: poses in the order in which they were visited, the first nearest to the pose that is known.
            covariance: of each pose, (translation, rotation) in the world's tangent.
            camera: of the images.
            reach: range of the readings, m.
        """
        grown, roots = np.zeros((6, 6)), []
        for P in np.asarray(covariance, np.float64):
            step = P - grown
            values, axes = np.linalg.eigh(0.5 * (step + step.T))
            root = axes * np.sqrt(np.maximum(values, 0.0))
            roots.append(root)
            grown = grown + root @ root.T
        T, root = jnp.asarray(T_world_cam, jnp.float32), jnp.asarray(np.array(roots), jnp.float32)
        return cls(T, root, jnp.ones(len(root)), camera, reach)

    @classmethod
    def of_ring(
        cls,
        T_world_cam: Float[Array, "keyframes 4 4"],
        count: Int[Array, ""],
        covariance: Float[Array, "6 6"],
        camera: Camera,
        reach: float | Array = MAX_DEPTH,
    ) -> "PoseErrors":
        """Return errors about the last keyframe of a filter, whose walk made equal steps from keyframe to keyframe.

        Args:
            T_world_cam: ring of keyframes: number i is in row i modulo its length.
            count: number of keyframes ever kept, at least 1.
            covariance: between first and last of them, (translation, rotation) in the world's tangent.
            camera: of the images.
            reach: range of the readings, m.
        """
        return _of_ring(T_world_cam, count, covariance, camera, jnp.asarray(reach, jnp.float32))

    def to_json(self) -> dict[str, Any]:
        """Return the content of a file's header, which :meth:`from_header` reads."""
        camera = [float(np.asarray(f)) for f in (self.camera.fx, self.camera.fy, self.camera.cx, self.camera.cy)]
        used = np.asarray(self.used) > 0.0
        numbers = lambda a: np.asarray(a, np.float64)[used].tolist()
        return {
            "T_world_cam": numbers(self.T_world_cam),
            "root": numbers(self.root),
            "camera": [self.camera.width, self.camera.height, *camera],
            "reach": float(self.reach),
        }

    @classmethod
    def from_header(cls, path: str | Path, header: dict[str, Any]) -> "PoseErrors | None":
        """Return the errors in the header of a map file; None where it holds none.

        Raises:
            InputError: a damaged header.
        """
        stored = header.get("pose_errors")
        if stored is None:
            return None
        field = "pose_errors"
        try:
            with np.errstate(over="ignore"):  # what overflows is refused below
                T, root = (np.asarray(stored[name], np.float32) for name in ("T_world_cam", "root"))
            width, height, *intrinsics = stored["camera"]
            fx, fy, cx, cy, reach = (float(f) for f in (*intrinsics, stored["reach"]))
        except (TypeError, ValueError, KeyError, OverflowError) as error:
            raise InputError(path, field, "poses, roots, a camera and its range") from error
        n = len(T) if T.ndim else 0
        if not 1 <= n <= MOST_KEYFRAMES or T.shape != (n, 4, 4) or root.shape != (n, 6, 6):
            raise InputError(path, field, f"1 to {MOST_KEYFRAMES} poses (4, 4), and as many roots (6, 6)")
        sizes = [whole(size, path, f"{field}.camera", least=1, most=100_000) for size in (width, height)]
        if not (np.isfinite(T).all() and np.isfinite(root).all() and np.isfinite([cx, cy]).all()):
            raise InputError(path, field, "finite numbers")
        if not all(0.0 < a < 1e6 for a in (fx, fy, reach)):
            raise InputError(path, field, "focal lengths and a range above 0")
        return cls(jnp.asarray(T), jnp.asarray(root), jnp.ones(n), Camera(sizes[0], sizes[1], fx, fy, cx, cy), reach)

    def weights(self, p_world: Float[Array, "*batch 3"]) -> Float[Array, "*batch keyframes"]:
        """Return the share of each keyframe in what the map holds at points (m); they sum to 1."""
        T = inverse(self.T_world_cam)
        x, y, z = (p_world @ T[:, a, :3].T + T[:, a, 3] for a in range(3))
        ahead = jnp.maximum(z, 1e-3)
        u = (x / ahead * self.camera.fx + self.camera.cx + 0.5) / self.camera.width
        v = (y / ahead * self.camera.fy + self.camera.cy + 0.5) / self.camera.height
        seen = _within(u) * _within(v) * jnp.clip((self.reach - z) / (FADING * self.reach), 0.0, 1.0) * (z > 1e-3)
        seen = (seen + NEAREST / (1.0 + (x**2 + y**2 + z**2) ** 2)) * self.used
        return seen / jnp.sum(seen, axis=-1, keepdims=True)

    def displacement(
        self, p_world: Float[Array, "*batch 3"], drawn: Float[Array, "keyframes 6"]
    ) -> Float[Array, "*batch 3"]:
        """Return ``u(p)`` of a trajectory whose steps are ``delta_j = root_j drawn_j``, m (eq. M14)."""
        xi = jnp.cumsum(jnp.einsum("kij,kj->ki", self.root, drawn), axis=0)
        mixed = self.weights(p_world) @ xi
        return mixed[..., :3] + jnp.cross(mixed[..., 3:], p_world)

    def variance(self, p_world: Float[Array, "*batch 3"], normal: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
        """Return ``var(n . u(p))`` of points along unit normals, m^2 (eq. M12)."""
        lever = jnp.concatenate([normal, jnp.cross(p_world, normal)], axis=-1)
        return jnp.einsum("...i,...ij,...j->...", lever, self._covariance(p_world), lever)

    def planar_covariance(self, p_world: Float[Array, "3"]) -> Float[Array, "3 3"]:
        """Return the covariance of the map's displacement (x, y, m) and turn about z (rad) at a point (m).

        A robot there that is localised in the map is as far off in the world.
        """
        n = jnp.eye(3)
        levers = jnp.concatenate([n[:2], jnp.cross(p_world, n[:2])], axis=-1)
        J = jnp.concatenate([levers, jnp.eye(6)[5:]])
        return J @ self._covariance(p_world) @ J.T

    def _covariance(self, p_world: Float[Array, "*batch 3"]) -> Float[Array, "*batch 6 6"]:
        """Return the covariance of the error ``sum_k w_k(p) xi_k`` of what the map holds at points, world's tangent."""
        # Step j moves what keyframe j and all later ones saw: its share is the sum of their weights.
        share = jnp.cumsum(self.weights(p_world)[..., ::-1], axis=-1)[..., ::-1]
        return jnp.einsum("...k,kij->...ij", share**2, self.root @ jnp.swapaxes(self.root, 1, 2))

    def draw(self, key: Array) -> Float[Array, "keyframes 6"]:
        """Draw standard normal coefficients for :meth:`displacement`."""
        return jax.random.normal(key, self.root.shape[:2])


@jax.jit
def _of_ring(T_world_cam: Array, count: Array, covariance: Array, camera: Camera, reach: Array) -> PoseErrors:
    n = T_world_cam.shape[0]
    back = jnp.arange(n)  # keyframes before the last
    used = (back < count).astype(jnp.float32)
    values, axes = jnp.linalg.eigh(0.5 * (covariance + covariance.T))
    step = axes * jnp.sqrt(jnp.maximum(values, 0.0) / jnp.maximum(count - 1, 1))
    root = jnp.where((used * (back > 0))[:, None, None], step, 0.0)
    return PoseErrors(T_world_cam[(count - 1 - back) % n], root, used, camera, reach)


def _within(share: Array) -> Array:
    """Return 1 inside an image, falling to 0 at its border; ``share`` is 0 at one edge and 1 at the other."""
    return jnp.clip((0.5 - jnp.abs(share - 0.5)) / (0.5 * FADING), 0.0, 1.0)
