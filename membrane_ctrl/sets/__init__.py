"""Capture sets: from a folder of images to results, and from a known truth to a folder of images."""
