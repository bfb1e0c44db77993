# SPDX-License-Identifier: BSD-3-Clause
"""Arrays that are handed around: lengths are metres, spheres rows (x, y, z, radius)."""

import numpy as np
from jaxtyping import Bool, Float, Int, Int32

Vector = Float[np.ndarray, " 3"]
Matrix = Float[np.ndarray, "3 3"]
Pose = Float[np.ndarray, "4 4"]
Points = Float[np.ndarray, "n 3"]
Values = Float[np.ndarray, " n"]
Chosen = Bool[np.ndarray, " n"]
Indices = Int[np.ndarray, " n"]
# Of pixels.
Image = Float[np.ndarray, "h w"]
Pixels = Bool[np.ndarray, "h w"]
Ids = Int32[np.ndarray, "h w"]
PointImage = Float[np.ndarray, "h w 3"]
# Of robots.
Spheres = Float[np.ndarray, "n 4"]
Triangles = Float[np.ndarray, "f 3 3"]
Pairs = Int[np.ndarray, "pairs 2"]
Configurations = Float[np.ndarray, "n dof"]
