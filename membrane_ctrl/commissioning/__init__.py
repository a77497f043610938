"""Commands about devices: check, devices, conformance, safe."""
