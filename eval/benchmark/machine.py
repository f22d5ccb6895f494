"""Describe the machine that results were made on."""

import os
import platform
from typing import Any

from vssm_gym.instruction_set import cpu_model


def machine() -> dict[str, Any]:
    """Return the ``processor``, the ``cores`` that this process may use of those there are, and the ``accelerator``."""
    import jax

    devices = [device for device in jax.devices() if device.platform != "cpu"]
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return {
        "processor": cpu_model(),
        "cores": usable,
        "of_cores": os.cpu_count(),
        "accelerator": devices[0].device_kind if devices else None,
        "system": f"{platform.system()} {platform.machine()}, Python {platform.python_version()}",
    }


def load() -> float | None:
    """Return how many processes ran or waited to run, a mean over a minute; None where the system does not tell."""
    return round(os.getloadavg()[0], 1) if hasattr(os, "getloadavg") else None


def described(found: dict[str, Any]) -> str:
    """Return a machine in words."""
    of = "" if found["of_cores"] == found["cores"] else f" of {found['of_cores']}"
    accelerator = found["accelerator"] or "no accelerator"
    return f"{found['processor']}, {found['cores']}{of} cores, {accelerator}, {found['system']}"
