"""Names whose use vulture cannot see, each with its user."""

_.connection_made, _.connection_lost, _.data_received, exc  # asyncio calls these of a protocol
_.process_renderables, _.writelines  # Rich and `print` call these of a console and a stream
_.model_config, _.nullable_schema, _.field_title_should_be_set  # pydantic
_.num_tickets  # ssl
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
_.pump_readback_fraction, _.vent_readback_fraction  # fields of a row, read by their place
_.effective_samples, _.pump_scale, _.pump_sigma  # written by `asdict`
_.change_rms_um  # of a sensitivity: for callers of the library, and compared with another law
list_checks  # of the conformance tests: called by the tests of drivers' packages
Camera  # the role that the camera drivers fill
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
    _.screen_points,
    evaluate_gradients,
    _.experiments,
)  # a library: docs/explanation/metrology.md, docs/how-to/tuning.md
_.frame_rms_adu, _.step_periods, _.sensitivity_sigma  # parts of a result
(
    _.trace_pixels,
    _.on_film,
    _.back_sag_mm,
    _.pump_um_per_s,
)  # the twin's truth, which tests compare with
_.power_cycle, _.set_double  # faults that scenarios and tests bring about
_.__signature__  # Typer reads a command's options from it
_.expect  # of a scenario: its tests
_.__init_subclass__  # Python calls it
(
    _.priority,
    _.overdue_s,
    _.restarts,
    _.table_rows_lost,
    _.and_unrecorded,
    made_utc,
)  # of events, written as a whole
(
    _.focal_length_mm,
    _.tilt_x_urad,
    _.tilt_y_urad,
    _.irregularity_pv_um,
    _.irregularity_rms_um,
)  # numbers of a figure,
(
    _.pvr_um,
    _.rotational_pv_um,
    _.asymmetry_rms_um,
    _.slope_rms_urad,
)  # written and read by their names
_.spot_rms_mm, _.spot_50_mm, _.spot_80_mm, _.spot_95_mm
_.star_path_rms_um, _.strehl
_.places_mm, _.misfit, _.crossed_phasors  # a library: docs/how-to/library.md
_.to_xarray, open_result, open_stability  # for scripts: docs/how-to/data.md
(
    _.screen_x_mm,
    _.screen_y_mm,
    _.screen_turn_x_deg,
    _.screen_turn_y_deg,
    _.screen_turn_z_deg,
)  # sigmas, read by name
(
    _.camera_yaw_deg,
    _.camera_pitch_deg,
    _.camera_roll_deg,
    _.focal_relative,
    _.k1,
    _.k2,
    _.p1,
    _.p2,
    _.pitch_relative,
)
_.requests, _.released, consumer  # of the stand-in for the package gpiod, whose request has these
_.enters  # a rule's level for people, in the generated page
PageLoop  # named as text to uvicorn
_.faulty_sensor  # in the template of a sentence
# fields of a hold's messages: declared to be checked, and read by their keys
(
    _.state,
    _.why,
    _.run,
    _.fault,
    _.row,
    _.notices,
    _.recording_ok,
    _.gains,
    _.geometry,
    _.safe_level,
    _.shape,
)
(
    _.shape_reason,
    _.state_age_s,
    _.trial_left_s,
    _.commander,
    _.command_session,
    _.clients,
    _.mono_s,
    _.refused,
)
(
    _.membrane_ctrl,
    _.you,
    _.role,
    _.status,
    _.event,
    _.notice,
    _.calibrated_utc,
    _.since_utc,
    _.kp_per_s,
    _.ti_s,
    _.td_s,
)
(
    find_protections,
    find_bound,
    _.distance_um,
)  # the protection table, for docs/reference/faults.md, the safety case and the campaign
_.vent_um_per_s  # of the simulated truth, packed as a whole
_.sent  # of an event, written as a whole
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
(_.status_code, _.in_contact, _.has_report)  # of HTTP answers, written as a whole
(
    _.stated_kp_per_s,
    _.stated_ti_s,
    _.figure_ms,
    _.memory_locked,
    over_min,
)  # of events, which are written as a whole
_.ok  # of an answer of the control port, checked and passed on as a whole
_.held_offset_sigma_um  # a column of telemetry, recorded and published as a whole
