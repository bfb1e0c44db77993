# SPDX-License-Identifier: BSD-3-Clause
"""What the viewer shows, as numbers: entropy on a grid, the robot's solids and where they are."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, UInt8

if TYPE_CHECKING:
    import trimesh

    from vprism_plan.mapping import VPrismMap
    from vprism_plan.robots import Robot

_CHUNK = 1 << 16
_SUPPORTED = 0.5  # of the largest kernel mass: the rim of the lattice has less
_MOST = 2_000_000  # grid points; a coarser grid is taken above


def to_bytes(color: Float[np.ndarray, "3"]) -> tuple[int, int, int]:
    """Return an RGB colour in 0..1 as bytes."""
    r, g, b = (round(255 * float(c)) for c in np.clip(color, 0.0, 1.0))
    return r, g, b


class EntropyVolume:
    """The entropy of a map (nats) on a grid over its support.

    Attributes:
        corners: (2, 3) first and last grid point, m.
        heights: lowest and highest slice and their distance, m.
        values: (nx, ny, nz) nats; NaN where the map has little support (see `_SUPPORTED`):
            there it repeats its prior.
    """

    def __init__(self, m: "VPrismMap", resolution: float) -> None:
        lower, upper = m.support_bounds()
        count = float(np.prod((upper - lower) / resolution))
        resolution *= max(1.0, (count / _MOST) ** (1 / 3))
        self._axes = [np.arange(lower[k], upper[k], resolution) for k in range(3)]
        grid = np.stack(np.meshgrid(*self._axes, indexing="ij"), axis=-1)
        points = grid.reshape(-1, 3)
        values = np.concatenate(
            [m.entropy(points[i : i + _CHUNK]) for i in range(0, len(points), _CHUNK)]
        )
        mass = np.concatenate(
            [m.support(points[i : i + _CHUNK]) for i in range(0, len(points), _CHUNK)]
        )
        shape = tuple(len(axis) for axis in self._axes)
        supported = mass > _SUPPORTED * mass.max()
        self.values: np.ndarray = np.where(supported, values, np.nan).reshape(shape)
        self._grid = grid
        self._top = float(np.log(m.n_classes))
        z = self._axes[2]
        self.heights = float(z[0]), float(z[-1]), round(float(resolution), 4)
        self.corners = np.stack([grid[0, 0, 0], grid[-1, -1, -1]])

    def cloud(self, at_least: float) -> tuple[Float[np.ndarray, "n 3"], UInt8[np.ndarray, "n 3"]]:
        """Return the points whose entropy is at least so many nats, and their colours."""
        with np.errstate(invalid="ignore"):
            chosen = self.values >= at_least
        return self._grid[chosen].astype(np.float32), self._colors(self.values[chosen])

    def slice(self, height: float) -> "trimesh.Trimesh":
        """Return the layer nearest to a height (m) as a flat, coloured surface."""
        import trimesh

        layer = int(np.abs(self._axes[2] - height).argmin())
        nx, ny, _ = self.values.shape
        corner = (np.arange(nx - 1)[:, None] * ny + np.arange(ny - 1)).ravel()
        one = np.stack([corner, corner + ny, corner + ny + 1], axis=1)
        other = np.stack([corner, corner + ny + 1, corner + 1], axis=1)
        faces = np.concatenate([one, other])
        colors = self._colors(self.values[:, :, layer].reshape(-1))
        return trimesh.Trimesh(
            self._grid[:, :, layer].reshape(-1, 3),
            np.concatenate([faces, faces[:, ::-1]]),  # seen from below as well
            vertex_colors=np.column_stack([colors, np.full(len(colors), 255, np.uint8)]),
            process=False,
        )

    def _colors(self, nats: Float[np.ndarray, " n"]) -> UInt8[np.ndarray, "n 3"]:
        from matplotlib import colormaps

        shades = colormaps["magma"](np.nan_to_num(nats / self._top), bytes=True)[:, :3]
        shades[np.isnan(nats)] = 200
        return np.asarray(shades, dtype=np.uint8)


@dataclass(frozen=True, eq=False)
class LinkSolid:
    """A solid of a link: its surface in its own frame, and that frame in the link's."""

    link: str
    mesh: "trimesh.Trimesh"
    T_link: Float[np.ndarray, "4 4"]


def robot_solids(robot: "Robot") -> dict[str, LinkSolid]:
    """Return the solids and meshes of a robot's collision geometry, by scene path.

    Mesh files that are missing are left out: the robot was given spheres in their place.

    Raises:
        RobotError: a mesh file cannot be read.
    """
    solids = {}
    for link, meshes in robot.meshes.items():
        for number, file in enumerate(meshes):
            if file.path is not None:
                name = f"/robot/solids/{link}/mesh{number}"
                solids[name] = LinkSolid(link, file.mesh(), np.eye(4))
    for link, shapes in robot.geometry.items():
        for number, shape in enumerate(shapes):
            solids[f"/robot/solids/{link}/{number}"] = LinkSolid(
                link, _surface(shape.kind, shape.size), np.asarray(shape.T_link)
            )
    return solids


def _surface(kind: str, size: tuple[float, ...]) -> Any:
    from trimesh import creation

    if kind == "box":
        return creation.box(size)
    if kind == "cylinder":
        return creation.cylinder(radius=size[0], height=size[1], sections=32)
    return creation.icosphere(subdivisions=2, radius=size[0])


def place_solids(
    robot: "Robot", solids: dict[str, LinkSolid], q: Float[np.ndarray, "dof"]
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return the pose of every solid in the world: quaternion wxyz, position (m)."""
    from scipy.spatial.transform import Rotation

    poses = robot.link_poses(q)
    placed = {}
    for name, solid in solids.items():
        T = poses[solid.link] @ solid.T_link
        quaternion = Rotation.from_matrix(T[:3, :3]).as_quat()
        placed[name] = (quaternion[[3, 0, 1, 2]], T[:3, 3])
    return placed
