"""Bridges for the lab's other systems: the same names and values by MQTT, OPC UA and EPICS."""
