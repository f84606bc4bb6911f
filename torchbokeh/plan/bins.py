"""Soft bins of constant parallax: where they lie in a scene."""

import math

FOREGROUND = (-2.0, -1.0)
"""Signed CoC (px) between which a pixel passes from foreground to rest. What is sharper hides nothing."""

SPACING = 6.0
"""Distance of bins in px of CoC, where there are three or more. What counts is what hides what."""


def bin_centres(low: float, high: float, most: int) -> tuple[float, ...]:
    """Evenly spaced bins for CoCs from ``low`` to ``high`` px, `SPACING` apart if ``most`` allows.

    They move and appear without a jump as the CoCs change: a new bin begins with a share of 0. The last one may lie
    beyond ``high``. Between 1 and 2 px, one bin becomes two.
    """
    extent = high - low
    if extent <= 1 or most == 1:
        return (0.5 * (low + high),)
    if extent <= 2:
        shift = (2 - extent) * extent
        return low + shift, high + shift
    spacing = max(min(extent, SPACING), extent / (most - 1))
    return tuple(low + spacing * k for k in range(1 + math.ceil(extent / spacing - 1e-9)))
