# SPDX-License-Identifier: BSD-3-Clause
"""A map and a robot that moves in it, in the browser (viser; the extra `viewer`)."""

import contextlib
import io
import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, UInt8

from vprism_plan._files import optional
from vprism_plan.errors import ConfigError, MapError
from vprism_plan.viz._figures import object_color
from vprism_plan.viz.plan_plot import hand_path
from vprism_plan.viz.robot_plot import link_meshes

if TYPE_CHECKING:
    import trimesh

    from vprism_plan.mapping import VPrismMap
    from vprism_plan.planning import Trajectory
    from vprism_plan.robots import Robot

_POINTS = 20_000  # of an object, drawn at most
_POSES = 300  # of a trajectory
_ROBOT_COLOR = (76, 107, 148)
_CHUNK = 1 << 16
_SUPPORTED = 0.5  # of the largest kernel mass: the rim of the lattice has less
_MOST = 2_000_000  # grid points; a coarser grid is taken above


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
        chunks = [points[i : i + _CHUNK] for i in range(0, len(points), _CHUNK)]
        values = np.concatenate([m.entropy(chunk) for chunk in chunks])
        mass = np.concatenate([m.support(chunk) for chunk in chunks])
        supported = mass > _SUPPORTED * mass.max()
        self.values: np.ndarray = np.where(supported, values, np.nan).reshape(grid.shape[:3])
        self._grid, self._top, z = grid, float(np.log(m.n_classes)), self._axes[2]
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
        faces = corner[:, None] + np.array([[[0, ny, ny + 1]], [[0, ny + 1, 1]]])
        faces = faces.reshape(-1, 3)
        faces = np.concatenate([faces, faces[:, ::-1]])  # seen from below as well
        colors = self._colors(self.values[:, :, layer].reshape(-1))
        colors = np.column_stack([colors, np.full(len(colors), 255, np.uint8)])
        points = self._grid[:, :, layer].reshape(-1, 3)
        return trimesh.Trimesh(points, faces, vertex_colors=colors, process=False)

    def _colors(self, nats: Float[np.ndarray, " n"]) -> UInt8[np.ndarray, "n 3"]:
        from matplotlib import colormaps

        shades = colormaps["magma"](np.nan_to_num(nats / self._top), bytes=True)[:, :3]
        shades[np.isnan(nats)] = 200
        return np.asarray(shades, dtype=np.uint8)


