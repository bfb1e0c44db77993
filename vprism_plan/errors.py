# SPDX-License-Identifier: BSD-3-Clause
"""Exceptions for unusable input.

A verdict ("in collision", "no path found") is a result, never an exception. What
is raised here always names the offending value, what would be valid, and the
remedy.
"""


class VPrismError(Exception):
    """Base of everything this package raises on purpose."""


class ObservationError(VPrismError, ValueError):
    """A depth image, label image, intrinsics or pose cannot be used."""


class PlaneNotFoundError(ObservationError):
    """No support plane could be fitted to the observation."""


class ConfigError(VPrismError, ValueError):
    """A configuration value is outside its valid range."""


class MapError(VPrismError, ValueError):
    """A map cannot be fitted, updated, loaded or evaluated with what it was given."""


class WorldError(VPrismError, ValueError):
    """A world cannot be baked from what it was given."""


class RobotError(VPrismError, ValueError):
    """A robot description, or a configuration given for it, cannot be used."""


class PlanningError(VPrismError, ValueError):
    """A planning query is malformed (unknown planner, wrong shape, bad limits)."""


class MissingDependencyError(VPrismError, ImportError):
    """An optional dependency is needed; the message names the extra that brings it."""
