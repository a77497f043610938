"""From frames to fringe phases: phase steps, Gray code, fringe orders, sums over bins."""
