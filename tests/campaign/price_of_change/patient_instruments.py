"""Configuration of single instruments whose limits of time suit a machine that pauses."""

INSTRUMENTS = """
[limits]
stale_s = 2.0
lateness_max_ms = 1900.0

[devices]
watchdog_s = 2.0

[loop]
rate_hz = 20.0
feedforward_barometer = false
feedforward_temperature = false

[pump]
dead_fraction = 0.0
start_fraction = 0.0
stall_fraction = 0.0

[devices.displacement]
driver = "optoncdt1420"
port = "/dev/ttyUSB0"
range_mm = 50
rate_khz = 2
timeout_s = 0.9

[devices.pump]
driver = "bronkhorst_modbus"
link = "rtu:///dev/ttyUSB1?baud=115200&parity=E"
unit_id = 3
timeout_s = 0.9

[devices.gauge_pressure]
driver = "bronkhorst_modbus"
link = "rtu:///dev/ttyUSB1?baud=115200&parity=E"
unit_id = 5
timeout_s = 0.9
"""
