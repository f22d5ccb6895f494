"""Round ``a b + c`` once, in loops that numba compiles: the processor's fused multiply-add, on every processor alike.

Left to itself a compiler fuses or not, as its processor and its version have it, and the last digit of a sum of
products follows from that. A processor without the instruction computes the same number in many.

numba's cache on disk sees changes of the file whose loops use this, not of this one.
"""

from typing import Any

from numba.core import types
from numba.extending import intrinsic


def _multiply_add(typing_context: Any, a: Any, b: Any, c: Any) -> Any:
    """Return numba's signature and code for three numbers of float32."""
    if not a == b == c == types.float32:
        return None  # numba's error names the types that it has found instead
    emit = lambda context, builder, signature, arguments: builder.fma(*arguments)
    return types.float32(types.float32, types.float32, types.float32), emit


fused: Any = intrinsic(_multiply_add)
"""Return ``a b + c`` of float32, rounded once."""
