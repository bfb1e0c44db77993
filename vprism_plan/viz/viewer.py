# SPDX-License-Identifier: BSD-3-Clause
"""A map and a robot that moves in it, in the browser (viser; the extra `viewer`)."""

import contextlib
import io
import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from vprism_plan.errors import ConfigError, MissingDependencyError
from vprism_plan.viz._figures import object_color
from vprism_plan.viz._viewer_parts import EntropyVolume, place_solids, robot_solids, to_bytes
from vprism_plan.viz.plan_plot import hand_path

if TYPE_CHECKING:
    from vprism_plan.mapping import VPrismMap
    from vprism_plan.planning import Trajectory
    from vprism_plan.robots import Robot

_POINTS = 20_000  # of an object, drawn at most
_POSES = 300  # of a trajectory
_ROBOT_COLOR = (0.30, 0.42, 0.58)


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
        """
        if trajectory is not None:
            joints = trajectory.positions.shape[1]
            if robot is None or robot.dof != joints:
                what = "no robot is" if robot is None else f"a robot with {robot.dof} joints is"
                raise ConfigError(
                    f"a trajectory of {joints} joints is given, but {what}; give the robot that "
                    "it was planned for"
                )
        self.map, self.robot, self.trajectory = m, robot, trajectory
        self.nodes: dict[str, Any] = {}
        self.controls: dict[str, Any] = {}
        self._resolution = resolution
        self._surfaces: dict[float, dict[int, Any]] = {}
        self._lock = threading.Lock()
        self.server = _start(host, port)
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

    # ------------------------------------------------------------------ what is shown
    def show_level(self, level: float) -> None:
        """Draw the objects' surfaces at another P(occupied)."""
        from vprism_plan.world import extract_meshes

        level = round(float(level), 3)
        with self._lock:
            if level not in self._surfaces:
                self._surfaces[level] = extract_meshes(self.map, level, self._resolution)
            meshes = self._surfaces[level]
            self._remove("/objects/")
            for object_id, mesh in meshes.items():
                self.nodes[f"/objects/{object_id}"] = self.server.scene.add_mesh_simple(
                    f"/objects/{object_id}",
                    np.asarray(mesh.vertices, dtype=np.float32),
                    np.asarray(mesh.faces, dtype=np.uint32),
                    color=to_bytes(object_color(object_id)),
                    side="double",
                    visible=self._wanted("objects"),
                )

    def show_entropy(self, at_least: float) -> None:
        """Draw the points that the map supports and whose entropy (nats) is at least this."""
        points, colors = self._volume.cloud(float(at_least))
        with self._lock:
            self._remove("/entropy/cloud")
            if len(points):
                self.nodes["/entropy/cloud"] = self.server.scene.add_point_cloud(
                    "/entropy/cloud",
                    points,
                    colors,
                    point_size=0.35 * self._resolution,
                    point_shape="circle",
                    visible=self._wanted("entropy cloud"),
                )

    def show_slice(self, height: float) -> None:
        """Draw the entropy on the horizontal slice nearest to a height (m, world)."""
        mesh = self._volume.slice(float(height))
        with self._lock:
            self._remove("/entropy/slice")
            self.nodes["/entropy/slice"] = self.server.scene.add_mesh_trimesh(
                "/entropy/slice",
                mesh,
                cast_shadow=False,
                receive_shadow=False,
                visible=self._wanted("entropy slice"),
            )

    def place_robot(self, q: Float[np.ndarray, "dof"]) -> None:
        """Move the robot to a configuration."""
        assert self.robot is not None
        q = self.robot.check_configuration(q)
        with self._lock, self.server.atomic():
            centers = self.robot.sphere_centers(q[None])[0]
            self.nodes["/robot/spheres"].batched_positions = centers.astype(np.float32)
            for name, (wxyz, position) in place_solids(self.robot, self._solids, q).items():
                self.nodes[name].wxyz, self.nodes[name].position = wxyz, position

    # ------------------------------------------------------------------ building it
    def _fill(self, level: float) -> None:
        scene, gui = self.server.scene, self.server.gui
        scene.set_up_direction("+z")
        self._volume = EntropyVolume(self.map, self._resolution)
        low, high = self._volume.corners
        middle = 0.5 * (low + high)
        scene.add_grid(
            "/table",
            width=2.0,
            height=2.0,
            cell_size=0.1,
            section_size=0.5,
            position=(*middle[:2], self._table_height(middle)),
            plane_color=(235, 232, 225),
            plane_opacity=0.8,
        )
        self._add_views()
        with gui.add_folder("map"):
            self._box("objects", True, "/objects/")
            self._slider("level", 0.05, 0.95, 0.05, round(level, 2), self.show_level)
            self._box("observed points", False, "/points/")
            self._box("cameras", False, "/cameras/")
        with gui.add_folder("entropy"):
            top = float(np.log(self.map.n_classes))
            self._box("entropy cloud", True, "/entropy/cloud")
            self._slider(
                "entropy", 0.0, round(top, 2), 0.01, round(0.3 * top, 2), self.show_entropy
            )
            self._box("entropy slice", False, "/entropy/slice")
            self._slider(
                "height", *self._volume.heights, round(float(middle[2]), 3), self.show_slice
            )
        self.show_level(self.controls["level"].value)
        self.show_entropy(self.controls["entropy"].value)
        self.show_slice(self.controls["height"].value)
        if self.robot is not None:
            self._add_robot()
        eye = self.map.views[0].camera_center
        self.server.initial_camera.position = tuple(middle + 1.5 * (eye - middle))
        self.server.initial_camera.look_at = tuple(middle)

    def _table_height(self, at: Float[np.ndarray, "3"]) -> float:
        plane = self.map.plane
        return float((plane.offset - plane.normal[:2] @ at[:2]) / plane.normal[2])

    def _add_views(self) -> None:
        from scipy.spatial.transform import Rotation

        seen = [view.points() for view in self.map.views]
        for object_id in self.map.object_ids:
            points = np.concatenate([p[labels == object_id] for p, labels in seen])
            self.nodes[f"/points/{object_id}"] = self.server.scene.add_point_cloud(
                f"/points/{object_id}",
                points[:: max(1, len(points) // _POINTS)].astype(np.float32),
                to_bytes(0.6 * object_color(object_id)),
                point_size=0.002,
                visible=False,
            )
        for number, view in enumerate(self.map.views):
            height, width = view.shape
            x, y, z, w = Rotation.from_matrix(view.pose[:3, :3]).as_quat()
            self.nodes[f"/cameras/{number}"] = self.server.scene.add_camera_frustum(
                f"/cameras/{number}",
                fov=2.0 * float(np.arctan(0.5 * height / view.intrinsics[1, 1])),
                aspect=width / height,
                scale=0.08,
                thickness=0.002,
                wxyz=(w, x, y, z),
                position=tuple(view.camera_center),
                image=None if view.color is None else view.color[::4, ::4],
                visible=False,
            )

    def _add_robot(self) -> None:
        import trimesh

        robot, scene = self.robot, self.server.scene
        assert robot is not None
        ball = trimesh.creation.icosphere(subdivisions=2)
        count = len(robot.sphere_radii)
        self.nodes["/robot/spheres"] = scene.add_batched_meshes_simple(
            "/robot/spheres",
            np.asarray(ball.vertices, dtype=np.float32),
            np.asarray(ball.faces, dtype=np.uint32),
            batched_wxyzs=np.tile(np.array([1, 0, 0, 0], dtype=np.float32), (count, 1)),
            batched_positions=np.zeros((count, 3), dtype=np.float32),
            batched_scales=np.asarray(robot.sphere_radii, dtype=np.float32),
            batched_colors=to_bytes(np.array(_ROBOT_COLOR)),
        )
        self._solids = robot_solids(robot)
        for name, solid in self._solids.items():
            self.nodes[name] = scene.add_mesh_simple(
                name,
                np.asarray(solid.mesh.vertices, dtype=np.float32),
                np.asarray(solid.mesh.faces, dtype=np.uint32),
                color=to_bytes(np.array(_ROBOT_COLOR)),
                flat_shading=True,
                visible=False,
            )
        with self.server.gui.add_folder("robot"):
            self._box("spheres", True, "/robot/spheres")
            if self._solids:
                self._box("solids", False, "/robot/solids/")
            if self.trajectory is None:
                self._add_joints(robot)
            else:
                self._add_motion(robot, self.trajectory)

    def _add_joints(self, robot: "Robot") -> None:
        def follow(_: float) -> None:
            self.place_robot(np.array([self.controls[name].value for name in robot.joint_names]))

        for i, name in enumerate(robot.joint_names):
            low, high = float(robot.lower[i]), float(robot.upper[i])
            self._slider(name, low, high, 0.001, float(robot.neutral[i]), follow)
        self.place_robot(robot.neutral)

    def _add_motion(self, robot: "Robot", trajectory: "Trajectory") -> None:
        times = np.linspace(0.0, trajectory.duration, _POSES)
        hand = hand_path(robot, trajectory.sample(times)[0]).astype(np.float32)
        self.nodes["/robot/path"] = self.server.scene.add_line_segments(
            "/robot/path",
            np.stack([hand[:-1], hand[1:]], axis=1),
            (184, 13, 89),
            thickness=0.006,
        )
        self._box("path of the hand", True, "/robot/path")

        def follow(time: float) -> None:
            self.place_robot(trajectory.sample(np.array([time]))[0][0])

        self._slider("time", 0.0, max(trajectory.duration, 0.01), 0.01, 0.0, follow)
        follow(0.0)

    # ------------------------------------------------------------------ controls
    def _slider(
        self, name: str, low: float, high: float, step: float, value: float,
        changed: Callable[[float], None],
    ) -> None:  # fmt: skip
        unit = {"entropy": " at least (nats)", "height": " of the slice (m)", "time": " (s)",
                "level": ": P(occupied)"}.get(name, "")  # fmt: skip
        slider = self.server.gui.add_slider(name + unit, low, high, step, value)
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

    def _wanted(self, box: str) -> bool:
        return bool(self.controls[box].value)

    def _remove(self, prefix: str) -> None:
        for path in [path for path in self.nodes if path.startswith(prefix)]:
            self.nodes.pop(path).remove()


def require_viser() -> None:
    """Say before any long work that viser is missing.

    Raises:
        MissingDependencyError: how to install it.
    """
    try:
        import viser  # noqa: F401
    except ImportError as error:
        raise MissingDependencyError(
            "the viewer needs viser, which is not installed: pip install 'vprism_plan[viewer]'"
        ) from error


def _start(host: str, port: int) -> Any:
    """Return a running server; it takes another port if that one is busy."""
    require_viser()
    import viser

    with _silence():
        return viser.ViserServer(host=host, port=port, label="vprism_plan", verbose=False)


def _silence() -> contextlib.redirect_stdout:
    """Keep viser's banner off the standard output, which belongs to the program."""
    return contextlib.redirect_stdout(io.StringIO())
