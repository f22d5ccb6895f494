"""Configure the planar filter; its lengths are in cells, so that a maze and a building have one configuration."""

from dataclasses import dataclass

from vssm_gym.errors import InputError


@dataclass(frozen=True)
class PlanarConfig:
    """Configure alignment and map update.

    Args:
        reading_std: cells, of a reading against the map.
        band: cells on either side of a surface that a scan updates.
        free_weight: of an observation of free space before the band, as a share of one in it.
        most_scans: that a cell's precision counts, so that a map stays open to what has changed.
        share: of the beams that count as independent.
        huber: standard deviations from which a residual counts less.
        iterations: of Gauss-Newton.
    """

    reading_std: float = 0.5
    band: float = 4.0
    free_weight: float = 0.3
    most_scans: float = 200.0
    share: float = 0.3
    huber: float = 2.0
    iterations: int = 8

    def __post_init__(self) -> None:
        for name in ("reading_std", "band", "free_weight", "most_scans", "share", "huber"):
            if not getattr(self, name) > 0.0:
                raise InputError("PlanarConfig", name, f"above 0, not {getattr(self, name)}")
        if self.iterations < 1:
            raise InputError("PlanarConfig", "iterations", f"at least 1, not {self.iterations}")
