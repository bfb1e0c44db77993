# SPDX-License-Identifier: BSD-3-Clause
"""
Our clearance as a constraint in Drake
======================================

A mathematical program looks for the posture nearest to a wanted one that keeps a distance to
everything that may be occupied. SNOPT gets our clearance and its gradient, link by link. ::

    python examples/peers/drake_constraint.py [--map MAP.safetensors]   # pip install drake
"""

import argparse
from pathlib import Path

import numpy as np
from pydrake.autodiffutils import ExtractGradient, ExtractValue, InitializeAutoDiff
from pydrake.solvers import MathematicalProgram, SnoptSolver

import vprism_plan as vp

DATA = Path(vp.__file__).parent / "data"
BASE = np.array([[0, -1, 0, 0.05], [1, 0, 0, -0.6], [0, 0, 1, 0], [0, 0, 0, 1.0]])
WANTED = np.array([0.05, 0.75, 0.0, -1.6, 0.0, 2.4, 0.785])  # in an object
KEEP = 0.02  # metres

parser = argparse.ArgumentParser(description="Drake with our clearance as a constraint.")
parser.add_argument("--map", type=Path, help="a saved map instead of the bundled view")
saved = parser.parse_args().map
m = vp.load_map(saved) if saved else vp.fit_map(vp.load_observation(DATA / "demo_scene"))
robot = vp.Robot.from_urdf(DATA / "urdf" / "panda.urdf", base_pose=BASE)
checker = vp.CollisionChecker(vp.World(m), robot)
print(f"wanted: {1000 * checker.clearance(WANTED):.1f} mm; {checker.explain(WANTED).text()}")


# %%
# The nearest pair alone would change from step to step: the smallest of all, softly, does not.
def soft_clearance(q: np.ndarray) -> np.ndarray:
    """Metres, at most the smallest clearance; with its gradient if Drake asks for it."""
    values = ExtractValue(q).ravel() if q.dtype == object else q
    pairs = checker.safety_margin(values).margins
    gaps, slopes = np.array([p.clearance for p in pairs]), np.array([p.gradient for p in pairs])
    weights = np.exp(-(gaps - gaps.min()) / 0.002)
    soft = np.array([gaps.min() - 0.002 * np.log(weights.sum())])
    if q.dtype != object:
        return soft
    slope = (weights / weights.sum()) @ slopes
    return InitializeAutoDiff(soft, (slope @ ExtractGradient(q))[None])


program = MathematicalProgram()
q = program.NewContinuousVariables(robot.dof, "q")
program.AddBoundingBoxConstraint(robot.lower, robot.upper, q)
program.AddQuadraticErrorCost(np.eye(robot.dof), WANTED, q)
program.AddConstraint(soft_clearance, lb=[KEEP], ub=[np.inf], vars=q)
result = SnoptSolver().Solve(program, WANTED + 0.05, None)
found = result.GetSolution(q)
print(f"Drake: {result.get_solution_result().name}, {np.linalg.norm(found - WANTED):.2f} rad away")
print(f"found: {1000 * checker.clearance(found):.1f} mm, valid: {checker.is_valid(found)}")
