"""Why the shape loop does not track, or what limits it."""

from enum import StrEnum


class ShapeCode(StrEnum):
    """Why the shape loop does not track, or what limits it."""

    SWITCHED_OFF = "switched_off"
    WAITING = "waiting"
    REFERENCE = "reference"
    NOT_SETTLED = "not_settled"
    NO_SHAPE = "no_shape"
    REJECTED = "rejected"
    MOVED_MEANWHILE = "moved_meanwhile"
    NOT_NEWER = "not_newer"
    NOT_FINITE = "not_finite"
    NO_LASER = "no_laser"
    LASER_MOVED = "laser_moved"
    DISAGREE = "disagree"
    CAMERA_REPEATS = "camera_repeats"
    CAMERA_WRONG = "camera_wrong"
    NO_MOUNT = "no_mount"
    TRIM_LIMIT = "trim_limit"
    FIGURE_JUMP = "figure_jump"
    OFFSET_LIMIT = "offset_limit"
