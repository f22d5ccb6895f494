"""Compute on a GPU with the digits of float32, and share its memory between processes.

Two defaults of JAX do not suit this package. Factors of float32 matrix products are rounded to TF32 (ten bits of
fraction) on an NVIDIA GPU and to bfloat16 on a TPU: a point 10 m away is then off by up to a centimetre, or by several.
And the first process takes three quarters of a GPU's memory, so the workers of a sweep, or PyTorch beside JAX, find
none. On a processor neither matters, and no bit of a result changes.

The price is that a program's own networks multiply with all digits too, and that memory is claimed as it is needed;
where JAX has begun to use a GPU before the package is imported, the second default comes too late.
JAX's own variables are the switches; one that is set keeps its value.
"""

import os
import sys

PRECISION = "JAX_DEFAULT_MATMUL_PRECISION"
SETTINGS = {PRECISION: "highest", "XLA_PYTHON_CLIENT_PREALLOCATE": "false"}  # the second is read with the first array


def use_gpu_defaults() -> None:
    """Set the variables, for this process and those that it starts; configure JAX where it was imported already."""
    configured = PRECISION in os.environ
    for name, value in SETTINGS.items():
        os.environ.setdefault(name, value)
    if "jax" in sys.modules and not configured:
        import jax

        if jax.config.values["jax_default_matmul_precision"] is None:
            jax.config.update("jax_default_matmul_precision", SETTINGS[PRECISION])
