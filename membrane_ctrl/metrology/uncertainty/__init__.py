"""How well a figure is known."""
