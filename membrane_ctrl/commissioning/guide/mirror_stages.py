"""Step 1: the mirror's data, and what follows from them."""

from membrane_ctrl.commissioning.guide import thresholds
from membrane_ctrl.commissioning.guide.dialogue import Choice
from membrane_ctrl.commissioning.guide.mirror_design import (
    PAPER_MIRROR,
    MirrorDesign,
    MirrorFacts,
    derive_design,
    find_other_bulge_mm,
)
from membrane_ctrl.commissioning.guide.stage import (
    StageContext,
    StageFailedError,
)
from membrane_ctrl.commissioning.guide.stage_words import format_duration
from membrane_ctrl.control.pump_curve import PumpCurve

# key, question, unit, least, most
_QUESTIONS = (
    ("diameter_mm", "inner diameter of the ring", "mm", 20.0, 100_000.0),
    ("sag_mm", "depth of the bowl to hold (sag)", "mm", 0.1, 10_000.0),
    ("thickness_um", "thickness of the mirror's film", "µm", 1.0, 1000.0),
    ("back_thickness_um", "thickness of the other film, which closes the gas", "µm", 1.0, 1000.0),
    ("modulus_gpa", "Young's modulus of the film (PET 4.1, Kapton 2.5)", "GPa", 0.01, 500.0),
    ("poisson", "Poisson ratio of the film", "", 0.0, 0.5),
    ("yield_mpa", "yield stress of the film (PET 100, Kapton 70)", "MPa", 0.1, 5000.0),
    ("pump_ml_per_s", "full flow of the pump", "mL/s", 0.001, 1e5),
    ("leak_time_constant_s", "time in which the leak takes 63 % of the pressure", "s", 10.0, 1e8),
    ("relief_pa", "opening pressure of the relief valve; 0: none is fitted", "Pa", 0.0, 1e5),
)
_OWN, _PAPER = "own", "paper"
_DIRECTLY, _THROUGH = "directly", "through"
_DIAPHRAGM, _PROPORTIONAL = "diaphragm", "proportional"
_PUMP_FRACTIONS = ("dead_fraction", "start_fraction", "stall_fraction")
_RAMP_SHARE = 0.65  # of the full flow: the rest is for the leak


def ask_mirror(context: StageContext) -> None:
    """Ask for the mirror's data, show what follows, and write it into the configuration."""
    dialogue = context.dialogue
    preset = dialogue.ask_choice(
        "mirror.preset",
        "which mirror?",
        (
            Choice(
                name=_PAPER,
                meaning="1 m, 37.1 mm deep, PET 50 µm and 10 µm: the paper's; you may change it",
            ),
            Choice(name=_OWN, meaning="another one"),
        ),
        _PAPER,
    )
    start = PAPER_MIRROR.model_dump()
    if preset == _PAPER and not dialogue.confirm("mirror.change", "change any of its data?"):
        asked = start | {"relief_pa": _ask_relief(context)}
    else:
        asked = {
            key: dialogue.ask_number(f"mirror.{key}", question, start[key], low, high, unit)
            for key, question, unit, low, high in _QUESTIONS
        }
        kind = dialogue.ask_choice(
            "mirror.pump_kind",
            "how does its flow follow the command?",
            (
                Choice(
                    name=_DIAPHRAGM, meaning="it starts at 22 % and stalls below 15 % of full drive"
                ),
                Choice(name=_PROPORTIONAL, meaning="from 0 on, as a flow controller"),
            ),
            _DIAPHRAGM,
        )
        asked |= {"pump_proportional": kind == _PROPORTIONAL}
    facts = MirrorFacts.model_validate(asked)
    facts = facts.model_copy(update={"front_bulge_mm": _ask_front_bulge_mm(context, facts)})
    try:
        design = derive_design(facts)
    except ValueError as error:
        raise StageFailedError(f"no film has these data: {error}") from None
    context.state.facts = facts
    dialogue.show(*explain_design(facts, design))
    write_design(context, facts, design)
    _judge_design(context, facts, design)


