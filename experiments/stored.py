# SPDX-License-Identifier: BSD-3-Clause
"""Dataclasses that are kept as JSON: tuples as lists and NaN as null, read back exactly."""

import math
from dataclasses import fields
from typing import Any, Self, get_args, get_type_hints


class Stored:
    """A dataclass of numbers, text, tuples of them, and others of its kind."""

    def to_dict(self) -> dict[str, Any]:
        """Return every field, ready for JSON."""
        return {f.name: _plain(getattr(self, f.name)) for f in fields(self)}  # type: ignore[arg-type]

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Self:
        """Rebuild from `to_dict`."""
        hints = get_type_hints(cls)
        return cls(**{name: _rebuilt(value, hints[name]) for name, value in data.items()})


def _plain(value: Any) -> Any:
    if isinstance(value, Stored):
        return value.to_dict()
    if isinstance(value, tuple):
        return [_plain(one) for one in value]
    return None if isinstance(value, float) and math.isnan(value) else value


def _rebuilt(value: Any, hint: Any) -> Any:
    inner = get_args(hint)
    if value is None:
        return math.nan if hint is float else None
    if isinstance(value, list):
        each = inner[:1] * len(value) if inner[-1] is Ellipsis else inner
        return tuple(_rebuilt(one, own) for one, own in zip(value, each, strict=True))
    if isinstance(value, dict):
        return next(kind for kind in (hint, *inner) if hasattr(kind, "from_dict")).from_dict(value)
    return value
