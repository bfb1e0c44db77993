# SPDX-License-Identifier: BSD-3-Clause
"""Arrays that are handed around: lengths are metres, spheres rows (x, y, z, radius).

Their lengths are not named: two arguments of one kind need not be equally long.
"""

import numpy as np
from jaxtyping import Bool, Float, Int, Int32

Vector = Float[np.ndarray, " 3"]
Matrix = Float[np.ndarray, "3 3"]
Pose = Float[np.ndarray, "4 4"]
Points = Float[np.ndarray, "_ 3"]
Values = Float[np.ndarray, " _"]
Chosen = Bool[np.ndarray, " _"]
Indices = Int[np.ndarray, " _"]
# Of pixels.
Image = Float[np.ndarray, "_ _"]
Pixels = Bool[np.ndarray, "_ _"]
Ids = Int32[np.ndarray, "_ _"]
PointImage = Float[np.ndarray, "_ _ 3"]
# Of robots.
Spheres = Float[np.ndarray, "_ 4"]
Triangles = Float[np.ndarray, "_ 3 3"]
Pairs = Int[np.ndarray, "_ 2"]
Configurations = Float[np.ndarray, "_ _"]
