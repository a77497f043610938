"""Tables of a bench of single instruments, as a configuration file has them."""

from typing import Any

Table = dict[str, Any]


def value(link: str, address: int, **more: Any) -> Table:
    return {
        "driver": "modbus_map",
        "link": link,
        "address": address,
        "raw": [0, 1],
        "value": [0.0, 1.0],
        **more,
    }


def roles(**changes: Table) -> Table:
    tables: Table = {
        "displacement": value("tcp://plc", 0),
        "pump": value("tcp://plc", 10),
        "gauge_pressure": value("tcp://plc", 20),
        **changes,
    }
    return {"devices": tables}
