# SPDX-License-Identifier: BSD-3-Clause
"""Every source of obstacles there is: what it is called, marked, drawn and explained as."""

from dataclasses import dataclass
from typing import Any, Literal

SourceKind = Literal["object", "background", "occluded", "unobserved", "support", "known"]
SUPPORT = "support surface"


@dataclass(frozen=True)
class Source:
    """What a kind of obstacle is called, and how it is told and drawn."""

    kind: SourceKind  # as in `Contact.kind`
    spoken: str = ""  # what a sentence calls it; empty for its own name
    # red, green and blue in pictures; objects have one each
    color: tuple[float, float, float] | None = None
    line: str = "-"  # style of its curves
    # on the lattice of what no object of the map accounts for, 0 for none. Where several apply
    # the largest wins
    mark: int = 0
    # field of `WorldConfig` that says whether it is an obstacle; empty: it always is
    policy: str = ""
    judged: bool = True  # whether the map has a say in it
    why: str = ""  # sentence that explains a contact; `{policy}` is what the policy says
    beyond: str = ""  # why the field refuses what meshes accept there

    def reason(self, config: Any) -> str:
        """Return why it is an obstacle by a `WorldConfig`; empty where its name says so."""
        policy = getattr(config, self.policy, "")
        if self.kind == "unobserved" and policy == "free":
            return "farther away than was judged; WorldConfig(bounds=...) can take it in"
        return self.why.format(policy=policy)


# By their names, in the order of `World.sources`; objects and known geometry by what stands
# before the colon in theirs. Greys and blues that no object has are told apart by the line.
SOURCES: dict[str, Source] = {
    "object": Source("object"),
    "background": Source(
        "background", "unlabelled clutter", (0.45, 0.45, 0.45), "--", 3,
        why="observed points without an object label",
        beyond="its cells reach farther than the points of the unlabelled clutter",
    ),
    "occluded": Source(
        "occluded", "occluded space", (0.10, 0.10, 0.10), ":", 2, "occluded",
        why="no camera saw this space; policy occluded={policy!r}",
        beyond="no camera saw it, and meshes touch nothing that they ask about",
    ),
    "unobserved": Source(
        "unobserved", "unobserved space", (0.10, 0.10, 0.10), "-.", 1, "unobserved",
        why="no camera looked here; policy unobserved={policy!r}",
        beyond="no camera looked there, and meshes touch nothing that they ask about",
    ),
    SUPPORT: Source("support", "the support surface", (0.35, 0.25, 0.15), judged=False),
    "known": Source("known", "", (0.15, 0.35, 0.55), "--", judged=False),
}  # fmt: skip
MARKED = {name: source.mark for name, source in SOURCES.items() if source.mark}
# The mark of a seen surface of class k is this plus k.
LAST_MARK = max(MARKED.values())


def source_of(name: str) -> Source:
    """Return what the name of an obstacle ("occluded", "object:3", "known:NAME") stands for."""
    return SOURCES.get(name) or SOURCES.get(name.split(":", 1)[0]) or SOURCES["known"]


def spoken(name: str) -> str:
    """Return what a sentence calls a body: what is no thing by more than its name."""
    return SOURCES[name].spoken or name if name in SOURCES else name


def object_id(name: str) -> int | None:
    """Return the object that "object:3" names; None if it names none."""
    return int(name.split(":", 1)[1]) if name.startswith("object:") else None


def policies(config: Any) -> dict[str, str]:
    """Return what a `WorldConfig` does with each kind of space that it has a policy for."""
    return {s.policy: getattr(config, s.policy) for s in SOURCES.values() if s.policy}
