"""The twin: film, gas, pump, sensors and optics, simulated without
the code of the reconstruction.
"""
