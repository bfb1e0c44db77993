# SPDX-License-Identifier: BSD-3-Clause
"""What a person sees: pictures of the input, the map and the plan."""

from vprism_plan.viz._figures import object_color, save_figure
from vprism_plan.viz.map_plot import map_figure, scene_figure
from vprism_plan.viz.plan_plot import hand_path, plan_figure, resample
from vprism_plan.viz.risk_plot import margin_figure, risk_figure
from vprism_plan.viz.robot_plot import robot_figure
from vprism_plan.viz.trajopt_plot import trajopt_figure

__all__ = [
    "hand_path",
    "map_figure",
    "margin_figure",
    "object_color",
    "plan_figure",
    "resample",
    "risk_figure",
    "robot_figure",
    "save_figure",
    "scene_figure",
    "trajopt_figure",
]
