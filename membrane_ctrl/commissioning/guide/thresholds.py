"""Every limit that a commissioning session judges by, with its reason."""

from membrane_ctrl.commissioning.guide.threshold import Threshold

STRESS_MARGIN = Threshold(
    "yield stress over the stress at the pressure limit",
    1.2,
    "",
    "above its yield stress a film creeps for good; the paper's mirror has 1.29, in its thin film",
    is_least=True,
)
RELIEF_MARGIN = Threshold(
    "yield stress over the stress at the relief valve's pressure",
    1.0,
    "",
    "the valve is the last protection: it must open before the film yields",
    is_least=True,
)
GAUGE_ZERO = Threshold(
    "gauge reading of the vented mirror",
    5.0,
    "Pa",
    "1 % of 600 Pa: the pressure limits, and the comparison with the laser, use this zero",
)
GAUGE_NOISE = Threshold(
    "standard deviation of the vented gauge",
    3.0,
    "Pa",
    "the rule laser_gauge_apart averages 10 s, and 3 Pa are then 0.3 Pa, or 6 µm",
)
GAUGE_RISE = Threshold(
    "rise of the gauge under a hand",
    5.0,
    "Pa",
    "more than its zero may be off, so that the sign is certain",
    is_least=True,
)
LASER_SCALE = Threshold(
    "laser's motion over the card's, difference from 1",
    0.2,
    "",
    "a ruler and a hand give 10 %; a wrong unit or range gives a factor of 2 or more",
)
READBACK = Threshold(
    "read-back minus command",
    0.02,
    "of full scale",
    "the fault pump_mismatch judges the same difference during a hold",
)
WATCHDOG_LATE = Threshold(
    "pump off after the last command",
    0.5,
    "s beyond the period",
    "a watchdog's own loop and one reading; later the pump would run unguarded",
)
PUMP_LEAST = Threshold(
    "least flow of the running pump over the leak",
    1.0,
    "",
    "a pump that gives more than the leak whenever it runs can only switch on and off",
)
BENCH_PRESSURE_SHARE = Threshold(
    "pressure while pump and vent are tried",
    0.2,
    "of the pressure limit",
    "the mirror must stay slack while a person works at it",
)
FIT_SCATTER = Threshold(
    "pressure against depth, difference from the film's law",
    8.0,
    "%",
    "1 % of scale each of laser and gauge give 4 %; creep of a fresh film adds 2 %",
)
STIFFNESS_RATIO = Threshold(
    "measured over stated stiffness of the film, or the reverse",
    1.5,
    "",
    "modulus and thickness of a film vary by 20 %; more means a wrong thickness or gauge unit",
)
LEAK_LEAST = Threshold(
    "leak at the held depth",
    0.4,
    "µm/s",
    "the pump can only add gas: a tighter mirror does not come down when the air warms",
    is_least=True,
)
LEAK_SHARE = Threshold(
    "leak over the pump's full flow",
    0.6,
    "",
    "beyond, the notice maintenance_pump_reserve is raised: gusts would saturate the pump",
)
RIM_EDGE = Threshold(
    "width of the mirror's rim in the picture, 10 to 90 %",
    6.0,
    "px",
    "a figure averages bins of 4 px; a wider blur mixes slopes of neighbouring bins",
)
VALID_FRACTION = Threshold(
    "part of the mirror that a figure measures",
    0.8,
    "",
    "with less the outer Zernike terms are not determined",
    is_least=True,
)
MODULATION = Threshold(
    "median modulation of the fringes",
    20.0,
    "counts of 8 bits",
    "phase noise grows with its inverse; defocus and a short exposure lower it first",
    is_least=True,
)
SEEN_SHARE = Threshold(
    "part of the mirror that camera and pattern can measure by the stated geometry",
    0.9,
    "",
    "`check` warns below this",
    is_least=True,
)
HOLD_STD = Threshold(
    "standard deviation of the error during the hold",
    1.0,
    "µm",
    "the paper holds about 2 µm; with 1 µm of laser noise a tuned loop has 0.1 to 0.3 µm",
)
HOLD_WORST = Threshold(
    "largest mean error of one second during the hold",
    10.0,
    "µm",
    "the notice out_of_band judges the same distance",
)
HOLD_MISSED = Threshold(
    "ticks that did not run", 0.001, "of all", "a sound machine misses none; 0.1 % is one in 20 s"
)
HOLD_FAULTS = Threshold("faults during the hold", 0, "", "an unattended mirror must need no person")
HOLD_PUMP = Threshold(
    "mean pump command during the hold", 0.75, "of full scale", "the rest is needed for gusts"
)

ALL_THRESHOLDS = tuple(value for value in list(vars().values()) if isinstance(value, Threshold))
