"""Experiments for tuning: step machines that a controller runs in its state `tune`."""