def _ask_relief(context: StageContext) -> float:
    key, question, unit, low, high = _QUESTIONS[-1]
    return context.dialogue.ask_number(f"mirror.{key}", question, 0.0, low, high, unit)


def _ask_front_bulge_mm(context: StageContext, facts: MirrorFacts) -> float:
    """Ask whether the camera looks through the other film, and for the height of that film.

    A front film that the configuration states is the default: an empty answer must not remove it.
    """
    stated = context.config.optics.mirror.front_film
    seen = context.dialogue.ask_choice(
        "mirror.seen",
        "how does the camera see the mirror?",
        (
            Choice(name=_DIRECTLY, meaning="nothing is in front of it, or there is no camera"),
            Choice(
                name=_THROUGH,
                meaning="through the other film, which is clear, and the gas: the paper's cushion",
            ),
        ),
        _DIRECTLY if stated is None else _THROUGH,
    )
    if seen == _DIRECTLY:
        return 0.0
    bulge_mm = find_other_bulge_mm(facts) if stated is None else stated.bulge_mm
    return context.dialogue.ask_number(
        "mirror.front_bulge_mm",
        "height of the clear film's middle above its rim, measured, or as derived",
        round(bulge_mm, 1),
        0.1,
        5000.0,
        "mm",
    )


def list_facts(facts: MirrorFacts) -> list[tuple[str, str]]:
    """The mirror's data in the words of their questions, with units."""
    values = facts.model_dump()
    listed = [
        (question.partition(";")[0].partition(" (PET")[0], f"{values[key]:g} {unit}".rstrip())
        for key, question, unit, _, _ in _QUESTIONS
    ]
    if facts.relief_pa == 0.0:
        listed[-1] = ("relief valve", "none")
    kind = _PROPORTIONAL if facts.pump_proportional else _DIAPHRAGM
    listed.append(("kind of pump", kind))
    if facts.front_bulge_mm > 0.0:
        listed.append(("height of the clear film in front", f"{facts.front_bulge_mm:g} mm"))
    return listed


def explain_design(facts: MirrorFacts, design: MirrorDesign) -> list[str]:
    """What follows from the mirror's data, for people.

    Parameters
    ----------
    facts : MirrorFacts
        As stated by the person.
    design : MirrorDesign
        Derived from them.

    Returns
    -------
    list of str
        Indented lines, with units.
    """
    lowering = format_duration(design.lowering_s)
    return [
        f"  pressure at {facts.sag_mm:g} mm: {design.pressure_pa:.0f} Pa (p ~ sag^3)",
        f"  stress: {design.front_stress_mpa:.0f} MPa in the mirror's film, "
        f"{design.back_stress_mpa:.0f} MPa in the other film; it goes with p^(2/3)",
        f"  pressure limit: {design.gauge_max_pa:.0f} Pa, a quarter above; the stress is then "
        f"{design.stress_at_limit_mpa:.0f} MPa",
        f"  a relief valve must open between {design.gauge_max_pa:.0f} and "
        f"{design.relief_most_pa:.0f} Pa, where a film would yield",
        f"  displacement limits: {design.displacement_min_um:.0f} .. "
        f"{design.displacement_max_um:.0f} µm about this depth: -5 % and +1.3 % of it",
        f"  gas: {design.volume_l:.3g} L; a millilitre more moves the centre by "
        f"{design.um_per_ml:.3g} µm, so the pump gives {design.flow_full_um_per_s:.3g} µm/s",
        f"  filling from flat: {format_duration(design.filling_s)}; down to 100 Pa by the leak "
        f"alone: {lowering}",
        f"  weather: {design.barometer_um_per_pa:.3g} µm/Pa of the barometer, "
        f"{design.temperature_um_per_k:.3g} µm/K",
        "  gains to begin with: the defaults. The manipulated value is a speed of the centre, so "
        "they depend on the pump's lag, not on the mirror; step 6 tunes them",
    ]


