"""The forward model: camera rays, mirror surface, screen, and the derivatives of all of them."""
