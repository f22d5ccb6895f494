"""Define paths of this checkout."""

from pathlib import Path

CHECKOUT = Path(__file__).resolve().parents[2]
BASELINES = CHECKOUT / "eval" / "baselines"  # committed rows, of sweeps, studies and the benchmark
SHARED_DATA = CHECKOUT.parent / "shared" / "data"  # real recordings and houses; tests that need them skip without
