"""Tuning by hand: a page with sliders on the fitted plant and the recorded weather."""
