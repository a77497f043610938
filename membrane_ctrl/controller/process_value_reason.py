"""Why the loop follows what it follows."""

from enum import StrEnum


class ProcessValueReason(StrEnum):
    """Why the loop follows what it follows; the value is a phrase for people."""

    RESPONSE_KNOWN = "dead time and lag of the pump are known"
    RESPONSE_UNKNOWN = "dead time and lag of the pump are not known"
    LASER_ALONE = "neither camera nor barometer shows the centre or its weather"
    GAINS_ON_TRIAL = "gains of the PI are on trial"
    PI_TRIED = "the PI is tried, as the estimate may be worse"
    ESTIMATE_WORSE = "the estimate held the mirror no better"
    LASER_UNUSABLE = "the laser is missing or wrong"
