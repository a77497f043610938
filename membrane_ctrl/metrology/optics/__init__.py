"""Rays, surfaces and the screen: the geometry behind every measurement."""
