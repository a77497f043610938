"""The live cycle: frames in memory to a figure every two seconds."""
