"""The simulated bench: film and gas physics, disturbances, optics. Shares no code with the inverse it tests."""
