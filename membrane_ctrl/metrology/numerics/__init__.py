"""Compiled loops and the Zernike polynomials that all steps use."""
