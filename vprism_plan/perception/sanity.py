# SPDX-License-Identifier: BSD-3-Clause
"""What is odd about views, once their support plane is known: refused, mended or named."""

from collections.abc import Sequence

from vprism_plan.perception.masks import mend
from vprism_plan.perception.observation import Observation
from vprism_plan.perception.plane import Plane
from vprism_plan.perception.several_views import agree


def examine(
    views: Sequence[Observation], plane: Plane, earlier: Sequence[Observation] = ()
) -> tuple[tuple[Observation, ...], tuple[str, ...]]:
    """Return views fit for use, and what was odd about them.

    Run once for every view that a map learns from, after its support plane is known.

    Args:
        views: posed as the map will have them.
        plane: support surface, world frame.
        earlier: views of the same scene that went through this before.

    Returns:
        The views, mended where that was possible, and one sentence for each finding: what is
        odd, by how much, and the remedy.

    Raises:
        ObservationError: a view that cannot be right.
    """
    views = agree(mend(views, plane, len(earlier)), earlier)
    found = [text for view in views for text in view.warnings]
    return tuple(views), tuple(dict.fromkeys(found))
