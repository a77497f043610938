"""The service beside the holds: follows, starts and ends them; answers browsers and programs."""
