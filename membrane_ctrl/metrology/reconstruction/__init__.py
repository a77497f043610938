"""From rays and screen points to the surface: least squares on slopes, and the height map."""
