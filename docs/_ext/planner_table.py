# SPDX-License-Identifier: BSD-3-Clause
"""The directive `planner-table`: what `vprism_plan.planning.planners()` says of each planner."""

from docutils import nodes
from docutils.parsers.rst import Directive
from docutils.statemachine import StringList
from sphinx.application import Sphinx

_COLUMNS = {
    "optimises": "optimising",
    "heeds an objective": "honours_objective",
    "informed": "informed",
    "step length": "has_range",
}


class PlannerTable(Directive):
    """A row for every planner, as the code has it."""

    def run(self) -> list[nodes.Node]:
        """Return the table."""
        from vprism_plan.planning import planners

        header = ["planner", *_COLUMNS, "note"]
        rows = [header, ["---"] * len(header)]
        for name, kind in planners().items():
            marks = ["yes" if getattr(kind, field) else "" for field in _COLUMNS.values()]
            rows.append([f"`{name}`", *marks, kind.note])
        lines = [f"| {' | '.join(row)} |" for row in rows]  # the pages are Markdown
        holder = nodes.Element()
        self.state.nested_parse(StringList(lines, "planners"), 0, holder)
        return holder.children


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the directive."""
    app.add_directive("planner-table", PlannerTable)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
