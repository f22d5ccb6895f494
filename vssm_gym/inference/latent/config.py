"""Configure inference with a latent grid; its lengths are in cells, so that a maze and a building have one."""

from dataclasses import dataclass

from vssm_gym.errors import InputError


@dataclass(frozen=True)
class LatentConfig:
    """Configure particles and map.

    Args:
        latents: length of the vector in each cell.
        particles: of the pose.
        reading_std: cells, of a reading against a chart.
        counted: share of the beams that count as independent in the pose: charts err at neighbouring beams together.
        counted_map: share of a scan that counts as independent in a chart, among others taken close by.
        slope: of a range over the bearing, as a share of which its variance grows where it is written to a chart.
        huber: standard deviations from which a residual counts less.
        chunk: steps after which a scan is written. Within a chunk poses are inferred under the map of the other
            chunks: a chart that was written a moment ago errs as the pose does, and would hold it back.
    """

    latents: int = 48
    particles: int = 200
    reading_std: float = 0.16
    counted: float = 0.05
    counted_map: float = 1.0
    slope: float = 1.0
    huber: float = 2.0
    chunk: int = 20

    def __post_init__(self) -> None:
        for name in ("reading_std", "counted", "counted_map", "huber"):
            if not getattr(self, name) > 0.0:
                raise InputError("LatentConfig", name, f"above 0, not {getattr(self, name)}")
        if not self.slope >= 0.0:
            raise InputError("LatentConfig", "slope", f"at least 0, not {self.slope}")
        for name in ("latents", "particles", "chunk"):
            if getattr(self, name) < 1:
                raise InputError("LatentConfig", name, f"at least 1, not {getattr(self, name)}")
