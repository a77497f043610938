"""Runs in virtual time: the same controller on the twin's board."""