def _judge_design(context: StageContext, facts: MirrorFacts, design: MirrorDesign) -> None:
    """Judge stress, pump and relief valve."""
    context.note("working pressure", f"{design.pressure_pa:.0f} Pa")
    context.judge(
        "yield stress over the stress at the pressure limit",
        facts.yield_mpa / design.stress_at_limit_mpa,
        thresholds.STRESS_MARGIN,
        "use a thicker film, a shallower bowl, or a film of higher yield stress",
    )
    context.judge(
        "leak over the pump's full flow, as stated",
        design.pump_reserve,
        thresholds.LEAK_SHARE,
        "fit a larger pump, or find the leak",
    )
    context.judge(
        "least flow of the running pump over the leak, as stated",
        PumpCurve(context.config.pump).least_flow_um_per_s / design.leak_um_per_s,
        thresholds.PUMP_LEAST,
        "fit a smaller pump or a flow controller, or open a bleed (`loop.bleed_fraction`)",
    )


def write_design(context: StageContext, facts: MirrorFacts, design: MirrorDesign) -> None:
    """Write what follows from the mirror's data into the configuration.

    An answer that replaces an earlier one must also undo what that one has written: the front film,
    and the pump that follows its command from zero on.

    Parameters
    ----------
    context : StageContext
        Of the stage; its folder has the configuration.
    facts : MirrorFacts
        As stated by the person.
    design : MirrorDesign
        Derived from them.
    """
    flow_um_per_s = _round(design.flow_full_um_per_s)
    context.set_keys(
        "optics.mirror",
        radius_mm=_round(facts.radius_mm),
        analysis_radius_mm=_round(0.95 * facts.radius_mm),
        sag_mm=_round(facts.sag_mm),
        pressure_pa=_round(design.pressure_pa),
    )
    if facts.front_bulge_mm > 0.0:
        context.set_keys(
            "optics.mirror.front_film",
            bulge_mm=_round(facts.front_bulge_mm),
            thickness_um=_round(facts.back_thickness_um),
        )
    else:
        context.remove_keys("optics.mirror", "front_film")
    context.set_keys(
        "limits",
        displacement_min_um=design.displacement_min_um,
        displacement_max_um=design.displacement_max_um,
        gauge_pressure_max_pa=design.gauge_max_pa,
    )
    context.set_keys("pump", flow_full_um_per_s=flow_um_per_s)
    _write_pump_kind(context, is_proportional=facts.pump_proportional)
    context.set_keys(
        "loop",
        flow_max_um_per_s=flow_um_per_s,
        setpoint_ramp_um_per_s=_round(_RAMP_SHARE * flow_um_per_s),
        barometer_gain_um_per_pa=_round(design.barometer_um_per_pa),
        temperature_gain_um_per_k=_round(design.temperature_um_per_k),
    )
    filling_s = min(2.0 * design.filling_s, 1e6)
    context.set_keys("states", inflate_timeout_s=_round(max(filling_s, 600.0)))
    context.set_keys("twin", leak_time_constant_s=_round(facts.leak_time_constant_s))


def _write_pump_kind(context: StageContext, is_proportional: bool) -> None:
    """Write where the pump starts and stalls.

    A diaphragm pump keeps what is configured, which a measured curve may have set, unless that is
    the proportional pump of an earlier answer: then the defaults return.
    """
    pump = context.config.pump
    was_proportional = pump.dead_fraction == pump.start_fraction == pump.stall_fraction == 0.0
    if is_proportional:
        context.set_keys("pump", **dict.fromkeys(_PUMP_FRACTIONS, 0.0))
    elif was_proportional:
        context.remove_keys("pump", *_PUMP_FRACTIONS)


def _round(value: float) -> float:
    """Four digits, for a file that people read."""
    return float(f"{value:.4g}")