class Viewer:
    """A server that shows a map, and a robot in it; it runs until `stop`.

    Attributes:
        server: the `viser.ViserServer`.
        nodes: what is in the scene, by its path in the scene's tree: "/objects/3",
            "/points/3", "/cameras/0", "/entropy/cloud", "/entropy/slice", "/robot/spheres",
            "/robot/solids/LINK/0" (or "mesh0"), "/robot/path"; the table is not among them.
        controls: sliders and boxes by name: "level", "entropy", "height", "time" with a
            trajectory, else the names of the joints; and one box for every group of nodes.
    """

    def __init__(
        self,
        m: "VPrismMap",
        robot: "Robot | None" = None,
        trajectory: "Trajectory | None" = None,
        *,
        level: float = 0.5,
        resolution: float = 0.01,
        host: str = "127.0.0.1",
        port: int = 8080,
    ) -> None:
        """Start the server and fill the scene.

        Args:
            m: a fitted map in a frame with z up.
            robot: shown with its spheres and solids, where its base stands.
            trajectory: of that robot; without one its joints can be moved by hand.
            level: P(occupied) at the surfaces of the objects.
            resolution: edge of the grids of surfaces and entropy, metres.
            host: address to listen at; "0.0.0.0" lets other machines connect.
            port: to listen at; a free one near it is taken if it is busy, 0 is any.

        Raises:
            MissingDependencyError: viser is not installed.
            ConfigError: a trajectory without a robot, or of another one.
            MapError: the map has no objects.
        """
        if not m.object_ids:
            raise MapError("the map has no objects: there are no surfaces and no entropy to show")
        if trajectory is not None:
            joints = trajectory.positions.shape[1]
            if robot is None or robot.dof != joints:
                what = "no robot is" if robot is None else f"a robot with {robot.dof} joints is"
                raise ConfigError(
                    f"a trajectory of {joints} joints is given, but {what}; give the robot that "
                    "it was planned for"
                )
        require_viser()
        import viser

        self.map, self.robot, self.trajectory, self._resolution = m, robot, trajectory, resolution
        self.nodes: dict[str, Any] = {}
        self.controls: dict[str, Any] = {}
        self._surfaces: dict[float, dict[int, Any]] = {}
        self._lock = threading.Lock()
        with _silence():
            self.server = viser.ViserServer(host, port, label="vprism_plan", verbose=False)
        try:
            self._fill(level)
        except BaseException:
            self.server.stop()
            raise

    @property
    def url(self) -> str:
        """Where a browser on this machine finds it."""
        host = self.server.get_host()
        return f"http://{'localhost' if host == '0.0.0.0' else host}:{self.server.get_port()}"

    def wait(self) -> None:
        """Serve until the process is interrupted."""
        threading.Event().wait()

    def stop(self) -> None:
        """End the server; browsers lose their connection."""
        with _silence():
            self.server.stop()

    def show_level(self, level: float) -> None:
        """Draw the objects' surfaces at another P(occupied)."""
        from vprism_plan.world import extract_meshes

        level = round(float(level), 3)
        with self._lock:
            if level not in self._surfaces:
                self._surfaces[level] = extract_meshes(self.map, level, self._resolution)
            style = self._cleared("/objects/", "objects") | {"side": "double"}
            for object_id, mesh in self._surfaces[level].items():
                color, path = _bytes(object_color(object_id)), f"/objects/{object_id}"
                self._add("mesh_simple", path, *_arrays(mesh), color=color, **style)

    def show_entropy(self, at_least: float) -> None:
        """Draw the points that the map supports and whose entropy (nats) is at least this."""
        points, colors = self._volume.cloud(float(at_least))
        with self._lock:
            style = self._cleared("/entropy/cloud", "entropy cloud") | {"point_shape": "circle"}
            if len(points):
                style["point_size"] = 0.35 * self._resolution
                self._add("point_cloud", "/entropy/cloud", points, colors, **style)

    def show_slice(self, height: float) -> None:
        """Draw the entropy on the horizontal slice nearest to a height (m, world)."""
        mesh = self._volume.slice(float(height))
        with self._lock:
            style = self._cleared("/entropy/slice", "entropy slice")
            style |= {"cast_shadow": False, "receive_shadow": False}
            self._add("mesh_trimesh", "/entropy/slice", mesh, **style)

    def place_robot(self, q: Float[np.ndarray, "dof"]) -> None:
        """Move the robot to a configuration."""
        assert self.robot is not None
        q = self.robot.check_configuration(q)
        poses = self.robot.link_poses(q)
        with self._lock, self.server.atomic():
            centers = self.robot.sphere_centers(q[None])[0]
            self.nodes["/robot/spheres"].batched_positions = centers.astype(np.float32)
            for path, link in self._solids.items():
                node, pose = self.nodes[path], poses[link]
                node.wxyz, node.position = _quaternion(pose), pose[:3, 3]

    def _fill(self, level: float) -> None:
        scene, gui = self.server.scene, self.server.gui
        scene.set_up_direction("+z")
        self._volume = EntropyVolume(self.map, self._resolution)
        middle = 0.5 * self._volume.corners.sum(axis=0)
        plane = self.map.plane
        table = float((plane.offset - plane.normal[:2] @ middle[:2]) / plane.normal[2])
        size: dict[str, Any] = {"width": 2.0, "height": 2.0, "cell_size": 0.1, "section_size": 0.5}
        style: dict[str, Any] = {"plane_color": (235, 232, 225), "plane_opacity": 0.8}
        scene.add_grid("/table", position=(*middle[:2], table), **size, **style)
        self._add_views()
        with gui.add_folder("map"):
            self._box("objects", True, "/objects/")
            bounds = (0.05, 0.95, 0.05, round(level, 2))
            self._slider("level", "level: P(occupied)", self.show_level, *bounds)
            self._box("observed points", False, "/points/")
            self._box("cameras", False, "/cameras/")
        with gui.add_folder("entropy"):
            top = float(np.log(self.map.n_classes))
            bounds = (0.0, round(top, 2), 0.01, round(0.3 * top, 2))
            self._box("entropy cloud", True, "/entropy/cloud")
            self._slider("entropy", "entropy at least (nats)", self.show_entropy, *bounds)
            self._box("entropy slice", False, "/entropy/slice")
            bounds = (*self._volume.heights, round(float(middle[2]), 3))
            self._slider("height", "height of the slice (m)", self.show_slice, *bounds)
        self.show_level(self.controls["level"].value)
        self.show_entropy(self.controls["entropy"].value)
        self.show_slice(self.controls["height"].value)
        if self.robot is not None:
            self._add_robot(self.robot)
        eye = self.map.views[0].camera_center
        self.server.initial_camera.position = tuple(middle + 1.5 * (eye - middle))
        self.server.initial_camera.look_at = tuple(middle)

    def _add_views(self) -> None:
        seen = [view.points() for view in self.map.views]
        for object_id in self.map.object_ids:
            points = np.concatenate([p[labels == object_id] for p, labels in seen])
            points = points[:: max(1, len(points) // _POINTS)].astype(np.float32)
            color, path = _bytes(0.6 * object_color(object_id)), f"/points/{object_id}"
            self._add("point_cloud", path, points, color, point_size=0.002, visible=False)
        for number, view in enumerate(self.map.views):
            height, width = view.shape
            self._add(
                "camera_frustum",
                f"/cameras/{number}",
                fov=2.0 * float(np.arctan(0.5 * height / view.intrinsics[1, 1])),
                aspect=width / height,
                scale=0.08,
                thickness=0.002,
                wxyz=_quaternion(view.pose),
                position=tuple(view.camera_center),
                image=None if view.color is None else view.color[::4, ::4],
                visible=False,
            )

    def _add_robot(self, robot: "Robot") -> None:
        import trimesh

        count = len(robot.sphere_radii)
        self._add(
            "batched_meshes_simple",
            "/robot/spheres",
            *_arrays(trimesh.creation.icosphere(subdivisions=2)),
            batched_wxyzs=np.tile(np.array([1, 0, 0, 0], dtype=np.float32), (count, 1)),
            batched_positions=np.zeros((count, 3), dtype=np.float32),
            batched_scales=np.asarray(robot.sphere_radii, dtype=np.float32),
            batched_colors=_ROBOT_COLOR,
        )
        self._solids = {}  # path -> link
        style = {"color": _ROBOT_COLOR, "flat_shading": True, "visible": False}
        for link, number, mesh in link_meshes(robot.meshes, robot.geometry):
            path = f"/robot/solids/{link}/{number}"
            self._solids[path] = link
            self._add("mesh_simple", path, *_arrays(mesh), **style)
        with self.server.gui.add_folder("robot"):
            self._box("spheres", True, "/robot/spheres")
            if self._solids:
                self._box("solids", False, "/robot/solids/")
            if self.trajectory is not None:
                self._add_motion(robot, self.trajectory)
                return
            bounds = np.stack([robot.lower, robot.upper, robot.neutral], axis=1).tolist()
            for name, (low, high, value) in zip(robot.joint_names, bounds, strict=True):
                self._slider(name, name, self._follow_joints, low, high, 0.001, value)
            self.place_robot(robot.neutral)

    def _follow_joints(self, _: float) -> None:
        assert self.robot is not None
        names = self.robot.joint_names
        self.place_robot(np.array([self.controls[name].value for name in names]))

    def _add_motion(self, robot: "Robot", trajectory: "Trajectory") -> None:
        times = np.linspace(0.0, trajectory.duration, _POSES)
        hand = hand_path(robot, trajectory.sample(times)[0]).astype(np.float32)
        pieces = np.stack([hand[:-1], hand[1:]], axis=1)
        self._add("line_segments", "/robot/path", pieces, (184, 13, 89), thickness=0.006)
        self._box("path of the hand", True, "/robot/path")

        def follow(time: float) -> None:
            self.place_robot(trajectory.sample(np.array([time]))[0][0])

        self._slider("time", "time (s)", follow, 0.0, max(trajectory.duration, 0.01), 0.01, 0.0)
        follow(0.0)

    def _add(self, kind: str, path: str, *content: Any, **style: Any) -> None:
        self.nodes[path] = getattr(self.server.scene, f"add_{kind}")(path, *content, **style)

    def _cleared(self, prefix: str, box: str) -> dict[str, Any]:
        """Remove nodes; return whether those that take their place are visible, as a style."""
        for path in [path for path in self.nodes if path.startswith(prefix)]:
            self.nodes.pop(path).remove()
        return {"visible": self.controls[box].value}

    def _slider(
        self, name: str, text: str, changed: Callable[[float], None], *bounds: float
    ) -> None:
        """Bounds: lowest and highest value, step, value to begin with."""
        slider = self.server.gui.add_slider(text, *bounds)
        slider.on_update(lambda event: changed(float(slider.value)))
        self.controls[name] = slider

    def _box(self, name: str, shown: bool, nodes: str) -> None:
        box = self.server.gui.add_checkbox(name, shown)

        def switch(_: Any) -> None:
            with self._lock:
                for path, node in self.nodes.items():
                    if path.startswith(nodes):
                        node.visible = box.value

        box.on_update(switch)
        self.controls[name] = box


def _bytes(color: Float[np.ndarray, "3"]) -> tuple[int, ...]:
    return tuple(round(255 * float(c)) for c in np.clip(color, 0.0, 1.0))


def _arrays(mesh: Any) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces as viser wants them."""
    return np.asarray(mesh.vertices, dtype=np.float32), np.asarray(mesh.faces, dtype=np.uint32)


def _quaternion(pose: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4"]:
    """The rotation of a pose, scalar first."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(pose[:3, :3]).as_quat(scalar_first=True))


def require_viser() -> None:
    """Say before any long work that viser is missing.

    Raises:
        MissingDependencyError: how to install it.
    """
    optional("viser", "viewer", "the viewer needs")


def _silence() -> contextlib.redirect_stdout:
    """Keep viser's banner off the standard output, which belongs to the program."""
    return contextlib.redirect_stdout(io.StringIO())
