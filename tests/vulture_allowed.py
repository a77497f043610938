"""Names whose use vulture cannot see, each with its user."""

_.process_renderables, _.writelines  # Rich and `print` call these of a console and a stream
_.model_config, _.nullable_schema, _.field_title_should_be_set  # pydantic
_.get_user, _._make_protocol  # asyncua calls these
(
    _.method_service,
    _.max_connections,
    _.max_pending_messages_per_connection,
    _.max_message_size,
)  # asyncua reads these
(
    _.put_nowait,
    maxsize,
    _.MaximumPacketSize,
    _.on_connect,
    _.on_connect_fail,
    _.on_disconnect,
)  # aiomqtt and paho use these
(
    acquisition_main,
    alarm_process_main,
    alarms_main,
    console_main,
    recorder_main,
    serve_bench,
)  # named as text to the child process that imports them
_.pump_readback_fraction  # fields of a row, read by their place
_.effective_samples, _.pump_sigma  # written by `asdict`
_.change_rms_um  # of a sensitivity: for callers of the library, and compared with another law
list_checks  # of the conformance tests: called by the tests of drivers' packages
(
    AravisCamera,
    FolderCamera,
    UvcCamera,
    PygameDisplay,
    KeyenceDlRs1a,
    Mks937b,
    Optoncdt1420,
    VaisalaPtb330,
    Ventus,
)
# those are named as text in firmware_iface/drivers/__init__.py
(
    _.common_covariance_um2,
    evaluate_gradients,
)  # a library: docs/explanation/metrology.md, docs/how-to/tuning.md
_.step_periods  # parts of a result
_.back_sag_mm  # the twin's truth, which tests compare with
_.set_double  # faults that scenarios and tests bring about
_.__signature__  # Typer reads a command's options from it
_.expect  # of a scenario: its tests
_.__init_subclass__  # Python calls it
_.restarts, _.table_rows_lost, _.and_unrecorded, made_utc  # of events, written as a whole
(
    _.focal_length_mm,
    _.tilt_x_urad,
    _.tilt_y_urad,
    _.irregularity_pv_um,
    _.irregularity_rms_um,
    _.pvr_um,
    _.rotational_pv_um,
    _.asymmetry_rms_um,
    _.slope_rms_urad,
    _.spot_rms_mm,
    _.star_path_rms_um,
)  # numbers of a figure, written and read by their names
_.crossed_phasors  # a library: docs/how-to/library.md
_.to_xarray, open_result, open_stability  # for scripts: docs/how-to/data.md
_.screen_turn_x_deg, _.screen_turn_y_deg, _.screen_turn_z_deg  # sigmas, read by name
_.camera_yaw_deg, _.camera_pitch_deg, _.camera_roll_deg, _.focal_relative, _.pitch_relative
_.released, consumer  # of the stand-in for the package gpiod, whose request has these
_.enters  # a rule's level for people, in the generated page
PageLoop  # named as text to uvicorn
# fields of a hold's messages: declared to be checked, and read by their keys
_.recording_ok
_.commander, _.command_session
_.membrane_ctrl, _.you
find_protections  # for docs/reference/faults.md, the safety case and the campaign
_.vent_um_per_s  # of the simulated truth, packed as a whole
_.writable  # of a file that Arrow writes to
Barometer, Thermometer  # contracts of drivers, which packages of others fill
FilmThermometer, RingThermometer, Hygrometer  # the same
_.film_strain_ppm, _.ring_strain_ppm, _.climate_figure_um, _.climate_sigma_um  # rows, by name
_.ring_per_k  # of a fit, by its name
_.reason_code  # compared with the rest of its dataclass
stated_kp_per_s, stated_ti_s  # of an event, written as a whole
_.FIXED_POINTS  # a reading of the paper: all members are computed
_.beside_heading  # read by the template of a report page
_.commissioning_report  # a route of the page
_.use_mirror  # another bench than the twin, for tests
_.status_code, _.has_report  # of HTTP answers, written as a whole
(
    _.stated_kp_per_s,
    _.stated_ti_s,
    _.figure_ms,
    _.memory_locked,
    over_min,
)  # of events, which are written as a whole
_.held_offset_sigma_um  # a column of telemetry, recorded and published as a whole
