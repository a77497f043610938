"""Sentences that several commands print."""

from membrane_ctrl.config.schema import LoopConfig

TOO_TIGHT = (
    "the mirror is too tight to be held within its band: open the bleed (loop.bleed_fraction)"
)


def describe_gains(loop: LoopConfig) -> str:
    """The gains of a loop, as a person compares them."""
    return (
        f"K {loop.kp_per_s:.3f} 1/s, Ti {loop.ti_s:.2f} s, filter {loop.measurement_filter_s:.2f} s"
    )
