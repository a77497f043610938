"""The command `calibrate --live`: sets at several pressures,
taken from a running hold and solved.
"""
