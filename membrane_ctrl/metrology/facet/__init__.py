"""Facets of a concentrator, from other programs' measured sets."""
