"""Determine the version that is recorded with every result."""

import subprocess
from pathlib import Path

__version__ = "0.1.0"


def package_version() -> str:
    """Return the package's version; in a checkout with its commit, and ``-dirty`` where files differ from it."""
    checkout = Path(__file__).resolve().parents[1]
    if (checkout / ".git").exists():
        command = ["git", "-C", str(checkout), "describe", "--always", "--dirty", "--abbrev=12"]
        described = subprocess.run(command, capture_output=True, text=True, check=False)
        if described.returncode == 0:
            return f"{__version__}+{described.stdout.strip()}"
    return __version__
