"""Phase-measuring deflectometry: pure numerics from frames to Zernike terms,
no I/O and no clock.
"""
