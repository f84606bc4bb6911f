"""Kinds of arrays that PSFs are worked out with."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""Real numbers, such as the light of the pixels of a picture."""

Points = NDArray[np.int64]
"""Whole offsets ``(n, 2)``, each (dx, dy) in px from the centre of a PSF."""
