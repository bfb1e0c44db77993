# SPDX-License-Identifier: BSD-3-Clause
"""Does it get safer? The same planner with different maps, judged by the true scene."""

from experiments.planning_benchmark.asking import Answer, Limits
from experiments.planning_benchmark.contenders import CONTENDERS, Contender, contenders
from experiments.planning_benchmark.problems import Criteria, Problem, find_problems
from experiments.planning_benchmark.run import Found, run
from experiments.planning_benchmark.truth import PathTruth, Truth

__all__ = [
    "CONTENDERS",
    "Answer",
    "Contender",
    "Criteria",
    "Found",
    "Limits",
    "PathTruth",
    "Problem",
    "Truth",
    "contenders",
    "find_problems",
    "run",
]
