"""The screen in the configuration: its pose, and its face's departure from a plane."""

from typing import Annotated

import numpy as np
from pydantic import Field, model_validator

from firmware_iface.settings import Section

Vector3 = tuple[float, float, float]
Axis = Annotated[tuple[float, ...], Field(min_length=2, max_length=500)]

_EVEN = 1e-6  # of the node spacing: rounding of written decimals
_SQUARE = 1e-6  # of two unit vectors: rounding to seven digits


class HeightMapConfig(Section):
    """Heights of the face towards the mirror at the nodes of an even grid, interpolated by a bicubic spline.

    `heights_mm[r][c]` belongs to `s_y_mm[r]` and `s_x_mm[c]`. With three nodes along an axis the spline is quadratic
    there, with two linear. In TOML, `file` may replace `heights_mm`: a text file of numbers, one row per line.
    """

    s_x_mm: Axis
    s_y_mm: Axis
    heights_mm: tuple[Axis, ...]

    @model_validator(mode="after")
    def _grid(self) -> "HeightMapConfig":
        for name, axis in (("s_x_mm", self.s_x_mm), ("s_y_mm", self.s_y_mm)):
            steps = np.diff(axis)
            if not (steps[0] > 0 and np.ptp(steps) <= _EVEN * steps[0]):
                raise ValueError(f"{name} must rise in even steps")
        rows, columns = len(self.s_y_mm), len(self.s_x_mm)
        if len(self.heights_mm) != rows or any(len(row) != columns for row in self.heights_mm):
            shape = f"{len(self.heights_mm)} rows of {', '.join(sorted({str(len(row)) for row in self.heights_mm}))}"
            raise ValueError(f"heights_mm has {shape} numbers; s_y_mm and s_x_mm require {rows} rows of {columns}")
        if np.abs(self.heights_mm).max() > 100:  # no screen is that crooked: micrometres taken for millimetres?
            raise ValueError("heights_mm has a height beyond 100 mm")
        return self


class ScreenPoseConfig(Section):
    """Any screen pose (O' in world, unit vectors `s_x` and `s_y`) and its face; both may be omitted.

    The face departs from the plane along s_x x s_y, towards the mirror, by the bow (a paraboloid, given by its
    height 200 mm from O') plus the height map.
    """

    origin_mm: Vector3 | None = None
    s_x: Vector3 | None = None
    s_y: Vector3 | None = None
    bow_mm: Annotated[float, Field(ge=-100, le=100)] = 0.0
    height_map: HeightMapConfig | None = None

    @property
    def pose(self) -> tuple[Vector3, Vector3, Vector3] | None:
        """Origin, s_x and s_y; None if the short form is used."""
        if self.origin_mm is None or self.s_x is None or self.s_y is None:
            return None
        return self.origin_mm, self.s_x, self.s_y

    @model_validator(mode="after")
    def _whole(self) -> "ScreenPoseConfig":
        given = [value is not None for value in (self.origin_mm, self.s_x, self.s_y)]
        if any(given) and not all(given):
            raise ValueError("origin_mm, s_x and s_y belong together: give all or none")
        if self.s_x is not None and self.s_y is not None:
            axes = np.array([self.s_x, self.s_y])
            if not np.allclose(axes @ axes.T, np.eye(2), atol=_SQUARE):
                raise ValueError("s_x and s_y are not two unit vectors at a right angle")
        return self

    def covers(self, half_side_mm: float) -> bool:
        """Whether the height map, if any, covers the pattern."""
        if self.height_map is None:
            return True
        axes = (self.height_map.s_x_mm, self.height_map.s_y_mm)
        return all(axis[0] <= -half_side_mm and axis[-1] >= half_side_mm for axis in axes)
