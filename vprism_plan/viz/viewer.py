# SPDX-License-Identifier: BSD-3-Clause
"""What was seen, the map of it, a motion and its risk, and where to look next, in the browser
(viser; the extra `viewer`)."""

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
    from vprism_plan.collision import CollisionChecker
    from vprism_plan.mapping import VPrismMap
    from vprism_plan.planning import NextView, Trajectory
    from vprism_plan.robots import Robot

_POINTS = 20_000  # of a view, drawn at most
_POSES = 300  # of a trajectory
_ROBOT_COLOR, _PATH_COLOR, _NEXT_COLOR = (76, 107, 148), (184, 13, 89), (20, 130, 60)
_RED = 0.1  # probability of collision at most that is red
_CHUNK = 1 << 16
_SUPPORTED = 0.5  # of the largest kernel mass: the rim of the lattice has less
_MOST = 2_000_000  # grid points; a coarser grid is taken above


def entropy_cloud(
    m: "VPrismMap", resolution: float
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
    """Return points on a grid (m) that a map supports, and its entropy there (nats).

    Elsewhere it repeats its prior. The grid is coarser than `resolution` (m) where that would be
    more than `_MOST` points.
    """
    lower, upper = m.support_bounds()
    count = float(np.prod((upper - lower) / resolution))
    resolution *= max(1.0, (count / _MOST) ** (1 / 3))
    axes = [np.arange(lower[k], upper[k], resolution) for k in range(3)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    mass = _in_chunks(m.support, points)
    points = points[mass > _SUPPORTED * mass.max()]
    return points, _in_chunks(m.entropy, points)


def _in_chunks(function: Callable[[Any], Any], points: np.ndarray) -> np.ndarray:
    chunks = np.array_split(points, len(points) // _CHUNK + 1)
    return np.concatenate([function(chunk) for chunk in chunks])


class Viewer:
    """A server that shows a map, a robot in it and where to look next; it runs until `stop`.

    Attributes:
        server: the `viser.ViserServer`.
        nodes: what is in the scene, by its path in the scene's tree: "/objects/3",
            "/points/0/seen" and "/cameras/0" of view 0, "/entropy/cloud", "/robot/spheres",
            "/robot/solids/LINK/0" (or "mesh0"), "/robot/path", "/next/view", "/next/others"; the
            table is not among them.
        controls: sliders and boxes by name: "level", "entropy", "time" with a trajectory, else the
            names of the joints; and one box for every group of nodes.
        risk: the `RiskEstimate` along the trajectory, by worlds that its search has not seen;
            None without a checker.
    """

    def __init__(
        self,
        m: "VPrismMap",
        robot: "Robot | None" = None,
        trajectory: "Trajectory | None" = None,
        *,
        checker: "CollisionChecker | None" = None,
        look: "NextView | None" = None,
        level: float = 0.5,
        resolution: float = 0.01,
        host: str = "127.0.0.1",
        port: int = 8080,
    ) -> None:
        """Start the server and fill the scene.

        Args:
            m: a fitted map in a frame with z up.
            robot: shown with its spheres and solids, where its base stands; the checker's if None.
            trajectory: of that robot; if None that of the plan in `look`, without any its joints
                can be moved by hand.
            checker: over a `World` of this map: colours the path by its probability of collision.
            look: what `next_view` said of this map: the views it was asked about, and the best.
            level: P(occupied) at the surfaces of the objects.
            resolution: edge of the grids of surfaces and entropy, metres.
            host: address to listen at; "0.0.0.0" lets other machines connect.
            port: to listen at; a free one near it is taken if it is busy, 0 is any.

        Raises:
            MissingDependencyError: viser is not installed.
            ConfigError: a trajectory without a robot, or of another one.
            MapError: the map has no objects.
        """
        if robot is None and checker is not None:
            robot = checker.robot
        if trajectory is None and robot is not None and look is not None:
            from vprism_plan.planning import time_parameterize

            path = look.plan.path if look.plan.path is not None else look.plan.approximate_path
            trajectory = None if path is None else time_parameterize(robot, path)
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
        self.risk: Any = None
        self._checker, self._look = checker, look
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
        points, nats = self._cloud
        chosen = nats >= at_least
        with self._lock:
            style = self._cleared("/entropy/cloud", "entropy cloud") | {"point_shape": "circle"}
            if chosen.any():
                style["point_size"] = 0.35 * self._resolution
                colors = _shades("magma", nats[chosen] / np.log(self.map.n_classes))
                cloud = points[chosen].astype(np.float32)
                self._add("point_cloud", "/entropy/cloud", cloud, colors, **style)

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
        scene, gui, plane = self.server.scene, self.server.gui, self.map.plane
        gui.main_panel.dock_right()
        scene.set_up_direction("+z")
        self._cloud = entropy_cloud(self.map, self._resolution)
        middle = 0.5 * (self._cloud[0].min(axis=0) + self._cloud[0].max(axis=0))
        table = float((plane.offset - plane.normal[:2] @ middle[:2]) / plane.normal[2])
        size: dict[str, Any] = {"width": 2.0, "height": 2.0, "cell_size": 0.1, "section_size": 0.5}
        style: dict[str, Any] = {"plane_color": (235, 232, 225), "plane_opacity": 0.8}
        scene.add_grid("/table", position=(*middle[:2], table), **size, **style)
        with gui.add_folder("what was seen"):
            self._add_views()
        with gui.add_folder("what the map believes"):
            self._box("objects", True, "/objects/")
            bounds = (0.05, 0.95, 0.05, round(level, 2))
            self._slider("level", "P(occupied)", self.show_level, *bounds)
            self._box("entropy cloud", True, "/entropy/cloud")
            top = float(np.log(self.map.n_classes))
            bounds = (0.0, round(top, 2), 0.01, round(0.3 * top, 2))
            self._slider("entropy", "at least (nats)", self.show_entropy, *bounds)
        self.show_level(self.controls["level"].value)
        self.show_entropy(self.controls["entropy"].value)
        if self.robot is not None:
            self._add_robot(self.robot)
        if self._look is not None:
            self._add_look(self._look)
        x, y, z = self.map.views[0].camera_center - middle
        # From beside the first camera, which would stand before what it saw.
        eye = middle + 1.35 * np.array([0.6 * x + 0.8 * y, 0.6 * y - 0.8 * x, 1.4 * z])
        self.server.initial_camera.position = tuple(eye)
        self.server.initial_camera.look_at = tuple(middle)

    def _add_views(self) -> None:
        self._box("cameras", True, "/cameras/")
        for number, view in enumerate(self.map.views):
            points, labels = view.points()
            rows = np.flatnonzero(labels > 0)
            rows = rows[:: len(rows) // _POINTS + 1]
            shades = [_bytes(0.6 * object_color(i)) for i in labels[rows].tolist()]
            cloud = points[rows].astype(np.float32), np.array(shades, np.uint8)
            style = {"point_size": 0.002, "visible": number == 0}
            if len(rows):  # browsers complain of clouds without points
                self._add("point_cloud", f"/points/{number}/seen", *cloud, **style)
            self._box(f"view {number}", number == 0, f"/points/{number}/")
            picture = None if view.color is None else view.color[::4, ::4]
            path, camera = f"/cameras/{number}", (view.intrinsics, view.shape)
            self._add_camera(path, view.pose, camera, image=picture, color=(20, 20, 20))

    def _add_camera(
        self, path: str, pose: np.ndarray, camera: tuple[np.ndarray, tuple[int, int]], **style: Any
    ) -> None:
        """A frustum; its camera is given by intrinsics and (height, width), pixels."""
        K, (height, width) = camera
        style |= {"fov": 2.0 * float(np.arctan(0.5 * height / K[1, 1])), "aspect": width / height}
        style |= {"wxyz": _quaternion(pose), "position": tuple(pose[:3, 3])}
        self._add("camera_frustum", path, scale=0.12, thickness=0.003, **style)

    def _add_look(self, look: "NextView") -> None:
        """The views that were asked about, the better the brighter, and the best of them."""
        with self.server.gui.add_folder("where to look next"):
            self._box("next view", True, "/next/")
            dots = ". Dots: all views, the better the brighter." if look.values else ""
            self.server.gui.add_markdown(look.text() + dots)
        if look.values:
            worth = np.array([value.utility for value in look.values])
            style = {"point_size": 0.003, "point_shape": "circle"}
            places = look.views[:, :3, 3].astype(np.float32)
            colors = _shades("viridis", worth / max(float(worth.max()), 1e-9))
            self._add("point_cloud", "/next/others", places, colors, **style)
        if look.best is not None:
            camera, pose = (look.intrinsics, look.shape), look.views[look.best]
            self._add_camera("/next/view", pose, camera, color=_NEXT_COLOR, variant="filled")

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
        poses = trajectory.sample(times)[0]
        hand = hand_path(robot, poses).astype(np.float32)
        colors = np.full((_POSES, 3), _PATH_COLOR, np.uint8)
        if self._checker is not None:
            self.risk = self._checker.collision_probability(poses, held_out=True)
            top = max(float(self.risk.per_waypoint.max()), _RED)
            colors = _shades("turbo", 0.07 + 0.83 * self.risk.per_waypoint / top)
            self.server.gui.add_markdown(f"{self.risk.text()}. Blue: 0, red: {top:.2f}.")
        pieces, shades = (np.stack([a[:-1], a[1:]], axis=1) for a in (hand, colors))
        self._add("line_segments", "/robot/path", pieces, shades, thickness=0.008)
        self._box("path of the hand", True, "/robot/path")
        here = self.server.gui.add_markdown("", visible=self.risk is not None)

        def follow(time: float) -> None:
            self.place_robot(trajectory.sample(np.array([time]))[0][0])
            if self.risk is not None:
                row = int(np.abs(times - time).argmin())
                here.content = f"P(collision) here: **{self.risk.per_waypoint[row]:.2f}**"
                self.nodes["/robot/spheres"].batched_colors = colors[row]

        end = round(trajectory.duration + 0.005, 2)
        self._slider("time", "time (s)", follow, 0.0, end, 0.01, 0.0)
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


def _shades(name: str, values: Float[np.ndarray, " n"]) -> UInt8[np.ndarray, "n 3"]:
    """The colours that one of matplotlib's maps gives to values in 0..1."""
    from matplotlib import colormaps

    return np.asarray(colormaps[name](values, bytes=True)[:, :3], dtype=np.uint8)


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
